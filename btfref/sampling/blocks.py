"""A sampled BTF read part by part: what fits take, whether it stands on disk or in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from btfref.conventions import in_one_line
from btfref.errors import InputError
from btfref.sampling.store.store import BTFStore, open_store

if TYPE_CHECKING:
    from pathlib import Path

    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.types import Facts, PathLike


@runtime_checkable
class BTFBlocks(Protocol):
    """A sampled BTF of which a view, or some rows of texels, are read at a time.

    :class:`btfref.sampling.sampled_btf.SampledBTF` satisfies it, and so does :class:`StreamedBTF`: a fit that reads
    nothing else gives the same bytes for both.
    """

    @property
    def views(self) -> DirectionSet:
        """Directions to the viewer."""

    @property
    def lights(self) -> DirectionSet:
        """Directions to the light."""

    @property
    def texels(self) -> tuple[int, int]:
        """Rows and columns."""

    @property
    def dtype(self) -> np.dtype:
        """Type of the values: float16 or float32."""

    @property
    def attributes(self) -> Facts:
        """Conventions, seed, parameters, parent, versions."""

    @property
    def path(self) -> Path | None:
        """Where it was read from."""

    def claim(self, size: int) -> bool:
        """Whether a fit may keep so many bytes of what it would make anew in each pass otherwise.

        It has no influence on any result.
        """

    def view(self, view: int) -> np.ndarray:
        """Values of a view, shape (lights, rows, columns, 3); not to be changed."""

    def rows(self, first: int, last: int) -> np.ndarray:
        """Values of the rows ``first … last − 1``: (views, lights, rows, columns, 3); not to be changed."""


class StreamedBTF:
    """A store whose values stay on disk.

    Parameters
    ----------
    store : BTFStore or path-like
    spare : int
        Bytes in which views, and what fits make of them, may be kept for the next pass. It has no influence on any
        result.

    Raises
    ------
    InputError
        An incomplete store.
    """

    def __init__(self, store: BTFStore | PathLike, *, spare: int = 0) -> None:
        store = store if isinstance(store, BTFStore) else open_store(store)
        refuse_incomplete(store)
        self._store, self._spare = store, spare
        self._kept: dict[int, np.ndarray] = {}
        self._last: tuple[int, np.ndarray] | None = None
        self._band: tuple[int, np.ndarray] | None = None
        self.views, self.lights, self.texels = store.views, store.lights, store.texels
        self.dtype, self.attributes, self.path = store.dtype, store.attributes, store.path
        #: Views and rows that were read, in whole BTFs: what passes a fit makes.
        self.passes = 0.0

    def __repr__(self) -> str:
        size = int(np.prod(self._shape, dtype=np.int64)) * self.dtype.itemsize
        kind = f"StreamedBTF {self.dtype}"
        return in_one_line(kind, self.texels, self.views.facts, self.lights.facts, size)

    @property
    def _shape(self) -> tuple[int, ...]:
        return len(self.views), len(self.lights), *self.texels, 3

    @property
    def keeps_all(self) -> bool:
        """Whether there is room for all views, so that they are read once."""
        return int(np.prod(self._shape, dtype=np.int64)) * self.dtype.itemsize <= self._spare

    def claim(self, size: int) -> bool:
        """See :class:`BTFBlocks`."""
        if size > self._spare:
            return False
        self._spare -= size
        return True

    def view(self, view: int) -> np.ndarray:
        """See :class:`BTFBlocks`."""
        if view in self._kept:
            return self._kept[view]
        if self._last is None or self._last[0] != view:
            self._last = None
            values = self._store.read(views=view, variance=False)[0][0]
            self.passes += 1 / len(self.views)
            if self.claim(values.nbytes):
                self._kept[view] = values
                return values
            self._last = view, values
        return self._last[1]

    def rows(self, first: int, last: int) -> np.ndarray:
        """See :class:`BTFBlocks`."""
        self._last = None
        start = first - first % self.band
        if last > start + self.band:
            self._band = None
            return self._rows(first, last)
        if self._band is None or self._band[0] != start:
            self._band = None
            self._band = start, self._rows(start, min(start + self.band, self.texels[0]))
        return self._band[1][:, :, first - start : last - start]

    @property
    def band(self) -> int:
        """Rows that are read together: a chunk's where there is room for them, else a part of them."""
        row = self.dtype.itemsize * 3 * len(self.views) * len(self.lights) * self.texels[1]
        tile = min(self._store.tile[0], self.texels[0])
        parts = -(-tile // max(1, min(tile, self._spare // row)))
        return -(-tile // parts)

    def _rows(self, first: int, last: int) -> np.ndarray:
        self.passes += (last - first) / self.texels[0]
        return self._store.read(rows=slice(first, last), variance=False)[0]


def texel_values(btf: BTFBlocks, texels: np.ndarray) -> np.ndarray:
    """Values of some texels.

    Parameters
    ----------
    btf : BTFBlocks
    texels : ndarray of int, shape (k,)
        Flat indices. Read by rows where they follow each other, else in one pass over the views.

    Returns
    -------
    ndarray, shape (views, lights, k, 3)
    """
    columns = btf.texels[1]
    if (np.diff(texels) == 1).all():
        first, last = int(texels[0]) // columns, int(texels[-1]) // columns + 1
        rows = btf.rows(first, last)
        start = int(texels[0]) - first * columns
        return rows.reshape(*rows.shape[:2], -1, 3)[:, :, start : start + len(texels)]
    shape = len(btf.lights), -1, 3
    return np.stack([btf.view(view).reshape(shape)[:, texels] for view in range(len(btf.views))])


def refuse_incomplete(store: BTFStore) -> None:
    """InputError for a store of which a part is missing."""
    if store.complete:
        return
    missing = store.attributes.get("parent", {}).get("images_missing")
    raise InputError(
        f"incomplete: {missing} images are missing in what it was made from"
        if missing
        else "incomplete: its run was interrupted; start the same command again to finish it",
        file=store.path,
        field="coverage",
        got=f"{store.coverage.mean():.1%}",
        expected="100%",
    )
