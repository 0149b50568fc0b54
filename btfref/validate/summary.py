"""The matrix in one table: a row a method and mesostructure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.querying import off_grid, split

if TYPE_CHECKING:
    from btfref.types import Facts
    from btfref.validate.run import Validation


#: Columns of stages in the table, by the names of the stages.
STAGES = ("sampled BTF", "fit", "port", "real time", "WebGL 2", "8 bits")

#: Columns of errors at directions that nobody fitted, and their names in `btfref.querying.accuracy.accuracy`.
OFF_GRID = {"off grid ΔE00": "delta_e00", "off grid MAE": "mae"}

HEADER = ["mesostructure", "method", *OFF_GRID, "cells", "bytes", *STAGES, "total", "ΔE00"]


def rows(result: Validation) -> list[list[Any]]:
    """Summary of a `Validation`.

    Returns
    -------
    list of list
        Columns as in `HEADER`: of texels at directions that nobody fitted, root mean square ΔE00 and mean absolute
        error in 1/sr; cells passed of all; bytes of the maps; RMSE of each stage alone and of the whole, root of the
        mean square over the cells of RMSE over the truth's mean; mean ΔE00 of the whole.
    """
    table = []
    for facts in result.methods:
        mine = (facts["mesostructure"], facts["method"])
        cells = [c for c in result.cells if (c.facts["mesostructure"], c.facts["method"]) == mine]
        passed = sum(cell.outcome == "pass" for cell in cells)
        falls = [cell.facts["waterfall"] for cell in cells if cell.facts["waterfall"]]
        between = (facts.get("off_grid") or {}).get(split.SHOWN, {})
        whole = [_relative(fall["total"]["estimate"], fall) for fall in falls]
        colour = [fall["stages"][-1]["delta_e00_so_far"]["estimate"] for fall in falls]
        table.append(
            [
                *mine,
                *(between[name][0] if name in between else None for name in OFF_GRID.values()),
                f"{passed}/{len(cells)}",
                facts.get("bytes"),
                *(_root(_stage(fall, name) for fall in falls) for name in STAGES),
                _root(whole),
                float(np.mean(colour)) if colour else None,
            ]
        )
    return table


def off_grid_rows(result: Validation) -> tuple[list[str], list[list[str]]]:
    """Errors at directions that nobody fitted, with 99 % intervals.

    Returns
    -------
    header : list of str
    rows : list of list of str
        One for each mesostructure, method and footprint; none for methods whose checks failed.
    """
    table = [
        [facts["mesostructure"], facts["method"], footprint, *off_grid.cells(errors)]
        for facts in result.methods
        for footprint, errors in (facts.get("off_grid") or {}).items()
    ]
    return ["mesostructure", "method", "footprint", *off_grid.HEADS], table


def additivity(result: Validation) -> str:
    """How many waterfalls add up, in words: by their stages alone, and together with their covariances."""
    falls = [cell.facts["waterfall"] for cell in result.cells if cell.facts["waterfall"]]
    alone = sum(fall["additive"] for fall in falls)
    explained = sum(fall["explained"] for fall in falls)
    return f"stages alone add up in {alone} cells, stages and covariances in {explained} of {len(falls)} waterfalls"


def _stage(fall: Facts, name: str) -> float | None:
    stages = [*fall["stages"], *fall["parts"]]
    found = [s["rmse"]["estimate"] for s in stages if s["name"] == name]
    return _relative(found[0], fall) if found else None


def _relative(value: float, fall: Facts) -> float | None:
    return value / fall["mean"] if fall["mean"] else None


def _root(values: Iterable[float | None]) -> float | None:
    """Root of the mean square of those that are there; None for none."""
    there = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(there)))) if there else None
