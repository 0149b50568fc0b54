"""Honest timing: warm-up apart, interleaved rounds, medians with spread, ratios of pairs."""

from __future__ import annotations

import os
import platform
import statistics
import time

from btfref.versions import versions


def machine():
    """Facts about the machine that a time depends on."""
    model = platform.processor()
    try:
        with open("/proc/cpuinfo") as stream:
            names = [line.partition(":")[2].strip() for line in stream if line.startswith("model name")]
        model = names[0] if names else model
    except OSError:
        pass  # not Linux: the processor's name has to do
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "versions": versions(),
    }


def interleaved(tasks, rounds):
    """Times of tasks that are run in turn, so that drifts of the machine hit all of them alike.

    Parameters
    ----------
    tasks : dict of str to callable
        Each runs to completion (asynchronous work included) when called.
    rounds : int
        The first, additional round warms up and is not counted.

    Returns
    -------
    dict of str to list of float
        Seconds of each round.
    """
    times = {name: [] for name in tasks}
    for i in range(rounds + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            if i:
                times[name].append(time.perf_counter() - start)
    return times


def summary(times, baseline):
    """Median, extremes, and median ratio of pairs to the ``baseline`` of :func:`interleaved` times."""
    result = {}
    for name, values in times.items():
        ratios = [a / b for a, b in zip(values, times[baseline], strict=True)]
        result[name] = {
            "median_s": statistics.median(values),
            "min_s": min(values),
            "max_s": max(values),
            "ratio": statistics.median(ratios),
            "ratio_min": min(ratios),
            "ratio_max": max(ratios),
        }
    return result
