"""How wrong a method is at directions that nobody fitted: continuous random ones, at three footprints.

Random places and pairs of directions, uniform up to 85 degrees, are path traced as points, as texels and as squares of
4 × 4 texels, in two halves that share no random number. `SPLIT` fixes the rows: they are the same for every method,
set of directions and machine. The noise is taken out of every error, and each stands with its 99 % interval. Benchmarks
and validation ask the same rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.querying.accuracy import accuracy
from btfref.querying.lookups import lookups
from btfref.querying.split import FOOTPRINTS, LOOKUPS, MAX_THETA, SPLIT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from btfref.mesostructure.base import Mesostructure
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike

    #: Footprint → columns of its rows.
    Truth = Mapping[str, Mapping[str, np.ndarray]]

#: Errors of the tables, their heads and how they are written.
COLUMNS = {
    "nrmse": ("RMSE / RMS", "{:.3f}"),
    "mae": ("MAE, 1/sr", "{:.4f}"),
    "psnr_log": ("PSNR log(1 + B), dB", "{:.1f}"),
    "delta_e00": ("ΔE00", "{:.2f}"),
}

#: PSNR beyond which an error is none: float32 resolves no more.
MOST_DB = 160.0

#: Heads of the columns.
HEADS = tuple(head for head, _ in COLUMNS.values())


def true_rows(
    source: PathLike | Mesostructure, n: int, spp: int, texels: int, **parameters: object
) -> dict[str, dict[str, np.ndarray]]:
    """Rows of every footprint with two independent means of each.

    Parameters
    ----------
    source : str, path-like or Mesostructure
        Of geometry, as `btfref.queries` takes it.
    n, spp : int
        Rows of a footprint, samples of each half.
    texels : int
        Along the side of the tile, of the fits that are judged.
    **parameters
        Of the mesostructure.

    Returns
    -------
    dict of dict
        Footprint → columns of a row; ``first``, ``second`` (n, 3) are the halves, ``B`` and ``variance`` of both.
    """
    from btfref.querying.job import QueryJob

    result = {}
    for number, (footprint, half_side) in enumerate(FOOTPRINTS.items()):
        job = QueryJob.of(
            source,
            None,
            {
                "n": n,
                "spp": spp,
                "seed": SPLIT + number,
                "max_theta": MAX_THETA,
                "radius": half_side / texels,
                "footprint": "square",
                **parameters,
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


def answers(representation: Representation, truth: Truth) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What a representation says of the rows of every footprint.

    Returns
    -------
    dict of str to (ndarray, ndarray)
        B and the variance of its mean over the footprint, (n, 3) float32 each.
    """
    found = {}
    for footprint, rows in truth.items():
        number = np.arange(len(rows["B"]))
        answer = lookups(representation, rows, number, footprint="square", count=LOOKUPS, seed=SPLIT)
        found[footprint] = answer["B"], answer["variance"]
    return found


def errors_of(answered: Mapping[str, tuple[np.ndarray, np.ndarray]], truth: Truth) -> Facts:
    """Errors of answers at the rows of every footprint.

    Returns
    -------
    dict
        Footprint → what `btfref.querying.accuracy.accuracy` finds.
    """
    found = {}
    for footprint, (value, variance) in answered.items():
        rows = truth[footprint]
        # Places of the lookups are random as well: their noise is the answer's own.
        both = rows["variance"] + variance
        found[footprint] = accuracy(value, rows["B"], both, (rows["first"], rows["second"]))
    return found


def errors(representation: Representation, truth: Truth) -> Facts:
    """Errors of a representation at the rows of every footprint."""
    return errors_of(answers(representation, truth), truth)


def cells(facts: Facts) -> list[str]:
    """Errors at a footprint as a table shows them: 99 % intervals in brackets."""
    found = []
    for name, (_, form) in COLUMNS.items():
        middle, low, high = (
            "∞" if name == "psnr_log" and float(value) > MOST_DB else form.format(float(value))
            for value in facts[name]
        )
        found.append(f"{middle} ({low} to {high})")
    return found


def packed(truth: Truth) -> dict[str, np.ndarray]:
    """Rows of all footprints as arrays of one file, ``"footprint/column"``."""
    return {f"{footprint}/{name}": a for footprint, rows in truth.items() for name, a in rows.items()}


def unpacked(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """The inverse of `packed`."""
    truth: dict[str, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        footprint, _, column = name.partition("/")
        truth.setdefault(footprint, {})[column] = array
    return truth
