"""Tangent frames: of a surface with texture coordinates, and of a height field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.precision import real
from btfref.types import PathLike

#: Length of interpolated cosine and sine below which tangents of all directions meet: there is no turn to speak of, and
#: float32 would make one up (its rounding of 6e-8 turns a tangent by 6e-6 at this length).
ROTATION_FLOOR = 0.01


def shading_frame(normal: ArrayLike, dp_du: ArrayLike, hand: ArrayLike = 1.0) -> np.ndarray:
    """Orthonormal frame from a shading normal and the tangent ∂p/∂u.

    Parameters
    ----------
    normal : array_like, shape (..., 3)
        Unit shading normal n.
    dp_du : array_like, shape (..., 3)
        Derivative of the position with respect to u; any length, not parallel to the normal.
    hand : array_like, shape (...)
        Sign of det(∂p/∂u, ∂p/∂v, n): −1 where the texture is mirrored against the surface.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Rows s, t, n with ``s = normalize(dp_du − n (n · dp_du))`` and ``t = hand · n × s``: the matrix takes world
        vectors to the local frame. With 1 it is Mitsuba's (``SurfaceInteraction.initialize_sh_frame``); with the sign
        of the texture s and t run along its axes, whichever way these turn.
    """
    normal, dp_du = np.asarray(normal, float), np.asarray(dp_du, float)
    s = dp_du - normal * (normal * dp_du).sum(-1, keepdims=True)
    s = s / np.linalg.norm(s, axis=-1, keepdims=True)
    t = np.asarray(hand, float)[..., None] * np.cross(normal, s)
    return np.stack([s, t, normal], -2)


@dataclass(frozen=True)
class Turn:
    """How local directions reach the frame of a transformed texture: y is mirrored or not, then x and y turn.

    Parameters
    ----------
    cosine, sine : float
        Of the angle about the normal, counter-clockwise.
    hand : float
        −1 where y is mirrored first, else 1.
    """

    cosine: float = 1.0
    sine: float = 0.0
    hand: float = 1.0


def nearest_turn(linear: ArrayLike) -> Turn:
    """The rotation or reflection nearest to a linear map of texture coordinates (its polar factor).

    Parameters
    ----------
    linear : array_like, shape (2, 2)
        Not singular.

    Returns
    -------
    Turn
    """
    (a, b), (c, d) = np.asarray(linear, float).tolist()
    hand = -1.0 if a * d < b * c else 1.0
    cosine, sine = a + hand * d, c - hand * b
    length = float(np.hypot(cosine, sine))
    return Turn(cosine / length, sine / length, hand) if length > 0 else Turn()


def uv_transform(matrix: ArrayLike, *, file: PathLike | None = None) -> tuple[np.ndarray, Turn]:
    """Affine map of texture coordinates and what it does to the local frame.

    Parameters
    ----------
    matrix : array_like, shape (4, 4) or (3, 3)
        Mitsuba's ``to_uv``.
    file : path-like, optional
        For messages.

    Returns
    -------
    affine : ndarray, shape (2, 3)
    turn : Turn
        By which local directions reach the texture's frame: that nearest to the linear part.

    Raises
    ------
    InputError
        For a singular transform, or one that is not finite.
    """
    m = np.asarray(matrix, float)
    affine = np.concatenate([m[:2, :2], m[:2, -1:]], 1)
    determinant = affine[0, 0] * affine[1, 1] - affine[0, 1] * affine[1, 0]
    if not (np.isfinite(affine).all() and determinant != 0):
        raise InputError(
            "the transform is singular",
            file=file,
            field="to_uv",
            got=affine[:, :2].tolist(),
            expected="a determinant that is not 0",
        )
    return affine, nearest_turn(affine[:, :2])


def surface_frame(surface: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangent frame of slopes and of a rotation.

    Parameters
    ----------
    surface : ndarray, shape (N, 4)
        Slopes along u and v, cosine and sine of the rotation (of any length; below :data:`ROTATION_FLOOR` they count as
        no rotation).

    Returns
    -------
    tangent, bitangent, normal : ndarray, shape (N, 3)
        Orthonormal. Without rotation the tangent is x, projected to the tangent plane.
    """
    sx, sy, cosine, sine = real(surface).T
    one = np.ones_like(sx)
    normal = np.stack([-sx, -sy, one], -1) / np.sqrt(1 + sx * sx + sy * sy)[:, None]
    # (1 − n_x², −n_x n_y, −n_x n_z) up to its length, with the cancellation taken out.
    u = np.stack([1 + sy * sy, -sx * sy, sx], -1)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(normal, u)
    length = np.hypot(cosine, sine)
    there = length > ROTATION_FLOOR
    c = np.where(there, cosine / np.where(there, length, 1), 1)[:, None]
    s = np.where(there, sine / np.where(there, length, 1), 0)[:, None]
    return c * u + s * v, c * v - s * u, normal
