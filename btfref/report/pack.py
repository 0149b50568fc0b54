"""Pictures and maps as short text that a page can turn back into numbers."""

from __future__ import annotations

import base64
import zlib

import numpy as np

_LARGEST = 32768.0


def pack(values, *, bits=8):
    """Numbers for the page: scaled half floats with a shortened mantissa, deflated, base64.

    Parameters
    ----------
    values : (H, W) or (H, W, C) array
        Anything that is not finite comes out as NaN.
    bits : int, optional
        Mantissa bits kept, at most 10: the lowest are noise to a viewer, and noise is what costs space. The
        relative error is at most 2^-(bits + 1) + 2^-11 for values above 2^-29 of the largest.

    Returns
    -------
    dict
        ``width``, ``height``, ``channels``; ``scale`` to multiply by; ``drop``, the bits to shift back;
        ``delta``, whether rows hold differences from pixel to pixel; ``data``.
    """
    values = np.asarray(values, np.float64)
    values = values[..., None] if values.ndim == 2 else values
    finite = np.isfinite(values)
    largest = float(np.max(np.abs(values), where=finite, initial=0.0))
    scale = largest / _LARGEST or 1.0  # also where the quotient underflows
    drop = 10 - bits
    half = np.where(finite, values / scale, np.nan).astype(np.float16)
    code = (half.view(np.uint16).astype(np.uint32) + ((1 << drop) >> 1)) >> drop
    code = np.moveaxis(code.astype(np.uint16), -1, 0)
    difference = np.diff(code, axis=-1, prepend=np.uint16(0))  # wraps, and so does the sum that undoes it
    plain, delta = (_deflate(x) for x in (code, difference))
    height, width, channels = values.shape
    return {
        "width": width,
        "height": height,
        "channels": channels,
        "scale": scale,
        "drop": drop,
        "delta": len(delta) < len(plain),
        "data": base64.b64encode(min(plain, delta, key=len)).decode("ascii"),
    }


def unpack(packed):
    """What the page makes of `pack`'s result.

    Parameters
    ----------
    packed : dict

    Returns
    -------
    (H, W, C) float64 array
    """
    raw = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8).astype(np.uint16)
    high, low = raw.reshape(2, packed["channels"], packed["height"], packed["width"])
    code = (high << 8) | low
    if packed["delta"]:
        code = np.cumsum(code, axis=-1, dtype=np.uint16)
    half = (code << packed["drop"]).view(np.float16)
    return np.moveaxis(half.astype(np.float64) * packed["scale"], 0, -1)


def _deflate(code):
    """High bytes, then low bytes: the high ones repeat."""
    planes = np.concatenate([(code >> 8).astype(np.uint8).ravel(), (code & 255).astype(np.uint8).ravel()])
    return zlib.compress(planes.tobytes(), 6)
