"""Errors of answers to the test queries of a data set, with the noise of the true values taken out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.datasets import sets
from btfref.datasets.making import place
from btfref.datasets.package import Package, open_package
from btfref.errors import InputError
from btfref.querying.accuracy import accuracy

if TYPE_CHECKING:
    from btfref.board.rows import Row
    from btfref.types import Facts, PathLike, Progress


class Truth:
    """The true values of a set's materials, read when they are asked for.

    Parameters
    ----------
    folder : path-like
        Where its packages lie.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = Path(folder)
        self._packages: dict[tuple[str, str, str], Package] = {}
        self._rows: dict[tuple[Path, str], dict[str, np.ndarray]] = {}

    def package(self, name: str, tier: str, material: str) -> Package:
        """An opened package.

        Raises
        ------
        InputError
            No such set, tier or material, or no package of it in the folder.
        """
        key = (name, tier, material)
        if key not in self._packages:
            chosen, found = sets.find(f"{name}/{material}")
            chosen.tier(tier)
            self._packages[key] = open_package(place(self.folder, chosen, tier, found[0]))
        return self._packages[key]

    def rows(self, package: Package, footprint: str) -> dict[str, np.ndarray]:
        """Test queries of a package."""
        key = (package.path, footprint)
        if key not in self._rows:
            self._rows[key] = package.test(footprint)
        return self._rows[key]


def scored(rows: list[Row], truth: Truth, progress: Progress | None = None) -> list[dict[str, Facts]]:
    """Errors of all rows.

    Parameters
    ----------
    rows : list of Row
    truth : Truth
    progress : callable, optional

    Returns
    -------
    list of dict
        For each row material → footprint → what `btfref.querying.accuracy.accuracy` finds.

    Raises
    ------
    InputError
        Answers of another number of rows, or that are not finite; a row of another version of the set.
    """
    result = []
    for number, row in enumerate(rows):
        if progress is not None:
            progress(number, len(rows), "scores")
        result.append({material: _errors(row, material, truth) for material in row.materials})
    return result


def _errors(row: Row, material: str, truth: Truth) -> Facts:
    package = truth.package(row.facts["set"], row.facts["tier"], material)
    version = package.manifest["set_version"]
    if row.facts["set_version"] != version:
        raise InputError(
            "a row of another version of the set",
            file=row.path,
            field="set_version",
            got=row.facts["set_version"],
            expected=version,
        )
    path = row.materials[material]["answers"]
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError("answers cannot be read", file=path, got=error) from None
    parts = [truth.rows(package, footprint) for footprint in sets.FOOTPRINTS]
    n = sum(len(part["B"]) for part in parts)
    if values.shape != (n, 3) or values.dtype.kind != "f" or not np.isfinite(values).all():
        raise InputError(
            "answers that cannot be judged",
            file=path,
            got=f"{values.dtype} {values.shape}",
            expected=f"finite floats ({n}, 3)",
        )
    found, first = {}, 0
    for footprint, part in zip(sets.FOOTPRINTS, parts, strict=True):
        last = first + len(part["B"])
        halves = (part["first"], part["second"])
        found[footprint] = accuracy(values[first:last], part["B"], part["variance"], halves)
        first = last
    return found
