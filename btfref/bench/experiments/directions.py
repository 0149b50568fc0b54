"""What a set of directions costs in error: the table itself, interpolated, against the surface at any direction.

A lab pays for pictures: the square of the number of directions. Named sets stand beside sets that are chosen for the
surface by `btfref.sampling.chosen_directions`. The rows are those of ``btfref bench offgrid``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.experiments.between import TEXELS, chosen_of, fitted_to
from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.querying import off_grid, split

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.types import Facts

#: Named sets, and how many are chosen for the surface beside them.
NAMED = ("10x5", "ubo81", "16x8", "ubo151")
CHOSEN = ("adaptive:50", "adaptive:81", "adaptive:128", "adaptive:151")


def run(options: Options) -> Facts:
    """Errors of the interpolated table by material and set of directions.

    Parameters
    ----------
    options : Options
        ``quick``: the checker at two sets, fewer rows. ``only``: some of the mesostructures and sets. ``btf``: not
        used.

    Returns
    -------
    dict
        ``summary``: material → set → ``directions`` (their number), ``pictures``, and ``errors`` by footprint, see
        `btfref.querying.accuracy.accuracy`; ``parameters``; ``machine``.
    """
    from btfref.representations.tabulated import raw

    axes: list[Sequence[str]] = [MESOSTRUCTURES, (*NAMED, *CHOSEN)]
    if options.quick:
        axes = [MESOSTRUCTURES[:1], ("10x5", "adaptive:50")]
    names, sets = chosen_of(axes, options)
    n, spp = (split.QUICK_ROWS, split.QUICK_SPP) if options.quick else (split.ROWS, split.SPP)
    summary: Facts = {}
    for k, name in enumerate(names):
        truth = off_grid.true_rows(name, n, spp, TEXELS)
        summary[name] = {}
        for i, label in enumerate(sets):
            options.tell(k * len(sets) + i, len(names) * len(sets), f"{name}, {label}")
            btf = fitted_to(name, set_of(name, label), options)
            count = len(btf.views)
            summary[name][label] = {
                "directions": count,
                "pictures": count**2,
                "errors": off_grid.errors(raw.fit(btf), truth),
            }
    return {
        "suite": "directions",
        "parameters": {
            "split": split.SPLIT,
            "rows": n,
            "samples": 2 * spp,
            "max_theta": split.MAX_THETA,
        },
        "summary": summary,
        "machine": machine(),
    }


def set_of(name: str, label: str) -> str | DirectionSet:
    """A named set, or the one that is chosen for a surface."""
    kind, _, count = label.partition(":")
    if kind != "adaptive":
        return label
    from btfref.sampling.chosen_directions import chosen_directions

    return chosen_directions(name, int(count))


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a material and a set each, errors of texels with 99 % intervals."""
    rows = []
    for name, sets in result["summary"].items():
        for label, found in sets.items():
            cells = off_grid.cells(found["errors"][split.SHOWN])
            rows.append((name, label, str(found["directions"]), str(found["pictures"]), *cells))
    return ("material", "set", "directions", "pictures", *off_grid.HEADS), rows
