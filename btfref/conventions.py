"""The conventions that every part of btfref shares; import them, never restate them.

============ ==========================================================================================
what         rule
============ ==========================================================================================
directions   ``w_light`` and ``w_view`` are unit vectors away from the surface in the local frame;
             z is the macro normal, x is ∂p/∂u. A BTF is not reciprocal.
value        ``B = f · cos θ_light`` in 1/sr, linear RGB (Rec. 709), the cosine included.
             0 where either direction is on or below the horizon, or is not finite.
texels       ``[row, column]``, row 0 at v = 0, texel centres at (i + ½)/n, wrap-around.
beyond the   views hold the last ring; lights hold it times cos θ / cos θ_last.
last ring
============ ==========================================================================================
"""

from __future__ import annotations

import numpy as np

#: Version of the file schemas; readers refuse a newer one.
SCHEMA_VERSION = 1

#: Axis order of the values of a sampled BTF.
AXES = ("view", "light", "row", "column", "channel")

#: Attribute that states what the values are.
COSINE_CONVENTION = "B = f * cos(theta_light), cosine included"

COLOUR_SPACE = "linear Rec. 709"

UNITS = "1/sr"

#: Texel filters, named as in Mitsuba's ``bitmap``.
FILTER_TYPES = ("nearest", "bilinear")

#: Coefficients of the luminance of linear Rec. 709 (ITU-R BT.709-6, item 3.2).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def luminance(rgb):
    """Luminance of linear Rec. 709 colours, shape (..., 3) -> (...)."""
    return np.asarray(rgb) @ LUMINANCE


def valid_directions(w):
    """Where a direction is finite and above the horizon.

    Parameters
    ----------
    w : array_like, shape (..., 3)

    Returns
    -------
    ndarray of bool, shape (...)
        NaN, infinite and clearly unnormalised vectors (length > 2) count as invalid: their value is 0.
    """
    w = np.asarray(w, float)
    with np.errstate(invalid="ignore", over="ignore"):
        return (w[..., 2] > 0) & (np.einsum("...i,...i->...", w, w) < 4)


def texel_stencil(uv, shape, filter_type):
    """Texels that a lookup at ``uv`` blends, and their weights.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
        Texture coordinates, any finite real; wrapped. Non-finite coordinates count as 0.
    shape : tuple of int
        Rows and columns of the texture.
    filter_type : {"nearest", "bilinear"}

    Returns
    -------
    index : ndarray of int64, shape (..., T)
        Flat texel index ``row * columns + column``; T is 1 or 4.
    weight : ndarray of float64, shape (..., T)
        Non-negative, sum 1.
    """
    uv = np.asarray(uv, float)
    uv = np.where(np.isfinite(uv), uv, 0.0)
    size = np.array([shape[1], shape[0]])
    # The fraction is taken first, so that large coordinates lose no more than they must.
    position = (uv - np.floor(uv)) * size
    if filter_type == "nearest":
        column, row = np.moveaxis(np.minimum(position.astype(np.int64), size - 1), -1, 0)
        return (row * shape[1] + column)[..., None], np.ones((*uv.shape[:-1], 1))
    if filter_type != "bilinear":
        raise ValueError(f"filter_type must be one of {FILTER_TYPES}, got {filter_type!r}")
    position = position - 0.5
    low = np.floor(position)
    fraction = position - low
    low = low.astype(np.int64)
    c0, r0 = np.moveaxis(low % size, -1, 0)
    c1, r1 = np.moveaxis((low + 1) % size, -1, 0)
    fx, fy = np.moveaxis(fraction, -1, 0)
    index = np.stack([r0 * shape[1] + c0, r0 * shape[1] + c1, r1 * shape[1] + c0, r1 * shape[1] + c1], -1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    return index, weight
