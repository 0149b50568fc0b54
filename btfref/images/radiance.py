"""Radiance pictures (.hdr): shared exponents, run lengths, and the resolution line that ATRIUM reverses.

Ward 1991, "Real pixels" (Graphics Gems II), and Radiance's ``color.c`` for the run lengths.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.types import PathLike

#: Longest header; a picture without its resolution line by then is none.
_HEADER = 1 << 16

_RESOLUTION = re.compile(rb"([+-])([XY]) {1,4}(\d{1,6}) {1,4}([+-])([XY]) {1,4}(\d{1,6})")


def is_radiance(data: bytes) -> bool:
    """Whether bytes start as a Radiance picture does."""
    return data.startswith((b"#?RADIANCE", b"#?RGBE"))


def size(data: bytes, where: PathLike) -> tuple[int, int, int, bool, bool]:
    """Rows, columns, offset of the pixels, and whether rows run upwards and columns to the left.

    Notes
    -----
    ``-Y H +X W`` is the usual line: rows from the top. ATRIUM's files say ``+X W -Y H`` while their scan lines are
    rows from the bottom to the top; what Radiance means by that line (columns first) is in no BTF file known.
    """
    end = data.find(b"\n\n", 0, _HEADER)
    start = end + 2
    stop = data.find(b"\n", start, start + 64) if end >= 0 else -1
    match = _RESOLUTION.fullmatch(data[start:stop]) if stop >= 0 else None
    if match is None or match[2] == match[5]:
        raise InputError(
            "no Radiance picture",
            file=where,
            field=f"resolution at byte {max(start, 0)}",
            got=data[start : start + 24],
            expected="-Y rows +X columns",
        )
    form = re.search(rb"^FORMAT=(.*)$", data[:end], re.MULTILINE)
    if form and form[1].strip() != b"32-bit_rle_rgbe":
        raise InputError(
            "colours of another kind",
            file=where,
            field="FORMAT",
            got=form[1][:40],
            expected="32-bit_rle_rgbe",
        )
    x_first = match[2] == b"X"
    columns, rows = (int(match[3]), int(match[6])) if x_first else (int(match[6]), int(match[3]))
    # The reversed line: rows from the bottom, columns to the right.
    upwards, leftwards = (
        (match[4] == b"-", match[1] == b"-") if x_first else (match[1] == b"+", match[4] == b"-")
    )
    return rows, columns, stop + 1, upwards, leftwards


def decode(data: bytes, where: PathLike) -> np.ndarray:
    """Linear colours of a Radiance picture, float32, shape (rows, columns, 3), row 0 at the top.

    Raises
    ------
    InputError
        Truncated or damaged runs, with the offset.
    """
    rows, columns, at, upwards, leftwards = size(data, where)
    if not 8 <= columns < 32768 or data[at : at + 2] != b"\x02\x02":
        pixels = _flat(data, at, rows, columns, where)
    else:
        pixels = np.zeros((rows, 4, columns), np.uint8)
        for row in range(rows):
            at = _line(data, at, columns, pixels[row], row, where)
        pixels = pixels.transpose(0, 2, 1)
    exponent = pixels[..., 3].astype(np.int32)
    factor = np.ldexp(np.float32(1), exponent - 136)
    values = (pixels[..., :3] + np.float32(0.5)) * np.where(exponent > 0, factor, 0)[..., None]
    values = values[::-1] if upwards else values
    return np.ascontiguousarray(values[:, ::-1] if leftwards else values, np.float32)


def _flat(data: bytes, at: int, rows: int, columns: int, where: PathLike) -> np.ndarray:
    need = rows * columns * 4
    if len(data) - at < need:
        raise InputError(
            "truncated picture", file=where, field=f"pixels at byte {at}", got=len(data) - at, expected=need
        )
    return np.frombuffer(data, np.uint8, need, at).reshape(rows, columns, 4)


def _line(data: bytes, at: int, columns: int, out: np.ndarray, row: int, where: PathLike) -> int:
    """Unpack one scan line; returns the offset behind it."""

    def damaged(what: str) -> InputError:
        return InputError("damaged picture", file=where, field=f"row {row} at byte {at}", got=what)

    if (
        len(data) < at + 4
        or data[at : at + 2] != b"\x02\x02"
        or (data[at + 2] << 8 | data[at + 3]) != columns
    ):
        raise damaged(f"line header {data[at : at + 4].hex() or 'missing'}")
    at += 4
    for channel in range(4):
        line, filled = bytearray(columns), 0
        while filled < columns:
            if at >= len(data):
                raise damaged("the end of the file")
            code = data[at]
            if code > 128:
                n = code - 128
                run = data[at + 1 : at + 2] * n
                at += 2
            else:
                n = code
                run = data[at + 1 : at + 1 + n]
                at += 1 + n
            if n == 0 or len(run) != n or filled + n > columns:
                raise damaged(f"a run of {n}")
            line[filled : filled + n] = run
            filled += n
        out[channel] = np.frombuffer(line, np.uint8)
    return at


def encode(image: ArrayLike, *, reversed_line: bool = False) -> bytes:
    """Bytes of a Radiance picture, without runs, as older programs read it.

    Parameters
    ----------
    image : (rows, columns, 3) array
        Linear, non-negative; row 0 at the top.
    reversed_line : bool
        Write as ATRIUM does: ``+X columns -Y rows`` with rows from the bottom to the top.

    Returns
    -------
    bytes
        Relative error of the largest channel at most 2^-8.
    """
    image = np.asarray(image, np.float64)
    rows, columns = image.shape[:2]
    largest = image.max(-1)
    _, exponent = np.frexp(largest)
    with np.errstate(under="ignore"):
        mantissa = np.minimum(image * np.ldexp(1.0, 8 - exponent)[..., None], 255).astype(np.uint8)
    lit = largest > 1e-32
    pixels = np.concatenate([mantissa, (exponent + 128).astype(np.uint8)[..., None]], -1) * lit[..., None]
    if reversed_line:
        line, pixels = f"+X {columns} -Y {rows}\n", pixels[::-1]
    else:
        line = f"-Y {rows} +X {columns}\n"
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + line.encode() + pixels.astype(np.uint8).tobytes()
