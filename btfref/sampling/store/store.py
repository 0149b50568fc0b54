"""A sampled BTF on disk: parts of it read, views of it written; `layout` says what the files are."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from btfref.conventions import in_one_line
from btfref.errors import InputError
from btfref.numerics.sphere.directions import checked
from btfref.outputs import refuse_existing, require_folder_of
from btfref.sampling.store.arrays import Choice, StoredArray, along_axis
from btfref.sampling.store.facts import store_facts
from btfref.sampling.store.layout import TILE, attributes_of, check_finite, lay_out_whole, write_headers
from btfref.sampling.store.shards import Marks, Shards, is_of_layout

if TYPE_CHECKING:
    from zarr.storage import StoreLike

    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.types import Facts, PathLike

_T = TypeVar("_T")

#: Errors of a place and not of what stands there: full, too large, read-only, not permitted, too many files.
OF_THE_SYSTEM = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
)


def create_store(
    path: PathLike,
    *,
    views: DirectionSet,
    lights: DirectionSet,
    texels: tuple[int, int],
    dtype: str = "float16",
    variance: bool = True,
    tile: int = TILE,
    attributes: Facts | None = None,
    adaptive: bool = False,
) -> BTFStore:
    """An empty store; it appears under its name only when all its headers are there.

    Parameters
    ----------
    path : path-like
        Must not exist.
    views, lights : DirectionSet
    texels : tuple of int
        Rows and columns.
    dtype : {"float16", "float32"}
        Type of the values.
    variance : bool
        Whether the variance of the mean is stored.
    tile : int
        Texels along one side of an inner chunk.
    attributes : dict, optional
        JSON types, beside the conventions: seed, parameters, parent, versions …
    adaptive : bool
        Whether the store has the arrays of a synthesis to a target error.

    Returns
    -------
    BTFStore

    Raises
    ------
    InputError
        The path exists, or its folder does not.
    """
    path = Path(path)
    refuse_existing(path)
    require_folder_of(path)
    headers = (views, lights, texels, dtype, variance, tile, attributes, adaptive)
    lay_out_whole(path, lambda draft: write_headers(draft, *headers))
    return BTFStore(path)


def open_store(path: PathLike) -> BTFStore:
    """Open a store without reading values.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    BTFStore

    Raises
    ------
    InputError
        Not a sampled BTF, or a damaged one.
    """
    return BTFStore(path)


class BTFStore:
    """A sampled BTF on disk.

    Attributes
    ----------
    path : Path
    attributes : dict
        Conventions, parameters, parent, versions.
    views, lights : DirectionSet
    texels : tuple of int
        Rows and columns.
    dtype : numpy.dtype
        Type of the stored values.
    has_variance : bool
    """

    def __init__(self, path: PathLike, *, store: StoreLike | None = None) -> None:
        import zarr

        self.path = Path(path)
        self.attributes = attributes_of(self.path)
        self._group = self._guard("zarr.json", lambda: zarr.open_group(store or str(self.path), mode="r+"))
        self._values = self._array("values", 5)
        self.has_variance = "variance" in self.attributes.get("arrays", ())
        self._variance = self._array("variance", 5) if self.has_variance else None
        self._coverage = self._array("coverage", 4)
        names = self.attributes.get("directions", {})
        self.views, self.lights = (
            self._directions(key, names.get(key, "custom")) for key in ("views", "lights")
        )
        self.dtype = np.dtype(self._values.dtype)
        n_views, n_lights, rows, columns, channels = self._values.shape
        self.texels, self.tile = (rows, columns), (self._values.chunks[2], self._values.chunks[3])
        if (n_views, n_lights, channels) != (len(self.views), len(self.lights), 3) or 0 in (rows, columns):
            raise InputError(
                "values and directions do not fit",
                file=self.path,
                field="values",
                got=self._values.shape,
                expected=f"({len(self.views)}, {len(self.lights)}, rows, columns, 3)",
            )
        if self.dtype not in (np.float16, np.float32):
            raise InputError(
                "type of the values", file=self.path, field="values", got=self.dtype, expected="float16/32"
            )
        if self._variance is not None and self._variance.shape != self._values.shape:
            raise InputError(
                "variance and values do not fit", file=self.path, field="variance", got=self._variance.shape
            )
        self._shards = {
            name: self._shards_of(name, array)
            for name, array in (("values", self._values), ("variance", self._variance))
            if array is not None
        }
        self._marks = Marks(self.path / "coverage", self._coverage.shape[1:])
        # Arrays that were coded elsewhere, or lie elsewhere, are Zarr's to read.
        arrays = [(self._values, True), (self._variance, True), (self._coverage, False)]
        self._local = store is None and all(
            self._guard("codecs", partial(is_of_layout, array, sharded=sharded))
            for array, sharded in arrays
            if array is not None
        )

    def __repr__(self) -> str:
        kind = f"BTFStore {self.dtype}"
        size = int(np.prod(self._values.shape, dtype=np.int64)) * self.dtype.itemsize
        return in_one_line(kind, self.texels, self.views.facts, self.lights.facts, size)

    def _guard(self, field: str, action: Callable[[], _T]) -> _T:
        """Whatever Zarr makes of a damaged file becomes one clear line; a full disk is no damage."""
        try:
            return action()
        except InputError:
            raise
        except MemoryError:
            raise
        except OSError as error:
            if error.errno in OF_THE_SYSTEM:
                raise OSError(error.errno, os.strerror(error.errno), str(self.path)) from error
            raise InputError("damaged store", file=self.path, field=field, got=error) from error
        except Exception as error:
            raise InputError("damaged store", file=self.path, field=field, got=error) from error

    def _array(self, name: str, ndim: int) -> StoredArray:
        array = cast("StoredArray", self._guard(name, lambda: self._group[name]))
        if getattr(array, "ndim", None) != ndim:
            raise InputError("damaged store", file=self.path, field=name, expected=f"an array of {ndim} axes")
        return array

    def _shards_of(self, name: str, array: StoredArray) -> Shards:
        """The files of an array."""
        chunk, shard = array.chunks, array.shards or array.chunks
        grid = (shard[1], shard[2] // chunk[2], shard[3] // chunk[3])
        return Shards(self.path / name, np.dtype(array.dtype), (chunk[2], chunk[3]), grid)

    def _directions(self, name: str, spec: str) -> DirectionSet:
        array = self._array(name, 2)
        return checked(self._guard(name, lambda: array[:]), spec, file=self.path)

    @property
    def coverage(self) -> np.ndarray:
        """Which parts are there: bool, shape (views, lights, tile rows, tile columns)."""
        if not self._local:
            return self._guard("coverage", lambda: self._coverage[:]) == 1
        return np.stack([self.covered(view) for view in range(len(self.views))])

    @property
    def complete(self) -> bool:
        """Whether every view, light and tile is there."""
        return bool(self.coverage.all())

    def info(self) -> Facts:
        """Header facts, without reading values.

        Returns
        -------
        dict
            JSON types: kind, shape, directions, type, bytes, coverage, attributes.
        """
        return store_facts(self)

    @property
    def shard(self) -> tuple[int, int]:
        """Tile rows and tile columns that one file holds."""
        shards = self._values.shards
        sides = (shards or self._values.chunks)[2:4]
        return sides[0] // self.tile[0], sides[1] // self.tile[1]

    def covered(self, view: int) -> np.ndarray:
        """Which parts of a view are there: bool, shape (lights, tile rows, tile columns)."""
        if not self._local:
            return self._guard("coverage", lambda: self._coverage[int(view)]) == 1
        return self._guard("coverage", lambda: self._marks.read(int(view))) == 1

    def write_map(self, name: str, view: int, values: np.ndarray) -> None:
        """Write a view of an array that `maps` gives."""
        self._guard(name, lambda: self._map(name).__setitem__(int(view), values))

    def maps(self, name: str) -> StoredArray | None:
        """The Zarr array "pilot", "samples" or "reached" of a store made to a target error, else None."""
        return cast("StoredArray", self._group[name]) if name in self._group else None

    def read_map(self, name: str, view: int) -> np.ndarray:
        """A view of an array that `maps` gives.

        Raises
        ------
        InputError
            A store that was not made to a target error.
        """
        return self._guard(name, lambda: self._map(name)[int(view)])

    def _map(self, name: str) -> StoredArray:
        array = self.maps(name)
        if array is None:
            raise InputError("not made to a target error", file=self.path, field=name)
        return array

    def write_view(self, view: int, values: np.ndarray, variance: np.ndarray | None = None) -> None:
        """Store one view; it counts as there only when all of it is on disk.

        Parameters
        ----------
        view : int
        values : ndarray, shape (lights, rows, columns, 3)
            B in 1/sr, finite; rounded to the stored type.
        variance : ndarray of the same shape, optional
            Variance of the mean; wanted exactly when the store keeps it.

        Raises
        ------
        InputError
            Wrong shape, a value that is not finite, or one beyond the stored type.
        """
        tiles = np.divmod(np.arange(self.coverage_shape[0] * self.coverage_shape[1]), self.coverage_shape[1])
        self.write_part(view, np.arange(len(self.lights)), tiles, values, variance)

    @property
    def coverage_shape(self) -> tuple[int, int]:
        """Tile rows and tile columns of the whole."""
        rows, columns = self._coverage.shape[2:]
        return rows, columns

    def write_part(
        self,
        view: int,
        lights: np.ndarray,
        tiles: tuple[np.ndarray, np.ndarray],
        values: np.ndarray,
        variance: np.ndarray | None = None,
        *,
        origin: tuple[int, int] = (0, 0),
    ) -> None:
        """Store some tiles of some lights of one view; errors as of `write_view`.

        Parameters
        ----------
        view : int
        lights : ndarray of int
        tiles : (ndarray, ndarray) of int
            Rows and columns of the tiles.
        values, variance : ndarray, shape (lights chosen, rows, columns, 3)
            Texels from `origin` on, up to the last of these tiles at least; only the tiles are taken.
        origin : tuple of int
            Row and column of the first texel given.
        """
        if (variance is not None) != self.has_variance:
            raise InputError(
                "variance of a view", file=self.path, expected="given" if self.has_variance else "none"
            )
        if not self._local:
            raise InputError(
                "files that are coded otherwise can only be read", file=self.path, expected="a new store"
            )
        places = np.stack(tiles, 1)
        end = [min(n, (last + 1) * t) - o for n, last, t, o in zip(
            self.texels, places.max(0), self.tile, origin, strict=True)]  # fmt: skip
        for field, array, shards in (
            ("values", values, self._shards["values"]),
            ("variance", variance, self._shards.get("variance")),
        ):
            if array is None or shards is None:
                continue
            shape = (len(lights), *array.shape[1:3], 3)
            if array.shape != shape or array.shape[1] < end[0] or array.shape[2] < end[1]:
                expected = f"({len(lights)}, {end[0]}, {end[1]}, 3)"
                raise InputError(
                    "wrong shape", file=self.path, field=field, got=array.shape, expected=expected
                )
            self._check(array, places, origin, shards.dtype, field)
            self._write_shards(shards, field, int(view), np.asarray(lights), places, array, origin)
        self._guard("coverage", lambda: self._marks.note(int(view), lights, places))

    def _check(
        self, array: np.ndarray, places: np.ndarray, origin: tuple[int, int], dtype: np.dtype, field: str
    ) -> None:
        """InputError for a value that is not finite or beyond a type, with its place."""
        corner = [k * t - o for k, t, o in zip(places.min(0), self.tile, origin, strict=True)]
        spans = places.max(0) - places.min(0) + 1
        whole = len(places) == spans.prod()
        for first in [corner] if whole else places * self.tile - origin:
            sides = spans * self.tile if whole else self.tile
            part = array[:, first[0] : first[0] + sides[0], first[1] : first[1] + sides[1]]
            with np.errstate(over="ignore"):
                # Rounding keeps the order, and what is no number is both the least and the largest.
                if np.isfinite([dtype.type(part.min()), dtype.type(part.max())]).all():
                    continue
                check_finite(part.astype(dtype), self.path, field)

    def _write_shards(
        self,
        shards: Shards,
        field: str,
        view: int,
        lights: np.ndarray,
        places: np.ndarray,
        array: np.ndarray,
        origin: tuple[int, int],
    ) -> None:
        """Write tiles of lights, file by file; what a file has beside them is kept."""
        n_lights, *grid = shards.grid
        for part in np.unique(lights // n_lights):
            mine = np.flatnonzero(lights // n_lights == part)
            some = array if len(mine) == len(lights) else array[mine]
            for row, column in np.unique(places // grid, axis=0).tolist():
                corner = np.array([row * grid[0], column * grid[1]])
                inside = places[(places // grid == (row, column)).all(1)] - corner
                start = [o - k * t for o, k, t in zip(origin, corner.tolist(), self.tile, strict=True)]
                arguments = (lights[mine] % n_lights, inside, some, (start[0], start[1]))
                self._guard(field, partial(shards.write, view, (int(part), row, column), *arguments))

    def read(
        self,
        *,
        views: Choice = None,
        lights: Choice = None,
        rows: Choice = None,
        columns: Choice = None,
        variance: bool = True,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Read a part; only the chunks that hold it are touched.

        Parameters
        ----------
        views, lights, rows, columns : None, int, slice or sequence of int
            None for all. An int keeps its axis with length one.
        variance : bool
            Whether to read the variance, where the store has it.

        Returns
        -------
        values : ndarray, shape (views, lights, rows, columns, 3)
        variance : ndarray float32 or None

        Raises
        ------
        InputError
            The part is not there yet, an index is out of range, a file is missing or damaged, or a value is
            not finite.
        """
        lengths = self._values.shape[:4]
        axes = zip(
            ("views", "lights", "rows", "columns"), (views, lights, rows, columns), lengths, strict=True
        )
        selection = [along_axis(name, index, n) for name, index, n in axes]
        indices = [np.arange(n)[chosen] for chosen, n in zip(selection, lengths, strict=True)]
        tiles = [np.unique(index // size) for index, size in zip(indices[2:], self.tile, strict=True)]
        # Marks of these views alone: who goes through all views reads each one's once.
        there = np.stack([self.covered(view) for view in indices[0].tolist()])
        covered = there[np.ix_(np.arange(len(there)), indices[1], *tiles)]
        if not covered.all():
            raise InputError(
                "part that is not there yet (interrupted run?)",
                file=self.path,
                field="coverage",
                got=f"{covered.mean():.1%} of it",
                expected="all",
            )
        values = self._read("values", self._values, selection)
        wanted = self._variance if variance else None
        return values, None if wanted is None else self._read("variance", wanted, selection)

    def _read(self, field: str, array: StoredArray, selection: Sequence[slice | np.ndarray]) -> np.ndarray:
        sides = zip(selection[1:4:2], array.shape[1:4:2], strict=True)
        whole = all(isinstance(part, slice) and part.indices(n) == (0, n, 1) for part, n in sides)
        rows = np.arange(array.shape[2])[selection[2]]
        together = len(rows) > 0 and (np.diff(rows) == 1).all()
        selection = (*selection, slice(None))
        if self._local and whole and together:
            # Whole files at once, or the chunks of some rows: Zarr spends a call or more on each chunk.
            views = np.arange(len(self.views))[selection[0]]
            values = np.zeros(
                (len(views), array.shape[1], len(rows), *array.shape[3:]), self._shards[field].dtype
            )
            for place, view in zip(values, views.tolist(), strict=True):
                self._guard(field, partial(self._shards[field].read, view, place, int(rows[0])))
        elif all(isinstance(part, slice) for part in selection):
            values = self._guard(field, lambda: array[selection])
        else:
            values = self._guard(field, lambda: array.oindex[selection])
        check_finite(values, self.path, field)
        if field == "variance" and values.size and values.min() < 0:
            raise InputError(
                "negative variance", file=self.path, field=field, got=values.min(), expected="≥ 0"
            )
        return values
