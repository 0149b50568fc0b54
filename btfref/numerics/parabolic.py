"""Parabolic map of the upper hemisphere (Heidrich and Seidel 1998)."""

from __future__ import annotations

import numpy as np


def hemisphere_to_square(w):
    """Parabolic coordinates ``(s, t) = (w_x, w_y) / (1 + w_z)``, shape (..., 3) -> (..., 2).

    The hemisphere fills the unit disc; directions below the horizon fall outside of it.
    """
    w = np.asarray(w, float)
    return w[..., :2] / (1 + w[..., 2:])


def square_to_hemisphere(st):
    """Inverse of :func:`hemisphere_to_square`, shape (..., 2) -> (..., 3) unit vectors."""
    st = np.asarray(st, float)
    r2 = (st * st).sum(-1, keepdims=True)
    return np.concatenate([2 * st, 1 - r2], -1) / (1 + r2)


def solid_angle_density(st):
    """Solid angle per unit area of the map, ``4 / (1 + s² + t²)²``, shape (..., 2) -> (...)."""
    st = np.asarray(st, float)
    return 4 / (1 + (st * st).sum(-1)) ** 2
