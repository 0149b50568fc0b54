"""Order of methods over materials, and how sure it is.

A method's score is the geometric mean over the materials of its error over the smallest of that material, errors below
1 % counted as 1 %: 1 is the best on all of them. Only rows that answered as many materials as any are ranked. Which
materials a set has is a choice, and errors have intervals: places are told as the middle 90 % of those over random sets
of materials, drawn with replacement, with errors drawn from their intervals.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.types import Facts

#: Random sets of materials, and their seed.
DRAWS, SEED = 2000, 20_260_101

#: Standard deviations to either end of an interval of 99 %.
_Z99 = 2.5758

#: Errors are not counted as smaller than this: what is exact on the easiest material would win any mean of ratios.
_LEAST = 0.01


def ranked(errors: list[dict[str, Facts]], *, footprint: str = "point", metric: str = "nrmse") -> list[Facts]:
    """Places of rows.

    Parameters
    ----------
    errors : list of dict
        Of `btfref.board.scoring.scored`.
    footprint, metric : str

    Returns
    -------
    list of dict
        For each row ``score``, ``place`` (1 is the best), ``from`` and ``to`` (the middle 90 %), ``places``: by
        material; all None but ``places`` for a row that left materials out.
    """
    count = Counter(frozenset(row) for row in errors)
    common = max(count, key=lambda names: (len(names), count[names])) if count else frozenset()
    names = sorted(common)
    whole = [k for k, row in enumerate(errors) if set(row) >= common]
    result: list[Facts] = [{"score": None, "place": None, "from": None, "to": None} for _ in errors]
    table = np.array([[errors[k][name][footprint][metric] for name in names] for k in whole], float)
    if table.size:
        middle = _floored(table[..., 0])
        score = _scores(middle)
        places = _places(score)
        drawn = _drawn(table)
        for i, k in enumerate(whole):
            low, high = np.quantile(drawn[:, i], (0.05, 0.95), method="nearest")
            result[k] |= {
                "score": float(score[i]),
                "place": int(places[i]),
                "from": int(low),
                "to": int(high),
            }
    by_material = _by_material(errors, footprint, metric)
    return [row | {"places": found} for row, found in zip(result, by_material, strict=True)]


def _floored(values: np.ndarray) -> np.ndarray:
    return np.maximum(values, _LEAST)


def _scores(values: np.ndarray) -> np.ndarray:
    """Scores (…, rows) of errors (…, rows, materials)."""
    return np.exp(np.log(values / values.min(axis=-2, keepdims=True)).mean(axis=-1))


def _places(score: np.ndarray) -> np.ndarray:
    """Places from 1; equals share the better one."""
    return 1 + (score[..., None, :] < score[..., :, None]).sum(-1)


def _drawn(table: np.ndarray) -> np.ndarray:
    """Places (draws, rows) over random sets of materials and random errors."""
    rng = np.random.default_rng(SEED)
    n = table.shape[1]
    spread = (table[..., 2] - table[..., 1]) / (2 * _Z99)
    chosen = rng.integers(n, size=(DRAWS, n))
    values = table[..., 0][:, chosen] + spread[:, chosen] * rng.standard_normal((len(table), DRAWS, n))
    return _places(_scores(_floored(np.moveaxis(values, 1, 0))))


def _by_material(errors: list[dict[str, Facts]], footprint: str, metric: str) -> list[dict[str, int]]:
    """Place of each row at each of its materials."""
    result: list[dict[str, int]] = [{} for _ in errors]
    for name in sorted({name for row in errors for name in row}):
        having = [k for k, row in enumerate(errors) if name in row]
        places = _places(np.array([errors[k][name][footprint][metric][0] for k in having]))
        for k, place in zip(having, places, strict=True):
            result[k][name] = int(place)
    return result
