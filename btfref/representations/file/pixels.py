"""Maps from the pixels of a file, checked: of all parts by OpenEXR, or of some rows."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.images.openexr import opened
from btfref.representations.file.manifest import block_of, image_of_entry, refuse_changed, stored_type
from btfref.representations.file.map_images import channel_names, file_shape, kept_along, rows_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from btfref.representations.file.rows import RowReader
    from btfref.types import Facts, PathLike

#: Values that are looked through at a time.
_PART = 1 << 18

#: Bits of a half float without its sign, and what they are of an infinite one; of NaN they are more.
_SIZE, _INFINITE = np.uint16(0x7FFF), np.uint16(0x7C00)


def _planes_of(path: PathLike, name: str, entry: Facts, part: Any) -> list[np.ndarray]:
    """Channels of a part in the order of the map's, each (rows, columns)."""
    rows, columns, n_channels = image_of_entry(entry)
    planes, kind = [], stored_type(entry)
    for channel in channel_names(n_channels):
        pixels = part.channels[channel].pixels if channel in part.channels else None
        if pixels is None or pixels.shape != (rows, columns) or pixels.dtype != kind:
            got = "nothing" if pixels is None else f"{pixels.dtype} {pixels.shape}"
            raise InputError(
                "a map is damaged",
                file=path,
                field=f"{name}.{channel}",
                got=got,
                expected=f"{kind} {(rows, columns)}",
            )
        planes.append(pixels)
    return planes


def whole_file(path: PathLike, manifest: Facts) -> dict[str, np.ndarray]:
    """All maps, by OpenEXR."""
    try:
        # Channels stay apart: RGB grouping would reorder those of maps with many channels.
        with opened(path, separate_channels=True) as file:
            parts = {part.header.get("name", ""): part for part in file.parts}
            return {
                name: _read_map(path, name, entry, _planes_of(path, name, entry, parts[name]), manifest)
                for name, entry in manifest["arrays"].items()
            }
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, OSError, KeyError, IndexError) as error:
        raise InputError(f"damaged or truncated OpenEXR file: {error}", file=path) from error


def rows_read(
    reader: RowReader, name: str, entry: Facts, manifest: Facts, axes: Mapping[int, np.ndarray]
) -> np.ndarray:
    """A map, of which only the chosen indices along axes that are rows are read, checked."""
    pixels = reader.read(
        name,
        channel_names(entry["shape"][-1]),
        rows_of(entry, axes),
        block=block_of(entry),
        check=partial(refuse_changed, reader.path, name, entry),
    )
    shape = file_shape(entry)
    for axis, kept in kept_along(entry, axes).items():
        shape[entry["rows"].index(axis)] = len(kept)
    return _as_map(reader.path, name, entry, pixels.reshape(shape), manifest)


def _read_map(
    path: PathLike, name: str, entry: Facts, planes: list[np.ndarray], manifest: Facts
) -> np.ndarray:
    """A map from the channels of its image, checked.

    The order of its axes in memory is made while parts of the image are in the processor's caches: those of one index
    of the first axis of the file.
    """
    block, leading = block_of(entry), entry.get("rows", [])
    rows, columns = planes[0].shape
    result = np.zeros(entry["shape"], planes[0].dtype)
    if leading:
        target = np.moveaxis(_whole_pixels(result), leading, range(len(leading)))
        unit = rows // len(target)
        if unit % block:  # a checksum is of rows of two indices
            target, unit = target[None], rows
        lines = np.zeros((unit, columns, len(planes)), result.dtype)
    else:
        target, unit, lines = None, rows, result.reshape(rows, columns, len(planes))
    for first in range(0, rows, unit):
        for start in range(0, unit, block):
            part = lines[start : start + block]
            for i, plane in enumerate(planes):
                part[..., i] = plane[first + start : first + start + len(part)]
            refuse_changed(path, name, entry, (first + start) // block, part)
        if target is not None:
            into = target[first // unit]
            into[...] = _whole_pixels(lines).reshape(into.shape)
    return _checked(path, name, entry, result, manifest)


def _as_map(path: PathLike, name: str, entry: Facts, pixels: np.ndarray, manifest: Facts) -> np.ndarray:
    """A map from its pixels with the axes in the order of the file, checked."""
    leading = entry.get("rows", [])
    if leading:
        moved = np.moveaxis(_whole_pixels(pixels), range(len(leading)), leading)
        pixels = np.ascontiguousarray(moved)[..., None].view(pixels.dtype)
    return _checked(path, name, entry, np.ascontiguousarray(pixels), manifest)


def _whole_pixels(array: np.ndarray) -> np.ndarray:
    """An array without its last axis: a pixel as one thing, of which copies keep the channels together."""
    return array.view(np.dtype((np.void, array.itemsize * array.shape[-1])))[..., 0]


def _checked(path: PathLike, name: str, entry: Facts, pixels: np.ndarray, manifest: Facts) -> np.ndarray:
    """A map from its pixels, of which none is what no map holds."""
    # What a partial table lacks stands in it as NaN, and gives NaN where it is asked for.
    partly = manifest["meta"].get("partial", False) and not name.startswith(("view_", "light_"))
    if pixels.dtype.kind == "f" and not _finite(pixels, or_nan=partly):
        raise InputError("a map holds a value that is not finite", file=path, field=name)
    if entry["dtype"] == "uint8":
        if ((pixels < 0) | (pixels > 1)).any():
            raise InputError(
                "an 8-bit map holds a value out of range", file=path, field=name, expected="[0, 1]"
            )
        pixels = np.rint(pixels.astype(np.float32) * 255).astype(np.uint8)
    return pixels


def _finite(pixels: np.ndarray, *, or_nan: bool) -> bool:
    """Whether all values are finite, or NaN where that may be; looked through in parts that fit the caches."""
    flat = pixels.reshape(-1)
    for first in range(0, flat.size, _PART):
        part = flat[first : first + _PART]
        if part.dtype != np.float16:
            good = ~np.isinf(part) if or_nan else np.isfinite(part)
        else:
            # NumPy converts halves one by one to look at them; their bits tell as well.
            size = part.view(np.uint16) & _SIZE
            good = size != _INFINITE if or_nan else size < _INFINITE
        if not good.all():
            return False
    return True
