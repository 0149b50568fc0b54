"""Single pictures of a BTF: JPEG, PNG, Radiance and OpenEXR bytes as channels, sizes checked before decoding."""

from __future__ import annotations

import io
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike

from btfref.errors import InputError
from btfref.images import radiance
from btfref.images.openexr import opened, write
from btfref.types import PathLike

if TYPE_CHECKING:
    import PIL.Image

#: Bytes of one decoded picture.
LARGEST = 1 << 30

_EXR = b"\x76\x2f\x31\x01"
_EXR_BYTES = {0: 4, 1: 2, 2: 4}


def header(data: bytes, where: PathLike) -> tuple[str, int, int, tuple[str, ...]]:
    """Kind, rows, columns and channel names of a picture, without decoding it.

    Parameters
    ----------
    data : bytes
    where : str or Path
        For errors.

    Returns
    -------
    kind : {"8bit", "hdr", "exr"}
    rows, columns : int
    channels : tuple of str

    Raises
    ------
    InputError
        No picture, or one whose pixels would take more than `LARGEST` bytes.
    """
    if data.startswith(_EXR):
        rows, columns, channels, size = _exr_header(data, where)
        kind = "exr"
    elif radiance.is_radiance(data):
        rows, columns, *_ = radiance.size(data, where)
        kind, channels, size = "hdr", ("R", "G", "B"), 12
    else:
        with _opened(data, where) as image:
            columns, rows = image.size
        kind, channels, size = "8bit", ("R", "G", "B"), 12
    if not rows * columns or rows * columns * size > LARGEST:
        raise InputError(
            "size of a picture",
            file=where,
            field="rows, columns",
            got=f"{rows} × {columns}",
            expected=f"at least one pixel, at most {LARGEST} bytes",
        )
    return kind, rows, columns, channels


def decode(data: bytes, where: PathLike, shape: tuple[int, int]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Channels of a picture.

    Parameters
    ----------
    data : bytes
    where : str or Path
        For errors.
    shape : (int, int)
        Rows and columns that it must have.

    Returns
    -------
    pixels : ndarray, shape (rows, columns, channels)
        uint8 codes of JPEG and PNG, float32 otherwise; row 0 at the top.
    channels : tuple of str
        Names; "R", "G", "B" but for OpenEXR, whose channels keep theirs.

    Raises
    ------
    InputError
        Damaged, or of another size.
    """
    kind, rows, columns, channels = header(data, where)
    if (rows, columns) != tuple(shape):
        raise InputError(
            "picture of another size",
            file=where,
            field="rows, columns",
            got=f"{rows} × {columns}",
            expected=f"{shape[0]} × {shape[1]}",
        )
    if kind == "hdr":
        return radiance.decode(data, where), channels
    if kind == "exr":
        return _exr(data, where, channels, shape), channels
    with _opened(data, where) as image:
        try:
            pixels = np.asarray(image.convert("RGB"))
        except Exception as error:  # Pillow's decoders raise many kinds
            raise InputError("damaged picture", file=where, got=error) from error
    return pixels, channels


def _opened(data: bytes, where: PathLike) -> PIL.Image.Image:
    from PIL import Image

    try:
        image = Image.open(io.BytesIO(data), formats=("JPEG", "PNG"))
    except Exception as error:
        got = "an empty file" if not data else f"first bytes {data[:8].hex()}"
        raise InputError(
            "cannot be read as a picture", file=where, got=got, expected="JPEG, PNG, Radiance or OpenEXR"
        ) from error
    return image


def _exr_header(data: bytes, where: PathLike) -> tuple[int, int, tuple[str, ...], int]:
    """Rows, columns, channel names and bytes per pixel, from the attributes alone."""

    def damaged(field: str, at: int, got: object) -> InputError:
        return InputError("damaged OpenEXR file", file=where, field=f"{field} at byte {at}", got=got)

    def word(at: int) -> tuple[str, int]:
        end = data.find(b"\0", at, at + 256)
        if end < 0:
            raise damaged("attribute name", at, data[at : at + 16])
        return data[at:end].decode("latin-1"), end + 1

    if len(data) < 8 or data[4] != 2 or data[5] & ~0x04 or data[6] or data[7]:
        raise InputError(
            "OpenEXR file of another kind",
            file=where,
            field="version at byte 4",
            got=data[4:8].hex(),
            expected="version 2, one part of scan lines",
        )
    at, found = 8, {}
    while at < len(data) and data[at]:
        name, at = word(at)
        _, at = word(at)
        if len(data) < at + 4:
            raise damaged(name, at, "the end of the file")
        (n,) = struct.unpack_from("<i", data, at)
        at += 4
        if not 0 <= n <= len(data) - at:
            raise damaged(name, at - 4, f"{n} bytes")
        found[name] = (at, n)
        at += n
    if not {"dataWindow", "channels"} <= found.keys() or found["dataWindow"][1] != 16:
        raise damaged("header", 8, sorted(found))
    left, top, right, bottom = struct.unpack_from("<4i", data, found["dataWindow"][0])
    if right < left or bottom < top:
        raise damaged("dataWindow", found["dataWindow"][0], (left, top, right, bottom))
    at, n = found["channels"]
    end, names, size = at + n, [], 0
    while at < end and data[at]:
        name, at = word(at)
        if at + 16 > end:
            raise damaged("channels", at, "the end of the list")
        kind, _, x, y = struct.unpack_from("<iIii", data, at)
        if kind not in _EXR_BYTES or (x, y) != (1, 1) or name in names:
            raise damaged(f"channel {name!r}", at, f"type {kind}, sampling {x} × {y}")
        names.append(name)
        size += _EXR_BYTES[kind]
        at += 16
    if not names or len(names) > 1024:
        raise damaged("channels", found["channels"][0], f"{len(names)} channels")
    return bottom - top + 1, right - left + 1, tuple(names), size


def _exr(data: bytes, where: PathLike, channels: tuple[str, ...], shape: tuple[int, int]) -> np.ndarray:
    # The bindings read files by name only.
    with tempfile.NamedTemporaryFile(suffix=".exr") as stream:
        stream.write(data)
        stream.flush()
        try:
            with opened(stream.name, separate_channels=True) as file:
                found = file.channels()
                planes = [np.asarray(found[name].pixels, np.float32) for name in channels]
        except Exception as error:  # the bindings raise several kinds for a broken file
            text = str(error).replace(stream.name, Path(where).name)
            raise InputError("cannot be read as OpenEXR", file=where, got=text) from error
    if any(plane.shape != tuple(shape) for plane in planes):
        raise InputError(
            "damaged OpenEXR file", file=where, field="channels", got=planes[0].shape, expected=shape
        )
    return np.stack(planes, -1)


def write_exr(planes: Mapping[str, np.ndarray], path: PathLike, dtype: DTypeLike = np.float16) -> None:
    """Write channels as half floats, or floats.

    Parameters
    ----------
    planes : dict of str to (rows, columns) array
    path : path-like
    dtype : type
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(plane, dtype) for name, plane in planes.items()}
    write(header, path, channels)
