"""BDI: all values as half floats, texel by texel in chunks of scan lines, whole, sparse or bzip2-packed."""

from __future__ import annotations

import bz2
import mmap

import numpy as np

from btfref.formats.bonn.header import Header, read_rotations
from btfref.formats.reading import Reader
from btfref.formats.source import MEMORY, Source
from btfref.types import Facts

FULL, BZIP, SPARSE = 0, 1, 2

#: Bytes of chunks after which the pages of the file that were looked at are given back.
_RELEASE = 64 << 20

_NAMES = {FULL: "full", BZIP: "full, bzip2", SPARSE: "sparse"}


class BDI:
    """Reads the values of some views at a time: each texel's values lie together, a view's are all over the file."""

    def __init__(self, reader: Reader, header: Header) -> None:
        self._reader, self._header = reader, header
        width = reader.number("u32", "width", 1, 1 << 16)
        height = reader.number("u32", "height", 1, 1 << 16)
        header.texels = height, width
        lines = reader.number("u32", "scan lines per chunk", 1, 1 << 16)
        self._packing = reader.number("u8", "compression", FULL, SPARSE)
        mask = reader.array("mask", "u1", (height * width,)) != 0
        read_rotations(reader, header)
        self._stored = (
            np.flatnonzero(mask) if self._packing == SPARSE else np.arange(height * width, dtype=np.int64)
        )
        self._values = header.n_pairs * len(header.channels)
        per_chunk = width * lines
        self._chunks: list[tuple[int, int, int, int]] = []
        for first in range(0, len(self._stored), per_chunk):
            n = min(per_chunk, len(self._stored) - first)
            name, at = f"chunk {len(self._chunks)}", reader.offset
            size = reader.number("u32", f"length of {name}")
            start = reader.take(name, size)
            # A last chunk may be filled up to the size of the others.
            wanted = {2 * self._values * n, 2 * self._values * per_chunk}
            if self._packing != BZIP and size not in wanted:
                reader.fail(
                    "chunk of another size",
                    f"length of {name}",
                    at=at,
                    got=size,
                    expected=" or ".join(map(str, sorted(wanted))),
                )
            self._chunks.append((start, size, first, n))
        if hasattr(mmap, "MADV_RANDOM"):  # else the system reads 128 KiB around every value
            reader.map.madvise(mmap.MADV_RANDOM)
        self._masked = len(mask) - int(mask.sum()) if self._packing == SPARSE else 0
        self._group: np.ndarray | None = None
        self._first = self._last = 0
        self.source: Source | None = None
        self.facts: Facts = {
            "compression": _NAMES[self._packing],
            "scan_lines_per_chunk": lines,
            "texels_without_data": self._masked,
        }

    def decode(self, view: int, first: int, last: int) -> np.ndarray:
        """Values (lights, texels, channels), float32; texels without data are 0, as the owners' reader has them."""
        group = self._group
        if group is None or not self._first <= view < self._last:
            # The old one goes before the new one comes.
            group = self._group = None
            group = self._read(view)
        return group[view - self._first, first:last].astype(np.float32)

    def _read(self, view: int) -> np.ndarray:
        """Read as many views as a quarter of the allowed memory takes."""
        header = self._header
        n_views, n_lights, n_channels = len(header.views), len(header.lights), len(header.channels)
        one = 2 * n_lights * header.n_texels * n_channels
        memory = MEMORY if self.source is None else self.source.memory
        n = max(1, min(n_views - view, memory // 4 // one))
        group = np.zeros((n, n_lights, header.n_texels, n_channels), np.float16)
        unreleased = 0
        for number, (start, size, first, count) in enumerate(self._chunks):
            data = self._bytes(number, start, size, count)
            values = data.reshape(count, n_views, n_lights, n_channels)[:, view : view + n]
            group[:, :, self._stored[first : first + count]] = values.transpose(1, 2, 0, 3)
            unreleased += size
            if unreleased >= _RELEASE:
                self._reader.release()
                unreleased = 0
        self._group, self._first, self._last = group, view, view + n
        return group

    def _bytes(self, number: int, start: int, size: int, count: int) -> np.ndarray:
        wanted = self._values * count
        if self._packing != BZIP:
            return np.frombuffer(self._reader.map, "<f2", wanted, start)
        try:
            data = bz2.BZ2Decompressor().decompress(self._reader.map[start : start + size], 2 * wanted)
        except (OSError, ValueError, EOFError) as error:
            self._reader.fail("damaged bzip2 data", f"chunk {number}", at=start, got=error)
        if len(data) != 2 * wanted:
            self._reader.fail(
                "chunk of another size", f"chunk {number}", at=start, got=len(data), expected=2 * wanted
            )
        return np.frombuffer(data, "<f2", wanted)
