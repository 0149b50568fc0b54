"""Honest timing: warm-up apart, interleaved rounds, medians with spread, ratios of pairs."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.provenance import versions
from btfref.sampling.memory import of_this_process

if TYPE_CHECKING:
    from btfref.types import Facts


def machine() -> Facts:
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


def interleaved(tasks: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
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
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for i in range(rounds + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            if i:
                times[name].append(time.perf_counter() - start)
    return times


def summary(times: Mapping[str, Sequence[float]], baseline: str) -> dict[str, dict[str, float]]:
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


def kernels(task: Callable[[], object]) -> Facts:
    """Run a task of Dr.Jit and tell what its kernels took, tracing and Python left out.

    Parameters
    ----------
    task : callable
        Waits for its results.

    Returns
    -------
    dict
        ``launched``, ``compiled`` (neither in memory nor on disk), ``from_disk``: numbers of kernels; ``codegen_s``,
        ``backend_s`` (LLVM or PTX, or loading from disk), ``execution_s``.
    """
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        task()
        entries = [e for e in dr.kernel_history() if e["type"] == dr.KernelType.JIT]
    new = [e for e in entries if not e["cache_hit"]]
    return {
        "launched": len(entries),
        "compiled": sum(not e["cache_disk"] for e in new),
        "from_disk": sum(bool(e["cache_disk"]) for e in new),
        "codegen_s": 1e-3 * sum(e["codegen_time"] for e in new),
        "backend_s": 1e-3 * sum(e["backend_time"] for e in new),
        "execution_s": 1e-3 * sum(e["execution_time"] for e in entries),
    }


def reset_peak() -> int | None:
    """Start counting the peak of the process anew; what it holds now in bytes, or None."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
        return of_this_process("VmRSS")
    except OSError:
        return None


def peak_memory() -> int | None:
    """Most that the process held since :func:`reset_peak`, bytes, or None."""
    return of_this_process("VmHWM")
