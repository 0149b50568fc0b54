"""Reading a sampled BTF view by view or by rows, whether it stands on disk or in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.directions import DirectionSet
from btfref.sampling.sampled_btf import SampledBTF

if TYPE_CHECKING:
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts

#: Copies of a view while it is read from a store: itself, a file's bytes and what they decode to.
VIEW_COPIES = 4

#: Bytes per value of a picture on its way into a file: in float32, scaled, encoded.
PICTURE_BYTES = 64


class PartReader(Protocol):
    """A sampled BTF of which a view or some rows are read at a time."""

    views: DirectionSet
    lights: DirectionSet
    texels: tuple[int, int]

    def view(self, view: int) -> np.ndarray:
        """Values of a view, shape (lights, rows, columns, 3)."""
        ...

    def rows(self, first: int, last: int) -> np.ndarray:
        """Values of the rows ``first … last − 1``, shape (views, lights, last − first, columns, 3)."""
        ...


class _Stored:
    def __init__(self, store: BTFStore) -> None:
        self._store = store
        self.views, self.lights, self.texels = store.views, store.lights, store.texels

    def view(self, view: int) -> np.ndarray:
        return self._store.read(views=view, variance=False)[0][0]

    def rows(self, first: int, last: int) -> np.ndarray:
        return self._store.read(rows=slice(first, last), variance=False)[0]


class _InMemory:
    def __init__(self, btf: SampledBTF) -> None:
        self._values = btf.values
        self.views, self.lights, self.texels = btf.views, btf.lights, btf.texels

    def view(self, view: int) -> np.ndarray:
        return self._values[view]

    def rows(self, first: int, last: int) -> np.ndarray:
        return self._values[:, :, first:last]


class _Repeated:
    """A tile repeated until there are as many texels as wanted; the last repetition is cut off where it must be."""

    def __init__(self, tile: PartReader, texels: tuple[int, int]) -> None:
        self._tile, self.texels = tile, texels
        self.views, self.lights = tile.views, tile.lights
        self._rows, self._columns = (np.arange(n) % m for n, m in zip(texels, tile.texels, strict=True))

    def view(self, view: int) -> np.ndarray:
        return self._tile.view(view)[:, self._rows[:, None], self._columns]

    def rows(self, first: int, last: int) -> np.ndarray:
        rows, index = np.unique(self._rows[first:last], return_inverse=True)
        values = self._tile.rows(int(rows[0]), int(rows[-1]) + 1)
        return values[:, :, (rows - rows[0])[index][:, None], self._columns]


def open_parts(btf: BTFStore | SampledBTF, texels: int | None = None) -> PartReader:
    """Parts of a `BTFStore` (which must be complete) or a `SampledBTF`.

    Parameters
    ----------
    btf : BTFStore or SampledBTF
    texels : int, optional
        Rows and columns, if not its own: its tile is repeated.

    Returns
    -------
    PartReader
    """
    if texels is not None:
        return _Repeated(open_parts(btf), (texels, texels))
    if isinstance(btf, SampledBTF):
        return _InMemory(btf)
    if not btf.complete:
        raise InputError("incomplete", file=btf.path, field="coverage", got=f"{btf.coverage.mean():.1%}")
    return _Stored(btf)


def one_view(shape: tuple[int, ...], itemsize: int, settings: Facts) -> int:
    """Bytes that a writer holds which goes view by view: ``peak`` of a `btfref.formats.source.Format`."""
    _, n_lights, rows, columns, _ = shape
    picture = 3 * rows * columns
    return VIEW_COPIES * itemsize * n_lights * picture + PICTURE_BYTES * picture
