"""Footprints in texture space: where the samples of a query lie, and which level of detail is as wide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.footprint import BLUR
from btfref.querying.settings import FOOTPRINTS

if TYPE_CHECKING:
    from btfref.types import JitArray


def offset(footprint: str, u: np.ndarray) -> np.ndarray:
    """Places in a footprint of radius 1 about the origin, from numbers in [0, 1): shape (..., 2) -> (..., 2)."""
    first, phi = u[..., 0], 2 * np.pi * u[..., 1]
    if footprint == "square":
        return 2 * u - 1
    r = np.sqrt(-2 * np.log1p(-first)) if footprint == "gaussian" else np.sqrt(first)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)


def device_offset(footprint: str, u: JitArray, v: JitArray) -> tuple[JitArray, JitArray]:
    """The same on the device: two numbers to two."""
    import drjit as dr

    if footprint == "square":
        return dr.fma(2, u, -1), dr.fma(2, v, -1)
    r = dr.sqrt(-2 * dr.log(1 - u)) if footprint == "gaussian" else dr.sqrt(u)
    sin, cos = dr.sincos(2 * dr.pi * v)
    return r * cos, r * sin


def level(footprint: str, radius: np.ndarray, texels: int) -> np.ndarray:
    """Level of detail whose blur has the variance of a footprint: `btfref.numerics.footprint`.

    Parameters
    ----------
    footprint : str
    radius : ndarray
        Tile units.
    texels : int
        Of the finest level, along the side of the tile.

    Returns
    -------
    ndarray
        ≥ 0.
    """
    square = 12 * FOOTPRINTS[footprint] * (np.asarray(radius, float) * texels) ** 2
    return 0.5 * np.log2(1 + square / BLUR)
