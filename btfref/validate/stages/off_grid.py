"""The truth at directions that nobody fitted, made once for each mesostructure, and the errors of fits there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.provenance.code import code_of
from btfref.querying.off_grid import errors, packed, true_rows, unpacked
from btfref.validate.cache import key_of

if TYPE_CHECKING:
    from btfref.types import Facts
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings


def truth_key(mesostructure: str, settings: Settings) -> str:
    """Key of the rows of a mesostructure: no setting of the fits but the width of their texels."""
    from btfref.mesostructure import place

    named = ("texels", "off_grid_rows", "off_grid_spp")
    facts = {name: getattr(settings, name) for name in named}
    return key_of(
        {"off grid": mesostructure, **facts, "code": code_of(__name__, places=(place(mesostructure),))}
    )


def make_truth(cache: Cache, mesostructure: str, settings: Settings) -> Path:
    """Trace the rows of a mesostructure, unless that is done.

    Returns
    -------
    pathlib.Path
    """

    def save(path: Path) -> None:
        rows = true_rows(mesostructure, settings.off_grid_rows, settings.off_grid_spp, settings.texels)
        arrays: Facts = packed(rows)
        np.savez(path, **arrays)

    return cache.get(truth_key(mesostructure, settings), ".offgrid.npz", save)


def off_grid_errors(cache: Cache, mesostructure: str, file: Path, settings: Settings) -> Facts:
    """Errors of a fit at those rows.

    Returns
    -------
    dict
        Footprint → what `btfref.querying.accuracy.accuracy` finds.
    """
    from btfref.representations import load

    with np.load(make_truth(cache, mesostructure, settings)) as stored:
        return errors(load(file), unpacked(stored))
