"""How wrong every method is at directions that nobody fitted: continuous random ones, at three footprints.

Fits are judged at the directions they were fitted to, or at those that their grid left out; what a picture shows lies
between. Here rows of `btfref.querying` are the truth: random places and pairs of directions, uniform up to 85 degrees,
path traced as points, as texels and as squares of 4 × 4 texels, in two halves that share no random number. `SPLIT`
fixes the rows: they are the same for every method, set of directions and machine. The noise is taken out, and each
error stands with its 99 % interval.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.experiments.between import TEXELS, chosen_of, fitted_to
from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.registry import methods

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import Facts

#: Sets of directions that methods are fitted to.
SETS = ("ubo81", "ubo151")

#: Seed of the rows that no fit sees: the split between what is fitted and what is judged.
SPLIT = 1_618_033

#: Largest polar angle, degrees.
MAX_THETA = 85.0

#: Footprints by name: half sides of squares, in texels of the fits.
FOOTPRINTS = {"point": 0.0, "texel": 0.5, "4 x 4 texels": 2.0}

#: Rows of each footprint, samples of each half of a row, and lookups that a method averages over a footprint.
#: Highlights are rare: many rows of few samples say more than few rows of many.
ROWS, SPP, LOOKUPS = 20_000, 64, 4

#: Rows where less is asked for.
QUICK_ROWS, QUICK_SPP = 500, 32


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
        truth = true_rows(name, n, spp)
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


def true_rows(name: str, n: int, spp: int, *, texels: int = TEXELS) -> dict[str, dict[str, np.ndarray]]:
    """Rows of every footprint with two independent means of each.

    Parameters
    ----------
    name : str
        Of a mesostructure.
    n, spp : int
        Rows of a footprint, samples of each half.
    texels : int
        Along a side of the tile: footprints are measured in them.

    Returns
    -------
    dict of dict
        Footprint → columns of a row; ``first``, ``second`` (n, 3) are the halves, ``B`` and ``variance`` of both.
    """
    from btfref.querying.job import QueryJob

    result = {}
    for number, (footprint, half) in enumerate(FOOTPRINTS.items()):
        job = QueryJob.of(
            name,
            None,
            {
                "n": n,
                "spp": spp,
                "seed": SPLIT + number,
                "max_theta": MAX_THETA,
                "radius": half / texels,
                "footprint": "square",
            },
        )
        with job.ready():
            first, second = (job.rows(job.make_source(stream), 0, n) for stream in (0, 1))
        halves = {"first": first["B"], "second": second["B"]}
        both = {
            "B": 0.5 * (first["B"] + second["B"]),
            "variance": 0.25 * (first["variance"] + second["variance"]),
        }
        result[footprint] = first | both | halves
    return result


def errors(representation: Representation, truth: dict[str, dict[str, np.ndarray]]) -> Facts:
    """Errors of a representation at the rows of every footprint."""
    from btfref.querying.accuracy import accuracy
    from btfref.querying.lookups import lookups

    found = {}
    for footprint, rows in truth.items():
        number = np.arange(len(rows["B"]))
        answer = lookups(representation, rows, number, footprint="square", count=LOOKUPS, seed=SPLIT)
        # Places of the lookups are random as well: their noise is the answer's own.
        variance = rows["variance"] + answer["variance"]
        found[footprint] = accuracy(answer["B"], rows["B"], variance, (rows["first"], rows["second"]))
    return found


#: Errors of the table, their heads and how they are written.
COLUMNS = {
    "nrmse": ("RMSE / RMS", "{:.3f}"),
    "mae": ("MAE, 1/sr", "{:.4f}"),
    "psnr_log": ("PSNR log(1 + B), dB", "{:.1f}"),
    "delta_e00": ("ΔE00", "{:.2f}"),
}


#: Heads of the columns.
HEADS = tuple(head for head, _ in COLUMNS.values())


def cells(facts: Facts) -> list[str]:
    """Errors as a table shows them: 99 % intervals in brackets."""
    found = []
    for name, (_, form) in COLUMNS.items():
        middle, low, high = (form.format(value) for value in facts[name])
        found.append(f"{middle} ({low} to {high})")
    return found


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a material, a set of directions, a method and a footprint each."""
    rows = [
        (label, key, footprint, *cells(facts))
        for label, made in result["summary"].items()
        for key, footprints in made.items()
        for footprint, facts in footprints.items()
    ]
    return ("material", "method", "footprint", *HEADS), rows
