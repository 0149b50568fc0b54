"""The conventions that every part of btfref shares; import them, never restate them.

============ ==========================================================================================
what         rule
============ ==========================================================================================
directions   ``w_light`` and ``w_view`` are unit vectors away from the surface in the local frame;
             z is the macro normal, x is ∂p/∂u made orthogonal to it, y = n × x; where
             det(∂p/∂u, ∂p/∂v, n) < 0 y = −n × x, so that x and y follow the picture. A BTF is
             not reciprocal.
value        ``B = f · cos θ_light`` in 1/sr, linear RGB (Rec. 709), the cosine included.
             0 where either direction is on or below the horizon, or is not finite.
texels       ``[row, column]``, row 0 at v = 0, texel centres at (i + ½)/n, wrap-around.
beyond the   views hold the last ring; lights hold it times cos θ / cos θ_last.
last ring
============ ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.precision import real

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

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


def in_one_line(
    kind: str, texels: Sequence[int], views: Mapping[str, Any], lights: Mapping[str, Any], size: int
) -> str:
    """The ``repr`` of a BTF, a store or a representation, whatever it holds.

    Parameters
    ----------
    kind : str
        The class, and the key of a method or the type of the values.
    texels : (int, int)
        Rows and columns.
    views, lights : mapping
        ``count`` of the directions and ``name`` of their set.
    size : int
        Bytes of the maps or values alone, as ``btfref info`` counts them.
    """
    sets = " × ".join(
        f"{d['count']} {what} ({d['name']})" for what, d in (("views", views), ("lights", lights))
    )
    return f"<{kind}: {texels[0]} × {texels[1]} texels, {sets}, {size} bytes>"


#: Coefficients of the luminance of linear Rec. 709 (ITU-R BT.709-6, item 3.2).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class PixelClass(IntEnum):
    """What a pixel shows, and so what two renderers can be asked to agree on; the codes of class maps.

    *Interior* pixels see one smooth surface, *edge* pixels an edge of it or are beside one, *silhouette* pixels have a
    sample so near to an edge that renderers may see different sides of it, *mesostructure* pixels see an edge inside a
    material that has a geometry of its own, *shadow border* pixels have a sample near to the border of a shadow that a
    shape casts, *other* pixels see a material that real time shows as its mean albedo, *background* pixels nothing.
    """

    BACKGROUND = 0
    INTERIOR = 1
    SILHOUETTE = 2
    MESOSTRUCTURE = 3
    EDGE = 4
    SHADOW_BORDER = 5
    OTHER = 6

    @property
    def label(self) -> str:
        """The name in gates, tables and results."""
        return self.name.lower()


def luminance(rgb: ArrayLike) -> np.ndarray:
    """Luminance of linear Rec. 709 colours, shape (..., 3) -> (...)."""
    return np.asarray(rgb) @ LUMINANCE


#: Least z of a direction above the horizon: the smallest normal float32, since some ports flush what is smaller to 0.
LEAST_Z = 2.0**-126

#: Squared lengths between which a vector counts as a direction; rounding moves a unit vector by some 1e-7.
SQUARED_LENGTHS = (0.25, 4.0)


def valid_directions(w: ArrayLike) -> np.ndarray:
    """Where a vector is a direction above the horizon: the one rule of all evaluators.

    Parameters
    ----------
    w : array_like, shape (..., 3)

    Returns
    -------
    ndarray of bool, shape (...)
        NaN, infinite and clearly unnormalised vectors (length outside of ½ … 2) count as invalid: their value is
        exactly 0. :func:`malformed` counts them.
    """
    w = real(w)
    low, high = SQUARED_LENGTHS
    with np.errstate(invalid="ignore", over="ignore"):
        square = np.einsum("...i,...i->...", w, w)
        return (w[..., 2] >= LEAST_Z) & (square > low) & (square < high)


def malformed(uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike) -> dict[str, int]:
    """How many lookups ask for what is none: apart from directions below the horizon, which are ordinary.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
    w_light, w_view : array_like, shape (..., 3)

    Returns
    -------
    dict of str to int
        ``directions``: lookups with a vector that is not finite or clearly not of unit length; their value is 0.
        ``coordinates``: lookups with ``uv`` that is not finite; it counts as 0. Ports count alike:
        `mitsuba_plugins.lib.lookup.malformed`, ``shaders/lib/lookup/malformed.glsl``.
    """
    low, high = SQUARED_LENGTHS
    unit = np.array(True)
    with np.errstate(invalid="ignore", over="ignore"):
        for w in (w_light, w_view):
            w = real(w)
            square = np.einsum("...i,...i->...", w, w)
            unit = unit & (square > low) & (square < high)
    finite = np.isfinite(real(uv)).all(-1)
    return {"directions": int(np.count_nonzero(~unit)), "coordinates": int(np.count_nonzero(~finite))}


def texel_stencil(uv: ArrayLike, shape: Sequence[int], filter_type: str) -> tuple[np.ndarray, np.ndarray]:
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
    uv = real(uv)
    uv = np.where(np.isfinite(uv), uv, 0.0)
    size = np.array([shape[1], shape[0]])
    # The fraction is taken first, so that large coordinates lose no more than they must.
    position = (uv - np.floor(uv)) * real(size)
    if filter_type == "nearest":
        column, row = np.moveaxis(np.minimum(position.astype(np.int64), size - 1), -1, 0)
        return (row * shape[1] + column)[..., None], np.ones((*uv.shape[:-1], 1), uv.dtype)
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
