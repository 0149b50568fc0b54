"""Tubes along curves, and the fibres that yarns are of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.checks import sweep_faces

if TYPE_CHECKING:
    from btfref.types import Facts


def fibre(base: Sequence[float], roughness: float, anisotropy: float, sheen: float) -> Facts:
    """Mitsuba's ``principled`` for fibres that run along u.

    Parameters
    ----------
    base : sequence of 3 floats
    roughness, anisotropy, sheen : float

    Returns
    -------
    dict
    """
    return {
        "type": "principled",
        "base_color": {"type": "rgb", "value": base},
        "roughness": roughness,
        "anisotropic": anisotropy,
        "sheen": sheen,
        "sheen_tint": 0.5,
        "specular": 0.4,
    }


def upright_tubes(
    height: np.ndarray,
    slope: np.ndarray,
    y: np.ndarray,
    half_width: float,
    half_thickness: float,
    sides: int,
) -> tuple[np.ndarray, ...]:
    """Yarns along x whose elliptic sections stay upright (a sheared sweep).

    Parameters
    ----------
    height, slope : ndarray (count, n)
        Of the axes over x = 0 … 1 and their derivatives; the last is the first of the next tile.
    y : ndarray (count,)
        Of the axes.
    half_width, half_thickness : float
    sides : int
        Quads around a yarn.

    Returns
    -------
    vertices, normals : ndarray (V, 3)
    uv : ndarray (V, 2)
        u along the yarn.
    faces : ndarray (F, 3)
    """
    n_along = height.shape[1]
    x = np.arange(n_along) / (n_along - 1)
    around = -2 * np.pi * np.arange(sides) / sides
    vertices, normals, uv, faces = [], [], [], []
    for index in range(len(height)):
        across = y[index] + half_width * np.cos(around)
        z = height[index][:, None] + half_thickness * np.sin(around)
        ring = np.stack(np.broadcast_arrays(x[:, None], across[None, :], z), -1)
        # The normal is that of the section, tilted by the slope.
        sideways = np.cos(around) / half_width
        up = np.sin(around) / half_thickness
        normal = np.stack(np.broadcast_arrays(-slope[index][:, None] * up, sideways, up), -1)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        vertices.append(ring.reshape(-1, 3))
        normals.append(normal.reshape(-1, 3))
        texture = np.broadcast_arrays(x[:, None], np.arange(sides)[None, :] / sides)
        uv.append(np.stack(texture, -1).reshape(-1, 2))
        faces.append(sweep_faces(n_along, sides) + index * n_along * sides)
    return tuple(np.concatenate(parts) for parts in (vertices, normals, uv, faces))


def round_tubes(axis: np.ndarray, tangent: np.ndarray, radius: float, sides: int) -> tuple[np.ndarray, ...]:
    """Round yarns along curves that are nowhere vertical.

    Parameters
    ----------
    axis, tangent : ndarray (count, n, 3)
        Points and unit tangents of the curves.
    radius : float
    sides : int

    Returns
    -------
    vertices, normals, uv, faces : ndarray
        As of `upright_tubes`.
    """
    count, n_along = axis.shape[:2]
    sideways = np.cross([0.0, 0.0, 1.0], tangent)
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    up = np.cross(tangent, sideways)
    # Clockwise along the tangent, as faces want it.
    around = -2 * np.pi * np.arange(sides) / sides
    normals = np.cos(around)[:, None] * sideways[:, :, None] + np.sin(around)[:, None] * up[:, :, None]
    vertices = axis[:, :, None] + radius * normals
    along = np.arange(n_along)[:, None] / (n_along - 1)
    uv = np.stack(np.broadcast_arrays(along, np.arange(sides)[None, :] / sides), -1)
    faces = [sweep_faces(n_along, sides) + k * n_along * sides for k in range(count)]
    return (
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(uv.reshape(-1, 2), (count, 1)),
        np.concatenate(faces),
    )
