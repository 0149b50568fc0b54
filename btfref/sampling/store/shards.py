"""Files of values as bytes, written in one pass: Zarr v3 shards of the one kind that `layout` lays out.

A shard is its inner chunks one after the other, each with its checksum, then where each begins and how long it is, with
a checksum of that. Zarr reads and writes them too, but spends a Python call or more on each chunk; a view has one for
each light.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from btfref.sampling.store.layout import DRAFT

if TYPE_CHECKING:
    from btfref.sampling.store.arrays import StoredArray
    from btfref.types import Facts

#: Codecs of a chunk, and of a shard's index.
_PLAIN = ["bytes", "crc32c"]

#: Bytes of a checksum, CRC-32C.
_SUM = 4

#: Offset and length of a chunk that is not there.
_ABSENT = np.uint64(2**64 - 1)


def checksum(data: np.ndarray) -> bytes:
    """CRC-32C as Zarr's codec writes it: little-endian."""
    import google_crc32c

    return struct.pack("<I", google_crc32c.value(data))


def write_bytes(path: Path, *parts: np.ndarray | bytes) -> None:
    """A file of some parts, written under a temporary name first.

    Parameters
    ----------
    path : Path
        Its folder is made where it is missing.
    *parts : ndarray or bytes
    """
    draft = path.with_name(path.name + DRAFT)
    try:
        file = open(draft, "wb", buffering=0)
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(draft, "wb", buffering=0)
    try:
        with file:
            for part in parts:
                rest = (part.data if isinstance(part, np.ndarray) else memoryview(part)).cast("B")
                while len(rest):  # a system may take less than it is given
                    rest = rest[file.write(rest) :]
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def is_of_layout(array: StoredArray, *, sharded: bool) -> bool:
    """Whether an array's files are coded as `layout` does it: plain chunks with checksums, in shards for values.

    Others, such as compressed ones that Zarr wrote elsewhere, are Zarr's to read.
    """
    facts = array.metadata.to_dict()
    codecs = _named(facts["codecs"])
    if sharded:
        if [name for name, _ in codecs] != ["sharding_indexed"]:
            return False
        told = codecs[0][1]
        inner = (
            [name for name, _ in _named(told["codecs"])],
            [name for name, _ in _named(told["index_codecs"])],
        )
        known = inner == (_PLAIN, _PLAIN) and told.get("index_location", "end") == "end"
    else:
        known = [name for name, _ in codecs] == _PLAIN
    big = '"big"' in json.dumps(facts["codecs"], default=str)
    keys = facts["chunk_key_encoding"] == {"name": "default", "configuration": {"separator": "/"}}
    alone = (array.shards or array.chunks)[0] == 1 and not facts.get("storage_transformers")
    return known and keys and alone and not big


def _named(codecs: Iterable[Any]) -> list[tuple[str, Facts]]:
    return [(codec["name"], codec.get("configuration", {})) for codec in codecs]


@dataclass(frozen=True)
class Marks:
    """What is there of each view: a file a view, one chunk of uint8.

    Attributes
    ----------
    folder : Path
        Of the array.
    shape : tuple of int
        Lights, tile rows, tile columns.
    """

    folder: Path
    shape: tuple[int, ...]

    def read(self, view: int) -> np.ndarray:
        """Marks of a view, 1 for what is there; 0 everywhere where nothing was written.

        Raises
        ------
        ValueError
            A length or checksum that is wrong.
        """
        path = self._path(view)
        try:
            data = np.fromfile(path, np.uint8)
        except FileNotFoundError:
            return np.zeros(self.shape, np.uint8)
        size = int(np.prod(self.shape))
        if len(data) != size + _SUM or checksum(data[:size]) != data[size:].tobytes():
            raise ValueError(f"length or checksum of {path.name}")
        return data[:size].reshape(self.shape)

    def note(self, view: int, lights: np.ndarray, places: np.ndarray) -> None:
        """Mark tiles of lights; a view that is there whole is marked without a look at its marks."""
        whole = len(lights) * len(places) == np.prod(self.shape)
        marks = np.zeros(self.shape, np.uint8) if whole else self.read(view)
        for row, column in places:
            marks[lights, row, column] = 1
        data = marks.reshape(-1)
        write_bytes(self._path(view), data, checksum(data))

    def _path(self, view: int) -> Path:
        return self.folder.joinpath("c", str(view), "0", "0", "0")


@dataclass
class Shards:
    """Files of one array (view, light, row, column, 3), a shard each.

    Attributes
    ----------
    folder : Path
        Of the array.
    dtype : numpy.dtype
    tile : (int, int)
        Rows and columns of an inner chunk.
    grid : (int, int, int)
        Lights, tile rows and tile columns of a shard.
    """

    folder: Path
    dtype: np.dtype
    tile: tuple[int, int]
    grid: tuple[int, int, int]

    def __post_init__(self) -> None:
        # New memory costs as much as filling it: one buffer serves all files.
        self._buffer = np.zeros(0, np.uint8)

    @property
    def _chunk(self) -> int:
        """Bytes of a chunk's values."""
        return self.dtype.itemsize * 3 * self.tile[0] * self.tile[1]

    def path(self, view: int, shard: tuple[int, int, int]) -> Path:
        """Name of a shard: that of its lights, rows and columns."""
        return self.folder.joinpath("c", str(view), *map(str, shard), "0")

    def write(
        self,
        view: int,
        shard: tuple[int, int, int],
        lights: np.ndarray,
        tiles: np.ndarray,
        values: np.ndarray,
        origin: tuple[int, int],
    ) -> None:
        """Write chunks of one shard; others that its file has are kept as they are.

        Parameters
        ----------
        view : int
        shard : (int, int, int)
        lights : ndarray of int
            Inside the shard, ascending.
        tiles : ndarray (k, 2) of int
            Rows and columns of tiles inside the shard, row by row.
        values : ndarray (lights, rows, columns, 3)
            Rounded to the stored type, which must hold them.
        origin : (int, int)
            Row and column inside the shard of the first texel of ``values``, or before it where negative.

        Raises
        ------
        ValueError
            A file that is there and is no shard.
        """
        path, count, size = self.path(view, shard), int(np.prod(self.grid)), self._chunk + _SUM
        number = (lights[:, None] * self.grid[1] + tiles[:, 0]) * self.grid[2] + tiles[:, 1]
        kept: dict[int, np.ndarray] = {}
        if number.size < count:
            kept = self._chunks(path)
            for key in number.flat:
                kept.pop(int(key), None)
        order = np.sort(np.concatenate([number.ravel(), np.fromiter(kept, np.int64, len(kept))]))
        if self._buffer.size < len(order) * size:
            self._buffer = np.zeros(len(order) * size, np.uint8)
        data = self._buffer[: len(order) * size].reshape(-1, size)
        place = np.searchsorted(order, number)
        for key, chunk in kept.items():
            data[np.searchsorted(order, key)] = chunk
        inner = np.ndarray(
            (len(data), *self.tile, 3), self.dtype, data,
            strides=(size, *np.cumprod([self.dtype.itemsize, 3, self.tile[1]])[::-1].tolist()),
        )  # fmt: skip
        for tile, rows in zip(tiles.tolist(), place.T, strict=True):
            first = [k * t - o for k, t, o in zip(tile, self.tile, origin, strict=True)]
            part = values[:, first[0] : first[0] + self.tile[0], first[1] : first[1] + self.tile[1]]
            # A slice copies nothing.
            some = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] == len(rows) - 1 else rows
            if part.shape[1:3] != self.tile:
                inner[some] = np.nan
            inner[some, : part.shape[1], : part.shape[2]] = part
        for row in place.ravel():
            data[row, -_SUM:] = np.frombuffer(checksum(data[row, :-_SUM]), np.uint8)
        index = np.full((count, 2), _ABSENT, np.uint64)
        index[order] = np.stack([np.arange(len(order)) * size, np.full(len(order), size)], 1)
        where = index.reshape(-1).view(np.uint8)
        write_bytes(path, data, where, checksum(where))

    def read(self, view: int, values: np.ndarray, first: int = 0) -> None:
        """Read rows of a view into an array (lights, rows, columns, 3); files and chunks of other rows are not touched.

        Parameters
        ----------
        view : int
        values : ndarray
            All lights and columns.
        first : int
            Row of the view that ``values`` begin with.

        Raises
        ------
        ValueError
            A file that is missing, incomplete or damaged.
        """
        lights, rows, columns = (k * t for k, t in zip(self.grid, (1, *self.tile), strict=True))
        last = first + values.shape[1]
        for light in range(-(-values.shape[0] // lights)):
            for row in range(first // rows, -(-last // rows)):
                for column in range(-(-values.shape[2] // columns)):
                    start, end = max(first, row * rows), min(last, (row + 1) * rows)
                    part = values[
                        light * lights : (light + 1) * lights,
                        start - first : end - first,
                        column * columns : (column + 1) * columns,
                    ]
                    self._read_shard(self.path(view, (light, row, column)), part, start - row * rows)

    def _read_shard(self, path: Path, part: np.ndarray, first: int) -> None:
        """Rows of a shard from ``first`` on, into an array that ends where the view does."""
        tile_rows, tile_columns = self.tile
        last = first + part.shape[1]
        tiles = range(first // tile_rows, -(-last // tile_rows))
        # All of a file in one go, or, of a few rows, no more than their chunks.
        mode: Literal["r"] = "r"
        try:
            data = (
                np.fromfile(path, np.uint8)
                if len(tiles) == self.grid[1]
                else np.memmap(path, np.uint8, mode).view(np.ndarray)
            )
        except FileNotFoundError:
            raise ValueError(f"no file {path.relative_to(self.folder)}") from None
        index = self.index(data, path).reshape(*self.grid, 2)
        for light, row, column in product(range(len(part)), tiles, range(-(-part.shape[2] // tile_columns))):
            start, size = index[light, row, column].tolist()
            if start == _ABSENT:
                raise ValueError(f"a chunk of {path.relative_to(self.folder)} is missing")
            chunk = data[start : start + size - _SUM]
            if checksum(chunk) != data[start + size - _SUM : start + size].tobytes():
                raise ValueError(f"checksum of a chunk of {path.relative_to(self.folder)}")
            begin, end = max(first, row * tile_rows), min(last, (row + 1) * tile_rows)
            place = part[
                light, begin - first : end - first, column * tile_columns : (column + 1) * tile_columns
            ]
            tile = chunk.view(self.dtype).reshape(*self.tile, 3)
            place[...] = tile[begin - row * tile_rows : end - row * tile_rows, : place.shape[1]]

    def _chunks(self, path: Path) -> dict[int, np.ndarray]:
        """Chunks of a file, with their checksums, by their numbers."""
        try:
            data = np.fromfile(path, np.uint8)
        except FileNotFoundError:
            return {}
        index = self.index(data, path)
        there = np.flatnonzero(index[:, 0] != _ABSENT)
        return {int(key): data[index[key, 0] : index[key].sum()] for key in there}

    def index(self, data: np.ndarray, path: Path) -> np.ndarray:
        """Offset and length of all chunks of a file's bytes, checked: (chunks, 2) uint64.

        Raises
        ------
        ValueError
        """
        count, size = int(np.prod(self.grid)), self._chunk + _SUM
        where, told = data[-16 * count - _SUM : -_SUM], data[-_SUM:].tobytes()
        if len(where) != 16 * count or checksum(where) != told:
            raise ValueError(f"checksum of {path.name}")
        index = where.copy().view(np.uint64).reshape(-1, 2)
        there = index[index[:, 0] != _ABSENT]
        if (there[:, 1] != size).any() or (there[:, 0] + size > len(data) - 16 * count - _SUM).any():
            raise ValueError(f"index of {path.name}")
        return index
