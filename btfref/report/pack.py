"""Pictures, maps and HTML as short text that a page can turn back into what they were."""

from __future__ import annotations

import base64
import zlib

import numpy as np
from numpy.typing import ArrayLike

from btfref.types import Facts

_LARGEST = 32768.0


def pack(values: ArrayLike, *, bits: int = 8, base: tuple[str, ArrayLike] | None = None) -> Facts:
    """Numbers for the page: scaled half floats with a shortened mantissa, deflated, base64.

    Parameters
    ----------
    values : (H, W) or (H, W, C) array
        Anything that is not finite comes out as NaN.
    bits : int, optional
        Mantissa bits kept, at most 10: the lowest are noise to a viewer, and noise is what costs space. The
        relative error is at most 2^-(bits + 1) + 2^-11 for values above 2^-29 of the largest.
    base : (str, array), optional
        Label and values of a picture, packed with the same bits, that is nearly the same: only what differs from its
        bits is kept.

    Returns
    -------
    dict
        ``width``, ``height``, ``channels``; ``scale`` to multiply by; ``drop``, the bits to shift back;
        ``delta``, whether rows hold differences from pixel to pixel; ``data``; ``base``, the label, where it is used.
    """
    pixels = np.asarray(values, np.float64)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    scale, other = _scale(pixels), None
    if base is not None:
        other = np.reshape(np.asarray(base[1], np.float64), pixels.shape)
        # The base's scale, so that equal values have equal bits; half floats leave room for twice its largest.
        if scale < 1.9 * _scale(other):
            scale = _scale(other)
        else:
            base = other = None
    code = _codes(pixels, scale, bits)
    if other is not None:
        code = code ^ _codes(other, scale, bits)
    difference = np.diff(code, axis=-1, prepend=np.uint16(0))  # wraps, and so does the sum that undoes it
    plain, delta = (_deflate(x) for x in (code, difference))
    height, width, channels = pixels.shape
    return {
        "width": width,
        "height": height,
        "channels": channels,
        "scale": scale,
        "drop": 10 - bits,
        "delta": len(delta) < len(plain),
        "data": base64.b64encode(min(plain, delta, key=len)).decode("ascii"),
        **({"base": base[0]} if base is not None else {}),
    }


def pack_text(text: str) -> str:
    """Text, deflated, base64: HTML becomes a quarter to a half of its size."""
    return base64.b64encode(zlib.compress(text.encode("utf-8"), 9)).decode("ascii")


def unpack_text(packed: str) -> str:
    """What the page makes of :func:`pack_text`'s result."""
    return zlib.decompress(base64.b64decode(packed)).decode("utf-8")


def _scale(values: np.ndarray) -> float:
    """Largest finite value as half floats have it best."""
    largest = float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
    return largest / _LARGEST or 1.0  # also where the quotient underflows


def _codes(values: np.ndarray, scale: float, bits: int) -> np.ndarray:
    """Shortened half floats, (C, H, W) uint16."""
    drop = 10 - bits
    half = np.where(np.isfinite(values), values / scale, np.nan).astype(np.float16)
    code = (half.view(np.uint16).astype(np.uint32) + ((1 << drop) >> 1)) >> drop
    return np.moveaxis(code.astype(np.uint16), -1, 0)


def unpack(packed: Facts, base: Facts | None = None) -> np.ndarray:
    """What the page makes of `pack`'s result.

    Parameters
    ----------
    packed : dict
    base : dict, optional
        The packed picture that ``packed["base"]`` names.

    Returns
    -------
    (H, W, C) float64 array
    """
    code = _decoded(packed)
    if base is not None:
        code = code ^ _decoded(base)
    half = (code << packed["drop"]).view(np.float16)
    return np.moveaxis(half.astype(np.float64) * packed["scale"], 0, -1)


def _decoded(packed: Facts) -> np.ndarray:
    """The codes as they are stored, (C, H, W) uint16."""
    raw = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8).astype(np.uint16)
    high, low = raw.reshape(2, packed["channels"], packed["height"], packed["width"])
    code = (high << 8) | low
    return np.cumsum(code, axis=-1, dtype=np.uint16) if packed["delta"] else code


def _deflate(code: np.ndarray) -> bytes:
    """High bytes, then low bytes: the high ones repeat."""
    planes = np.concatenate([(code >> 8).astype(np.uint8).ravel(), (code & 255).astype(np.uint8).ravel()])
    return zlib.compress(planes.tobytes(), 9)
