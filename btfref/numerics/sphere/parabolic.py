"""Parabolic map of the upper hemisphere (Heidrich and Seidel 1998), as coordinates and as a table of texels.

A table of n × n texels covers (s, t) in [−1, 1]²: ``table[row, column]`` with s along columns and t along rows, texel
centres at ``(i + ½) · 2/n − 1``, as an OpenGL texture of s ↦ (s + 1)/2 has them. Lookups are bilinear and clamp to the
edge. The hemisphere fills the unit disc; texels outside of it hold the value of the nearest point of the horizon, so
that no lookup of the hemisphere reads anything else. The ports are :mod:`mitsuba_plugins.lib.parabolic` and
``shaders/lib/lookup/parabolic_maps.glsl``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.precision import real


def hemisphere_to_square(w: ArrayLike) -> np.ndarray:
    """Parabolic coordinates ``(s, t) = (w_x, w_y) / (1 + w_z)``, shape (..., 3) -> (..., 2).

    The hemisphere fills the unit disc; directions below the horizon fall outside of it.
    """
    w = real(w)
    return w[..., :2] / (1 + w[..., 2:])


def square_to_hemisphere(st: ArrayLike) -> np.ndarray:
    """Inverse of :func:`hemisphere_to_square`, shape (..., 2) -> (..., 3) unit vectors."""
    st = np.asarray(st, float)
    r2 = (st * st).sum(-1, keepdims=True)
    return np.concatenate([2 * st, 1 - r2], -1) / (1 + r2)


def solid_angle_density(st: ArrayLike) -> np.ndarray:
    """Solid angle per unit area of the map, ``4 / (1 + s² + t²)²``, shape (..., 2) -> (...)."""
    st = np.asarray(st, float)
    return 4 / (1 + (st * st).sum(-1)) ** 2


def texel_centres(n: int) -> np.ndarray:
    """Coordinates (s, t) of the texel centres of an n × n table, shape (n, n, 2)."""
    centre = (np.arange(n) + 0.5) * (2 / n) - 1
    s, t = np.meshgrid(centre, centre)
    return np.stack([s, t], -1)


def texel_directions(n: int) -> np.ndarray:
    """Directions that the texels of an n × n table stand for, shape (n, n, 3).

    Outside of the disc: the nearest point of the horizon.
    """
    st = texel_centres(n)
    return square_to_hemisphere(st / np.maximum(np.linalg.norm(st, axis=-1, keepdims=True), 1))


def texel_solid_angles(n: int) -> np.ndarray:
    """Solid angles of the texels of an n × n table in sr, shape (n, n); sum 2π.

    Zero where a texel lies outside of the disc.
    """
    fine = 8
    st = texel_centres(n * fine)
    density = solid_angle_density(st) * ((st * st).sum(-1) <= 1)
    density = density.reshape(n, fine, n, fine).sum((1, 3))
    return density * (2 * np.pi / density.sum())


def bilinear_stencil(w: ArrayLike, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels of an n × n table that a lookup blends, and their weights.

    Parameters
    ----------
    w : array_like, shape (..., 3)
        Directions of the upper hemisphere of any length; zero counts as the pole.
    n : int

    Returns
    -------
    index : ndarray of int64, shape (..., 4)
        Flat ``row * n + column``.
    weight : ndarray of float64, shape (..., 4)
        Non-negative, sum 1.
    """
    w = real(w)
    scale = np.linalg.norm(w, axis=-1) + w[..., 2]
    st = w[..., :2] / np.where(scale > 0, scale, 1)[..., None]
    position = np.clip(st * (n / 2) + (n - 1) / 2, 0, n - 1)
    low = np.floor(position)
    fraction = position - low
    c0, r0 = np.moveaxis(low.astype(np.int64), -1, 0)
    c1, r1 = np.minimum(c0 + 1, n - 1), np.minimum(r0 + 1, n - 1)
    fx, fy = np.moveaxis(fraction, -1, 0)
    index = np.stack([r0 * n + c0, r0 * n + c1, r1 * n + c0, r1 * n + c1], -1)
    return index, np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
