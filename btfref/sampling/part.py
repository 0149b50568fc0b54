"""A part of a sampled BTF: some views, some lights, some tiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.errors import InputError


@dataclass(frozen=True)
class Part:
    """What to fill of a store.

    Attributes
    ----------
    views, lights : sequence of int, or None
        Indices; None for all.
    tiles : sequence of int, or None
        Numbers of tiles of texels, row by row; None for all.
    """

    views: tuple | None = None
    lights: tuple | None = None
    tiles: tuple | None = None

    def indices(self, store):
        """Indices of views and lights, and (rows, columns) of the tiles.

        Raises
        ------
        InputError
            An index out of range.
        """
        rows, columns = store.coverage.shape[2:]
        views = _checked("views", self.views, len(store.views))
        lights = _checked("lights", self.lights, len(store.lights))
        tiles = _checked("tiles", self.tiles, rows * columns)
        return views, lights, (tiles // columns, tiles % columns)

    def mask(self, store):
        """Texels of the part's tiles: (rows · columns,) bool."""
        rows, columns = store.texels
        _, _, tiles = self.indices(store)
        wanted = np.zeros(store.coverage.shape[2:], bool)
        wanted[tiles] = True
        row, column = np.arange(rows) // store.tile[0], np.arange(columns) // store.tile[1]
        return wanted[np.ix_(row, column)].ravel()


def _checked(name, chosen, n):
    if chosen is None:
        return np.arange(n)
    index = np.unique(np.asarray(list(chosen), dtype=np.int64)) if len(chosen) else np.zeros(0, np.int64)
    if not len(index) or index[0] < 0 or index[-1] >= n:
        raise InputError("part of a BTF", field=name, got=list(chosen), expected=f"indices 0 … {n - 1}")
    return index
