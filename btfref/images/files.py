"""Pictures in files: EXR with linear float32 radiance, PNG for eyes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.images.display import Display
from btfref.images.openexr import opened, write
from btfref.numerics.colour import decode_srgb
from btfref.outputs import new_file
from btfref.types import PathLike

#: Pixels of a display window that is filled: a picture of 16 384².
MOST_PIXELS = 1 << 28

_MAGIC = {".exr": b"\x76\x2f\x31\x01", ".png": b"\x89PNG\r\n\x1a\n"}


def load_image(path: PathLike, *, finite: bool = False) -> np.ndarray:
    """Read a picture as linear Rec. 709.

    Parameters
    ----------
    path : path-like
        ``.exr``: channels R, G, B (or Y, shown grey) of the first part, values as they are, placed in the
        display window. ``.png``: sRGB, decoded to linear; colour counts with 8 bits, whatever the file
        holds. Alpha is left out.
    finite : bool, optional
        Refuse NaN and infinities; `compare` counts them and fails its gate.

    Returns
    -------
    (H, W, 3) float32 array
        Row 0 at the top.

    Raises
    ------
    InputError
        Missing, empty, truncated or foreign file, no colour channels, or non-finite values when refused.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in _MAGIC:
        raise InputError("unknown kind of picture", file=path, got=repr(path.suffix), expected=".exr or .png")
    if not path.is_file():
        raise InputError("no such file", file=path)
    with path.open("rb") as stream:
        head = stream.read(len(_MAGIC[kind]))
    if head != _MAGIC[kind]:
        got = "an empty file" if not head else f"first bytes {head.hex()}"
        raise InputError(f"not a {kind[1:].upper()} file", file=path, got=got, expected=_MAGIC[kind].hex())
    image = _load_exr(path) if kind == ".exr" else _load_png(path)
    if image.size == 0:
        raise InputError("picture without pixels", file=path, got=image.shape)
    if finite and not np.isfinite(image).all():
        count = int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
        raise InputError("holds pixels that are not finite", file=path, got=count, expected=0)
    return image


def save_image(
    path: PathLike,
    image: ArrayLike,
    *,
    display: Display | None = None,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write a picture; the file appears complete or not at all.

    Parameters
    ----------
    path : path-like
        ``.exr``: float32 RGB, values as they are. ``.png``: 8-bit sRGB through `display`.
    image : (H, W, 3) array
        Linear Rec. 709, row 0 at the top.
    display : Display, optional
        For PNG; default 0 stops.
    attributes : dict of str to str, optional
        Text for the EXR header.

    Raises
    ------
    InputError
        Wrong shape or an unknown ending.
    """
    path, image = Path(path), np.asarray(image)
    if image.ndim != 3 or image.shape[-1] != 3 or image.size == 0:
        raise InputError("no picture", file=path, field="shape", got=image.shape, expected="(H, W, 3)")
    kind = path.suffix.lower()
    if kind == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
        channels = {"RGB": np.ascontiguousarray(image, np.float32)}
        with new_file(path) as draft:
            write(header, draft, channels)
    elif kind == ".png":
        from btfref.images.png import encode_png

        encoded = (display or Display()).encoded(image)
        with new_file(path) as draft:
            draft.write_bytes(encode_png(np.round(encoded * 255).astype(np.uint8)))
    else:
        raise InputError("unknown kind of picture", file=path, got=repr(path.suffix), expected=".exr or .png")


def read_attribute(path: PathLike, name: str) -> str | None:
    """A text in the header of an OpenEXR file; None for a file without it, or one that cannot be read.

    Parameters
    ----------
    path : path-like
    name : str

    Returns
    -------
    str or None
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file() or path.stat().st_size == 0:
        return None
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            text = file.header().get(name)
    except Exception:  # the bindings raise several kinds for a broken file
        return None
    return text if isinstance(text, str) else None


def _load_exr(path: Path) -> np.ndarray:
    try:
        with opened(path) as file:
            header = dict(file.header())
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the bindings raise several kinds for a broken file
        raise InputError("cannot be read as EXR", file=path, got=error) from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            pixels = channels[name][..., :3]
            break
    else:
        if {"R", "G", "B"} <= channels.keys():
            pixels = np.stack([channels[c] for c in "RGB"], axis=-1)
        elif "Y" in channels:
            pixels = np.repeat(channels["Y"][..., None], 3, axis=-1)
        else:
            raise InputError(
                "no colour", file=path, field="channels", got=sorted(channels), expected="R, G, B or Y"
            )
    (left, top), (right, bottom) = (np.asarray(corner).tolist() for corner in header["displayWindow"])
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        expected = f"1 to {MOST_PIXELS} pixels"
        raise InputError(
            "size of a picture",
            file=path,
            field="displayWindow",
            got=f"{width} × {height}",
            expected=expected,
        )
    return _in_display_window(pixels.astype(np.float32), header)


def _in_display_window(pixels: np.ndarray, header: Mapping[str, Any]) -> np.ndarray:
    """Pixels of the data window, cropped or filled with 0 to the display window."""
    (x0, y0), _ = (np.asarray(corner) for corner in header["dataWindow"])
    (left, top), (right, bottom) = (np.asarray(corner) for corner in header["displayWindow"])
    height, width = pixels.shape[:2]
    if (x0, y0, width, height) == (left, top, right - left + 1, bottom - top + 1):
        return np.ascontiguousarray(pixels)
    result = np.zeros((bottom - top + 1, right - left + 1, 3), np.float32)
    rows = slice(max(y0, top), min(y0 + height, bottom + 1))
    columns = slice(max(x0, left), min(x0 + width, right + 1))
    if rows.start < rows.stop and columns.start < columns.stop:
        result[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[
            rows.start - y0 : rows.stop - y0, columns.start - x0 : columns.stop - x0
        ]
    return result


def _load_png(path: Path) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path) as image:
            image.load()
            if image.mode.startswith("I"):
                return np.repeat(decode_srgb(np.asarray(image) / 65535.0)[..., None], 3, -1).astype(
                    np.float32
                )
            pixels = np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError("cannot be read as PNG", file=path, got=error) from error
    return decode_srgb(pixels / 255.0).astype(np.float32)
