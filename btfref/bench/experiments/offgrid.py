"""How wrong every method is at directions that nobody fitted: continuous random ones, at three footprints.

Fits are judged at the directions they were fitted to; what a picture shows lies between. The rows are those of
`btfref.querying.off_grid`: the same for every method, set of directions and machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.experiments.between import TEXELS, chosen_of, fitted_to
from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.querying.off_grid import HEADS, cells, errors, true_rows
from btfref.querying.split import LOOKUPS, MAX_THETA, QUICK_ROWS, QUICK_SPP, ROWS, SPLIT, SPP
from btfref.registry import methods

if TYPE_CHECKING:
    from btfref.types import Facts

#: Sets of directions that methods are fitted to.
SETS = ("ubo81", "ubo151")


def run(options: Options) -> Facts:
    """Errors by material, set of directions, method and footprint.

    Parameters
    ----------
    options : Options
        ``quick``: the checker at ubo81, fewer rows. ``only``: some of the methods, mesostructures and sets of
        directions. ``btf``: not used.

    Returns
    -------
    dict
        ``summary``: "material, directions" → method → footprint → what `btfref.querying.accuracy.accuracy` finds;
        ``raw``: seconds of the rows and of the fits; ``parameters``; ``machine``.

    Raises
    ------
    InputError
        For a name in ``only`` that there is not.
    """
    axes: list[Sequence[str]] = [MESOSTRUCTURES, SETS, list(methods())]
    if options.quick:
        axes[:2] = MESOSTRUCTURES[:1], SETS[:1]
    names, sets, keys = chosen_of(axes, options)
    n, spp = (QUICK_ROWS, QUICK_SPP) if options.quick else (ROWS, SPP)
    summary: Facts = {}
    raw: Facts = {}
    for name in names:
        start = time.perf_counter()
        truth = true_rows(name, n, spp, TEXELS)
        raw[name] = {"truth": time.perf_counter() - start}
        for directions in sets:
            label = f"{name}, {directions}"
            btf = fitted_to(name, directions, options)
            summary[label], raw[label] = {}, {}
            for i, key in enumerate(keys):
                options.tell(i, len(keys), f"{label}: {key}")
                start = time.perf_counter()
                made = methods()[key].fit(btf)
                raw[label][key] = time.perf_counter() - start
                summary[label][key] = errors(made, truth)
    return {
        "suite": "offgrid",
        "parameters": {
            "split": SPLIT,
            "texels": TEXELS,
            "max_theta": MAX_THETA,
            "rows": n,
            "samples": 2 * spp,
            "lookups": LOOKUPS,
        },
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a material, a set of directions, a method and a footprint each."""
    rows = [
        (label, key, footprint, *cells(facts))
        for label, made in result["summary"].items()
        for key, footprints in made.items()
        for footprint, facts in footprints.items()
    ]
    return ("material", "method", "footprint", *HEADS), rows
