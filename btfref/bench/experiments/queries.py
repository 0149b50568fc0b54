"""Rate of queries: independent paths a second, against what Mitsuba's own path integrator traces in the same geometry.

Both trace the same number of samples to the same depth in each round, in turn. Mitsuba renders pictures of the tile, a
random pair of directions each, from the law that the rows follow: its rays are as alike as those of a picture, ours
have a view and a light of their own each.
"""

from __future__ import annotations

import statistics
import time
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.experiments.between import chosen_of
from btfref.bench.options import Options
from btfref.bench.synth_methods import MAX_DEPTH, Naive
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.types import Facts

#: Samples of a round: pictures of Mitsuba, their side and samples a pixel; rows and samples a row.
PICTURES, SIDE, PICTURE_SPP = 16, 128, 16
ROW_SPP = 16

ROUNDS, QUICK_ROUNDS = 5, 1

MAX_THETA = 85.0


def run(options: Options) -> Facts:
    """Samples a second of both.

    Parameters
    ----------
    options : Options
        ``quick``: the checker, one round. ``only``: some of the mesostructures. ``btf``: not used.

    Returns
    -------
    dict
        ``raw``: seconds of every round by mesostructure and by who traces; ``summary``: ``queries`` and ``mitsuba`` in
        samples a second (medians), ``ratio``: median, least and largest of the rounds'; ``parameters``; ``machine``.
    """
    names = chosen_of([MESOSTRUCTURES[:1] if options.quick else MESOSTRUCTURES], options)[0]
    rounds = QUICK_ROUNDS if options.quick else ROUNDS
    samples = PICTURES * SIDE**2 * PICTURE_SPP
    raw: Facts = {}
    summary: Facts = {}
    for k, name in enumerate(names):
        ours, theirs = _ours(name, samples // ROW_SPP), _theirs(name)
        raw[name] = {"queries": [], "mitsuba": []}
        for number in range(rounds + 1):
            options.tell(k * (rounds + 1) + number, len(names) * (rounds + 1), name)
            for key, work in (("queries", ours), ("mitsuba", theirs)):
                start = time.perf_counter()
                work(number)
                if number:  # the first round compiles
                    raw[name][key].append(time.perf_counter() - start)
        ratios = [b / a for a, b in zip(raw[name]["queries"], raw[name]["mitsuba"], strict=True)]
        summary[name] = {
            **{key: samples / statistics.median(raw[name][key]) for key in ("queries", "mitsuba")},
            "ratio": [statistics.median(ratios), min(ratios), max(ratios)],
        }
    parameters = {"samples": samples, "max_depth": MAX_DEPTH, "rounds": rounds, "max_theta": MAX_THETA}
    return {
        "suite": "queries",
        "parameters": parameters,
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def _ours(name: str, n: int) -> Callable[[int], object]:
    from btfref.querying.job import QueryJob

    settings = {"n": n, "spp": ROW_SPP, "max_theta": MAX_THETA, "max_depth": MAX_DEPTH}
    job = QueryJob.of(name, None, settings)
    with job.ready():
        source = job.make_source()

    def work(number: int) -> object:
        with job.ready():
            return job.rows(source, 0, n)

    return work


def _theirs(name: str) -> Callable[[int], object]:
    from btfref.platform import prepare_llvm

    prepare_llvm()
    import mitsuba as mi

    from btfref.querying.laws import laws

    mi.set_variant("llvm_ad_rgb")
    naive = Naive(mi, name, SIDE)
    rows = laws("uniform", "uniform", "0", max_theta=MAX_THETA).rows(0, 0, PICTURES)

    def work(number: int) -> object:
        views, lights = (rows[key].astype(np.float64) for key in ("w_view", "w_light"))
        return [
            naive(view, light, PICTURE_SPP, PICTURES * number + k)
            for k, (view, light) in enumerate(zip(views, lights, strict=True))
        ]

    return work


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a mesostructure each, millions of samples a second, and their ratio with its range."""
    rows = [
        (
            name,
            *(f"{1e-6 * found[key]:.3g}" for key in ("queries", "mitsuba")),
            "{:.2f} ({:.2f} to {:.2f})".format(*found["ratio"]),
        )
        for name, found in result["summary"].items()
    ]
    return ("mesostructure", "queries, M samples/s", "Mitsuba's path, M samples/s", "ratio"), rows
