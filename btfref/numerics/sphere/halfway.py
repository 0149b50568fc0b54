"""Half and difference vectors of a pair of directions (Rusinkiewicz 1998; Kautz and McCool 1999).

The difference vector is the light direction in a frame about the half vector. Kautz and McCool orthonormalise the
surface's tangent against h (GSHD), which is singular where h meets the tangent. Differs from theirs: the frame is the
surface's own, turned on the shortest way from the normal to h. It equals theirs to first order about the normal and is
smooth on the whole hemisphere, so that float32 and float64 agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.precision import real


def half_frame(h: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Tangent and bitangent at the half vector, shape (..., 3) -> two of (..., 3).

    Parameters
    ----------
    h : array_like
        Unit vectors with z ≥ 0.
    """
    x, y, z = np.moveaxis(real(h), -1, 0)
    a = 1 / (1 + z)
    tangent = np.stack([1 - x * x * a, -x * y * a, -x], -1)
    bitangent = np.stack([-x * y * a, 1 - y * y * a, -y], -1)
    return tangent, bitangent


#: Sums of directions shorter than this are mirrored to the last bit, and their squares underflow in float32: they are
#: scaled first. All evaluators do the same.
SHORT, LENGTHEN = 1e-15, 1e20


def half_vector(w_light: ArrayLike, w_view: ArrayLike) -> np.ndarray:
    """Unit half vector, shape (..., 3); the normal where opposite directions on the horizon have none.

    Parameters
    ----------
    w_light, w_view : array_like, shape (..., 3)
        Unit vectors of the upper hemisphere.
    """
    h = real(w_light) + real(w_view)
    h = np.where(np.abs(h).max(-1, keepdims=True) < SHORT, h * real(LENGTHEN), h)
    length = np.linalg.norm(h, axis=-1, keepdims=True)
    # Any will do there, where B is zero.
    return np.where(length > 0, h / np.where(length > 0, length, 1), real([0.0, 0.0, 1.0]))


def half_difference(w_light: ArrayLike, w_view: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Half and difference vectors.

    Parameters
    ----------
    w_light, w_view : array_like, shape (..., 3)
        Unit vectors of the upper hemisphere.

    Returns
    -------
    h, d : ndarray, shape (..., 3)
        Unit vectors with z ≥ 0: h in the surface's frame, d (the light) in that of h.
    """
    w_light, w_view = np.broadcast_arrays(real(w_light), real(w_view))
    h = half_vector(w_light, w_view)
    tangent, bitangent = half_frame(h)
    d = np.stack([(w_light * axis).sum(-1) for axis in (tangent, bitangent, h)], -1)
    return h, d


def in_out(h: ArrayLike, d: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of :func:`half_difference`: light and view directions, which may lie below the horizon.

    Parameters
    ----------
    h, d : array_like, shape (..., 3)
    """
    h, d = np.broadcast_arrays(np.asarray(h, float), np.asarray(d, float))
    tangent, bitangent = half_frame(h)
    w_light = d[..., :1] * tangent + d[..., 1:2] * bitangent + d[..., 2:] * h
    return w_light, 2 * (w_light * h).sum(-1, keepdims=True) * h - w_light
