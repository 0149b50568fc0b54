"""A selection of a sampled BTF: some pairs of views and lights, some tiles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.sampling.store.store import BTFStore


@dataclass(frozen=True)
class Selection:
    """What to fill of a store.

    Attributes
    ----------
    views, lights : sequence of int, or None
        Indices; None for all.
    tiles : sequence of int, or None
        Numbers of tiles of texels, row by row; None for all.
    pairs : sequence of (int, sequence of int), or None
        In place of views and lights: views, each once, with the lights that are wanted of them, at least one.
    """

    views: Sequence[int] | None = None
    lights: Sequence[int] | None = None
    tiles: Sequence[int] | None = None
    pairs: Sequence[tuple[int, Sequence[int]]] | None = None

    @classmethod
    def of_pairs(cls, pairs: np.ndarray, tiles: Iterable[int] | None = None) -> Selection:
        """The part of some pairs; plain views and lights where these are all their pairs.

        Parameters
        ----------
        pairs : ndarray of bool, shape (n_views, n_lights)
            At least one.
        tiles : sequence of int, optional

        Returns
        -------
        Selection
        """
        views, lights = (tuple(np.flatnonzero(pairs.any(axis)).tolist()) for axis in (1, 0))
        tiles = None if tiles is None else tuple(tiles)
        if pairs.sum() == len(views) * len(lights):
            return cls(views, lights, tiles)
        return cls(tiles=tiles, pairs=tuple((v, tuple(np.flatnonzero(pairs[v]).tolist())) for v in views))

    def indices(self, store: BTFStore) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """What it spans.

        Returns
        -------
        views : ndarray of int
        lights : ndarray of int
            That any of the views wants.
        tiles : (ndarray, ndarray) of int
            Rows and columns.

        Raises
        ------
        InputError
            An index out of range.
        """
        wanted = self.wanted(store)
        columns = store.coverage_shape[1]
        tiles = _checked("tiles", self.tiles, int(np.prod(store.coverage_shape)))
        return (
            np.flatnonzero(wanted.any(1)),
            np.flatnonzero(wanted.any(0)),
            (tiles // columns, tiles % columns),
        )

    def wanted(self, store: BTFStore) -> np.ndarray:
        """Pairs that belong to it: (views, lights) bool; errors as of `indices`."""
        n_views, n_lights = len(store.views), len(store.lights)
        result = np.zeros((n_views, n_lights), bool)
        if self.pairs is None:
            views, lights = _checked("views", self.views, n_views), _checked("lights", self.lights, n_lights)
            result[np.ix_(views, lights)] = True
            return result
        if self.views is not None or self.lights is not None:
            raise InputError("part of a BTF", field="pairs", got="views or lights beside", expected="either")
        named = [view for view, _ in self.pairs]
        if len(_checked("pairs", named, n_views)) < len(named):
            raise InputError("part of a BTF", field="pairs", got=named, expected="each view once")
        for view, some in self.pairs:
            result[view, _checked("pairs", some, n_lights)] = True
        return result

    def mask(self, store: BTFStore) -> np.ndarray:
        """Texels of the part's tiles: (rows · columns,) bool."""
        rows, columns = store.texels
        _, _, tiles = self.indices(store)
        wanted = np.zeros(store.coverage_shape, bool)
        wanted[tiles] = True
        row, column = np.arange(rows) // store.tile[0], np.arange(columns) // store.tile[1]
        return wanted[np.ix_(row, column)].ravel()


def _checked(name: str, chosen: Sequence[int] | None, n: int) -> np.ndarray:
    if chosen is None:
        return np.arange(n)
    index = np.unique(np.asarray(list(chosen), dtype=np.int64)) if len(chosen) else np.zeros(0, np.int64)
    if not len(index) or index[0] < 0 or index[-1] >= n:
        raise InputError("part of a BTF", field=name, got=list(chosen), expected=f"indices 0 … {n - 1}")
    return index
