"""Some parts, and some rows, of a multi-part OpenEXR file: what is not asked for is neither read nor decompressed.

The OpenEXR library's binding reads whole files. Scan lines stand in chunks that are found through a table of offsets
(OpenEXR file layout, "Multi-Part, Scan Line"); a chunk of ZIP or ZIPS is 16 lines or one, deflated after its bytes were
split into even and odd ones and each replaced by its difference to the one before.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.representations.file.map_images import BLOCK

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Self

    from numpy.typing import ArrayLike

    from btfref.types import PathLike


#: Lines of a chunk by code of the compression: none, ZIPS, ZIP.
LINES = {0: 1, 2: 1, 3: 16}

#: Types of pixels by their code.
TYPES: dict[int, np.dtype] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}

_MULTI_PART = 0x1000


@dataclass(frozen=True)
class PartHeader:
    """What the header of a part says: channels in the order of the file, and where its chunks begin.

    Attributes
    ----------
    channels : list of str
    kind : numpy.dtype or None
        Of all channels; None where they differ or are of no known type.
    compression : int
    rows, columns : int
    chunks, offsets : int
        Number of chunks, and where the table of their places is.
    simple : bool
        Of scan lines in a compression that is read here.
    """

    channels: list[str]
    kind: np.dtype | None
    compression: int
    rows: int
    columns: int
    chunks: int
    offsets: int
    simple: bool

    @property
    def lines(self) -> int:
        """Scan lines of a chunk."""
        return LINES[self.compression]


class RowReader:
    """An OpenEXR file of which parts and rows are read one by one; a context manager.

    Parameters
    ----------
    path : path-like

    Attributes
    ----------
    bytes_read : int
        Of headers, tables and chunks so far.
    parts : dict of str to PartHeader
        All parts, also those that cannot be read here.
    attributes : dict of str to bytes
        Of the first part.

    Raises
    ------
    InputError
        For a damaged or truncated file.
    """

    def __init__(self, path: PathLike) -> None:
        self.path, self.bytes_read = Path(path), 0
        self._stream = self.path.open("rb")
        try:
            self.attributes, self.parts = self._headers()
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the file back."""
        self._stream.close()

    def knows(self, name: str) -> bool:
        """Whether a part is there, of scan lines in a compression that is read here."""
        return name in self.parts and self.parts[name].simple

    def share(self, name: str, rows: ArrayLike | None = None, block: int = BLOCK) -> float:
        """Share of a part's lines that :meth:`read` reads for some rows."""
        part = self.parts[name]
        if rows is None:
            return 1.0
        unit = max(block, part.lines)
        return min(1.0, len(np.unique(np.asarray(rows) // unit)) * unit / part.rows)

    def read(
        self,
        name: str,
        channels: Sequence[str],
        rows: ArrayLike | None = None,
        *,
        block: int = BLOCK,
        check: Callable[[int, np.ndarray], object] = lambda number, pixels: None,
    ) -> np.ndarray:
        """Pixels of a part.

        Parameters
        ----------
        name : str
        channels : list of str
            In the order of the result.
        rows : array_like of int, optional
            Rows to read, ascending; default all.
        block : int
            Rows of a block, 1 or `BLOCK`: of each that holds such rows all are read.
        check : callable
            Called with the number and the pixels (rows, columns, channels) of each block.

        Returns
        -------
        ndarray, shape (rows, columns, channels)
            Of the rows that were asked for, and of no others.

        Raises
        ------
        InputError
            For channels that are not there, and damaged or truncated files.
        """
        part = self.parts[name]
        if sorted(channels) != part.channels:
            raise InputError(
                "a map is damaged", file=self.path, field=name, got=f"channels {', '.join(part.channels)}"
            )
        assert part.kind is not None
        place = [part.channels.index(channel) for channel in channels]
        wanted = np.arange(part.rows) if rows is None else np.asarray(rows, np.int64)
        self._stream.seek(part.offsets)
        table = np.frombuffer(self._take(8 * part.chunks), "<u8")
        result = np.zeros((len(wanted), part.columns, len(channels)), part.kind)
        unit = max(block, part.lines)
        units, starts = np.unique(wanted // unit, return_index=True)
        for number, start, stop in zip(units, starts, [*starts, len(wanted)][1:], strict=True):
            first = int(number) * unit
            chunks = range(first // part.lines, min((first + unit) // part.lines, part.chunks))
            pixels = [self._chunk(name, table, chunk, place) for chunk in chunks]
            lines = pixels[0] if len(pixels) == 1 else np.concatenate(pixels)
            inside = wanted[start:stop] - first
            for k in sorted(set((inside // block).tolist())):
                check(first // block + k, lines[k * block : (k + 1) * block])
            result[start:stop] = lines if len(inside) == len(lines) else lines[inside]
        return result

    def _chunk(self, name: str, table: np.ndarray, chunk: int, place: list[int]) -> np.ndarray:
        """Pixels of a chunk, (lines, columns, channels)."""
        part = self.parts[name]
        assert part.kind is not None
        first, line = chunk * part.lines, part.columns * len(place) * part.kind.itemsize
        count = min(part.lines, part.rows - first)
        self._stream.seek(int(table[chunk]))
        _, row, size = struct.unpack("<iii", self._take(12))
        if row != first or not 0 <= size <= count * line:
            raise self._damaged(f"chunk {chunk} of {name}")
        stored = self._take(size)
        whole = size == count * line
        data = np.frombuffer(stored, np.uint8) if whole else self._inflated(stored, count * line)
        # Of each line one channel after the other.
        pixels = data.view(part.kind).reshape(count, len(place), part.columns)
        result = np.zeros((count, part.columns, len(place)), part.kind)
        for i, channel in enumerate(place):
            result[..., i] = pixels[:, channel]
        return result

    def _inflated(self, data: bytes, size: int) -> np.ndarray:
        try:
            # No more than belongs there: a few bytes may stand for gigabytes.
            found = np.frombuffer(zlib.decompressobj().decompress(data, size + 1), np.uint8)
        except zlib.error as error:
            raise self._damaged(str(error)) from None
        if len(found) != size:
            raise self._damaged("a chunk of another length")
        steps = found - np.uint8(128)
        steps[0] = found[0]
        whole = np.cumsum(steps, dtype=np.uint8)
        result = np.zeros_like(whole)
        half = (size + 1) // 2
        result[0::2], result[1::2] = whole[:half], whole[half:]
        return result

    def _take(self, n: int) -> bytes:
        data = self._stream.read(n)
        if len(data) != n:
            raise self._damaged("its end is missing")
        self.bytes_read += n
        return data

    def _text(self) -> str:
        letters = bytearray()
        while (letter := self._take(1)) != b"\0":
            letters += letter
            if len(letters) > 255:
                raise self._damaged("a name without end")
        return letters.decode("utf-8", "replace")

    def _headers(self) -> tuple[dict[str, bytes], dict[str, PartHeader]]:
        """Attributes of the first part, and all parts by name."""
        _, version = struct.unpack("<ii", self._take(8))
        headers: list[dict[str, bytes]] = []
        while True:
            header: dict[str, bytes] = {}
            while name := self._text():
                self._text()
                (size,) = struct.unpack("<i", self._take(4))
                if size < 0 or name in header:
                    raise self._damaged(f"attribute {name}")
                header[name] = self._take(size)
            if not header:
                break
            headers.append(header)
            if not version & _MULTI_PART:
                break
        if not headers:
            raise self._damaged("no header")
        parts: dict[str, PartHeader] = {}
        offset, end = self._stream.tell(), self.path.stat().st_size
        for header in headers:
            name = header.get("name", b"").rstrip(b"\0").decode("utf-8", "replace")
            part = self._part(header, offset)
            offset += 8 * part.chunks
            if name in parts or offset > end:
                raise self._damaged(f"part {name}")
            parts[name] = part
        return headers[0], parts

    def _part(self, header: dict[str, bytes], offset: int) -> PartHeader:
        try:
            low_x, low_y, high_x, high_y = struct.unpack("<iiii", header["dataWindow"])
            compression, channels = header["compression"][0], _channels(header["channels"])
            rows, columns = high_y - low_y + 1, high_x - low_x + 1
            chunks = -(-rows // LINES.get(compression, 1))
            if "chunkCount" in header:
                (chunks,) = struct.unpack("<i", header["chunkCount"])
        except (KeyError, struct.error, IndexError, ValueError):
            raise self._damaged("a header") from None
        if rows < 1 or columns < 1 or chunks < 1 or not channels:
            raise self._damaged("a header")
        kinds = {kind for _, kind in channels}
        kind = TYPES.get(kinds.pop()) if len(kinds) == 1 else None
        lines = compression in LINES and chunks == -(-rows // LINES[compression])
        scan_lines = header.get("type", b"scanlineimage") == b"scanlineimage"
        simple = lines and scan_lines and kind is not None and low_y == 0
        names = [channel for channel, _ in channels]
        return PartHeader(names, kind, compression, rows, columns, chunks, offset, simple)

    def _damaged(self, what: str) -> InputError:
        return InputError(f"damaged or truncated OpenEXR file: {what}", file=self.path)


def _channels(data: bytes) -> list[tuple[str, int]]:
    """Names and types of a list of channels."""
    result, at = [], 0
    while data[at] != 0:
        end = data.index(b"\0", at)
        (kind,) = struct.unpack_from("<i", data, end + 1)
        result.append((data[at:end].decode("utf-8", "replace"), kind))
        at = end + 17
    return result
