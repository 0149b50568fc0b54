"""Reading of binary files that may be damaged: no byte is touched and nothing allocated before its check."""

from __future__ import annotations

import hashlib
import mmap
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import DTypeLike

from btfref.errors import InputError
from btfref.types import PathLike

_NUMBERS = {"u8": "<B", "u32": "<I", "i32": "<i", "u64": "<Q"}


class Reader:
    """Little-endian fields of a file, one after the other; errors name the field and its offset.

    Parameters
    ----------
    path : path-like

    Attributes
    ----------
    offset : int
        Of the next field, in bytes.
    size : int
        Of the file.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError("not a file" if self.path.exists() else "no such file", file=path)
        self.size = self.path.stat().st_size
        if self.size == 0:
            raise InputError("the file is empty", file=path)
        with self.path.open("rb") as stream:
            self.map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self.offset = 0

    def fail(
        self, message: str, field: str, *, at: int | None = None, got: object = None, expected: object = None
    ) -> NoReturn:
        """Raise InputError with the field and its offset."""
        at = self.offset if at is None else at
        raise InputError(message, file=self.path, field=f"{field} at byte {at}", got=got, expected=expected)

    def take(self, field: str, n: int) -> int:
        """Offset of the next ``n`` bytes, which are then behind; InputError when the file has fewer."""
        if n > self.size - self.offset:
            self.fail(
                "truncated file",
                field,
                got=f"{self.size - self.offset} bytes to the end",
                expected=f"{n} bytes",
            )
        start = self.offset
        self.offset += n
        return start

    def number(self, kind: str, field: str, low: float | None = None, high: float | None = None) -> int:
        """One number of a kind u8, u32, i32 or u64, within [low, high]."""
        form = _NUMBERS[kind]
        at = self.take(field, struct.calcsize(form))
        (value,) = struct.unpack_from(form, self.map, at)
        if (low is not None and value < low) or (high is not None and value > high):
            expected = f"{low} to {high}" if low is not None and high is not None else f"≥ {low}"
            self.fail("value out of range", field, at=at, got=value, expected=expected)
        return value

    def array(self, field: str, dtype: DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """Array that looks into the file, shape as given; the check comes before anything is made."""
        dtype = np.dtype(dtype)
        count = 1
        for side in shape:
            count *= int(side)  # Python integers: sizes from a header may overflow 64 bits
        at = self.take(field, count * dtype.itemsize)
        return np.frombuffer(self.map, dtype, count, at).reshape(shape)

    def digest(self) -> str:
        """Fingerprint of all bytes of the file."""
        with self.path.open(
            "rb"
        ) as stream:  # through the map, all of the file would count as this process's memory
            return hashlib.file_digest(stream, "sha256").hexdigest()[:32]

    def release(self) -> None:
        """Give the pages of the file that were looked at back: they count as this process's memory."""
        if hasattr(mmap, "MADV_DONTNEED"):
            self.map.madvise(mmap.MADV_DONTNEED)

    def text(self, field: str, n: int) -> str:
        """Bytes as text: cut at the first NUL, unknown characters replaced."""
        at = self.take(field, n)
        return self.map[at : at + n].split(b"\0", 1)[0].decode("utf-8", "replace")

    def floats(self, field: str, shape: Sequence[int]) -> np.ndarray:
        """As `array` of f32, checked to be finite."""
        at = self.offset
        values = self.array(field, "<f4", shape)
        if not np.isfinite(values).all():
            place = int(np.flatnonzero(~np.isfinite(values.ravel()))[0])
            self.fail("value that is not finite", field, at=at + 4 * place, got=values.ravel()[place])
        return values
