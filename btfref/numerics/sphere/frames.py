"""Tangent frames: Mitsuba's shading frame (``SurfaceInteraction.initialize_sh_frame``), and that of a height field."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.precision import real
from btfref.types import PathLike

#: Length of interpolated cosine and sine below which tangents of all directions meet: there is no turn to speak of, and
#: float32 would make one up (its rounding of 6e-8 turns a tangent by 6e-6 at this length).
ROTATION_FLOOR = 0.01


def shading_frame(normal: ArrayLike, dp_du: ArrayLike) -> np.ndarray:
    """Orthonormal frame from a shading normal and the tangent ∂p/∂u.

    Parameters
    ----------
    normal : array_like, shape (..., 3)
        Unit shading normal n.
    dp_du : array_like, shape (..., 3)
        Derivative of the position with respect to u; any length, not parallel to the normal.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Rows s, t, n with ``s = normalize(dp_du − n (n · dp_du))`` and ``t = n × s``: the matrix takes world vectors
        to the local frame.
    """
    normal, dp_du = np.asarray(normal, float), np.asarray(dp_du, float)
    s = dp_du - normal * (normal * dp_du).sum(-1, keepdims=True)
    s = s / np.linalg.norm(s, axis=-1, keepdims=True)
    return np.stack([s, np.cross(normal, s), normal], -2)


def nearest_rotation(linear: ArrayLike) -> tuple[float, float]:
    """The rotation nearest to a linear map of texture coordinates (its polar factor).

    By this angle local directions turn about the normal to reach the frame of a transformed texture.

    Parameters
    ----------
    linear : array_like, shape (2, 2)
        With a positive determinant.

    Returns
    -------
    tuple of float
        Cosine and sine of the angle.
    """
    (a, b), (c, d) = np.asarray(linear, float).tolist()
    cosine, sine = a + d, c - b
    length = float(np.hypot(cosine, sine))
    return (cosine / length, sine / length) if length > 0 else (1.0, 0.0)


def uv_transform(
    matrix: ArrayLike, *, file: PathLike | None = None
) -> tuple[np.ndarray, tuple[float, float]]:
    """Affine map of texture coordinates and the rotation that it gives to the local frame.

    Parameters
    ----------
    matrix : array_like, shape (4, 4) or (3, 3)
        Mitsuba's ``to_uv``.
    file : path-like, optional
        For messages.

    Returns
    -------
    affine : ndarray, shape (2, 3)
    rotation : tuple of float
        Cosine and sine of the angle by which local directions turn about the normal to reach the texture's frame:
        that of the rotation nearest to the linear part.

    Raises
    ------
    InputError
        For a mirroring or singular transform, which would make the local frame left-handed.
    """
    m = np.asarray(matrix, float)
    affine = np.concatenate([m[:2, :2], m[:2, -1:]], 1)
    if np.linalg.det(affine[:, :2]) <= 0:
        raise InputError(
            "the transform mirrors or is singular",
            file=file,
            field="to_uv",
            expected="a positive determinant",
        )
    return affine, nearest_rotation(affine[:, :2])


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
