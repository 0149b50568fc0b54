"""What refinement is worth: errors of fits at directions that nobody fitted, before and after, at the same bytes.

Fits are made of 32² texels and 81 × 81 directions, and refined by queries of texels, squares as wide as one. They are
judged by other rows, those of `btfref.bench.experiments.offgrid` at three footprints, with independent paths.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.experiments.between import chosen_of
from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.querying import off_grid, split

if TYPE_CHECKING:
    import numpy as np

    from btfref.types import Facts

#: Texels along a side, samples of the fits' data.
TEXELS, SPP = 32, 8

#: Rows that fits are refined by, their samples and their seed, which is none of those that judge.
ROWS, ROW_SPP, ROW_SEED = 1_000_000, 8, 77

#: Rows of each footprint that judge, and samples of each half.
JUDGED, JUDGED_SPP = 2500, 64

#: Methods that are refined by default.
METHODS = ("lpca", "rf_lobes", "lafortune", "cmf")

#: Steps, and what is taken where less is asked for.
STEPS = 400
QUICK_TEXELS, QUICK_STEPS, QUICK_ROWS = 8, 20, 5000


def run(options: Options) -> Facts:
    """Errors before and after, by material and method.

    Parameters
    ----------
    options : Options
        ``quick``: the checker, fewer texels, rows and steps. ``only``: some of the mesostructures and of the methods.

    Returns
    -------
    dict
        ``summary``: material → method → ``before`` and ``after``: footprint → what
        `btfref.querying.accuracy.accuracy` finds; ``history``: of the refined file; ``raw``: seconds of processor time;
        ``parameters``; ``machine``.

    Raises
    ------
    InputError
        For a name in ``only`` that there is not.
    """
    from btfref.refining import refine
    from btfref.registry import methods
    from btfref.sampling.synthesis import synthesize

    axes: list[Sequence[str]] = [MESOSTRUCTURES, METHODS]
    if options.quick:
        axes[0] = MESOSTRUCTURES[:1]
    names, keys = chosen_of(axes, options)
    steps, n_rows = (QUICK_STEPS, QUICK_ROWS) if options.quick else (STEPS, ROWS)
    texels = QUICK_TEXELS if options.quick else TEXELS
    judged, spp = (split.QUICK_ROWS, split.QUICK_SPP) if options.quick else (JUDGED, JUDGED_SPP)
    summary: Facts = {}
    raw: Facts = {}
    for name in names:
        btf = synthesize(name, texels=texels, views="ubo81", lights="ubo81", spp=SPP, estimator="surface")
        truth, rows = off_grid.true_rows(name, judged, spp, texels=texels), texel_rows(name, n_rows, texels)
        summary[name], raw[name] = {}, {}
        for i, key in enumerate(keys):
            options.tell(i, len(keys), f"{name}: {key}")
            fitted = methods()[key].fit(btf)
            start = time.process_time()
            made = refine(fitted, rows, steps=steps, footprint="square")
            raw[name][key] = time.process_time() - start
            summary[name][key] = {
                "before": off_grid.errors(fitted, truth),
                "after": off_grid.errors(made, truth),
                "history": made.meta["refined"][-1],
            }
    parameters = {"texels": texels, "rows": n_rows, "samples": ROW_SPP, "steps": steps, "judged": judged}
    return {
        "suite": "refinement",
        "parameters": parameters,
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def texel_rows(name: str, n: int, texels: int) -> dict[str, np.ndarray]:
    """Queries of texels of a mesostructure."""
    from btfref.querying.job import QueryJob

    asked = {
        "n": n,
        "spp": ROW_SPP,
        "seed": ROW_SEED,
        "max_theta": split.MAX_THETA,
        "radius": 0.5 / texels,
        "footprint": "square",
    }
    job = QueryJob.of(name, None, asked)
    with job.ready():
        return job.rows(job.make_source(0), 0, n)


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a material, a method and a footprint each."""
    rows = []
    for name, made in result["summary"].items():
        for key, found in made.items():
            for footprint in split.FOOTPRINTS:
                cells = []
                for what, (_, form) in off_grid.COLUMNS.items():
                    before, after = (found[when][footprint][what][0] for when in ("before", "after"))
                    change = (
                        f"{after - before:+.1f} dB" if what == "psnr_log" else f"{after / before - 1:+.0%}"
                    )
                    cells.append(f"{form.format(before)} → {form.format(after)} ({change})")
                rows.append((name, key, footprint, *cells, f"{result['raw'][name][key]:.0f}"))
    return ("material", "method", "footprint", *off_grid.HEADS, "seconds"), rows
