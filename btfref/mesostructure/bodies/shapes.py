"""Closed bodies as triangles: tori, ellipsoids and thin plates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.checks import sweep_faces

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def torus(
    radius: float,
    wire: float,
    segments: int,
    sides: int,
    centre: ArrayLike,
    frame: tuple[ArrayLike, ArrayLike, ArrayLike] = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals of a ring.

    Parameters
    ----------
    radius, wire : float
        Of the axis and of the tube.
    segments, sides : int
        Quads along the ring and around the tube.
    centre : array_like (3,)
    frame : three of array_like (3,)
        Two axes of the ring's plane and its normal, right-handed.

    Returns
    -------
    vertices, normals : ndarray (segments · sides, 3)
        For `torus_faces`.
    """
    first, second, up = (np.asarray(axis, np.float64) for axis in frame)
    along = 2 * np.pi * np.arange(segments)[:, None, None] / segments
    around = 2 * np.pi * np.arange(sides)[None, :, None] / sides
    out = np.cos(along) * first + np.sin(along) * second
    normal = np.cos(around) * out + np.sin(around) * up
    middle = np.asarray(centre, np.float64) + radius * out
    return (middle + wire * normal).reshape(-1, 3), normal.reshape(-1, 3)


def torus_faces(segments: int, sides: int) -> np.ndarray:
    """Triangles (F, 3) of a ring's vertices."""
    return sweep_faces(segments + 1, sides) % (segments * sides)


def ellipsoids(
    centres: np.ndarray, axes: np.ndarray, turn: np.ndarray, rings: int, sides: int
) -> tuple[np.ndarray, ...]:
    """Ellipsoids with two poles each.

    Parameters
    ----------
    centres : ndarray (n, 3)
    axes : ndarray (n, 3)
        Half axes along x, y and z.
    turn : ndarray (n,)
        Angle by which each is turned about z.
    rings, sides : int
        Rings of vertices between the poles, and vertices of a ring.

    Returns
    -------
    vertices, normals : ndarray (V, 3)
    faces : ndarray (F, 3)
    """
    polar = np.pi * np.arange(rings, 0, -1)[:, None] / (rings + 1)
    around = 2 * np.pi * np.arange(sides)[None, :] / sides
    ball = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), -1
    ).reshape(-1, 3)
    ball = np.concatenate([ball, [[0, 0, -1], [0, 0, 1]]])
    # Upwards around: rings from the lower pole, along × around points inward, so faces are turned.
    faces = np.concatenate([sweep_faces(rings, sides)[:, ::-1], *fans(rings, sides)])
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]

    def turned(v: np.ndarray) -> np.ndarray:
        return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], -1)

    vertices = centres[:, None] + turned(axes[:, None] * ball)
    normals = turned(ball / axes[:, None])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), repeated(faces, len(ball), len(centres))


def fans(rings: int, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that close a stack of rings: around the last vertex but one below the first, the last above the last.

    Parameters
    ----------
    rings, sides : int
        Vertices are numbered ring · sides + side, then the two ends; sides go counter-clockwise seen from above.

    Returns
    -------
    low, high : ndarray (sides, 3)
    """
    here = np.arange(sides)
    beside = (here + 1) % sides
    last = (rings - 1) * sides
    low, high = np.full(sides, rings * sides), np.full(sides, rings * sides + 1)
    return np.stack([low, beside, here], 1), np.stack([high, last + here, last + beside], 1)


def plates(
    centres: np.ndarray, radii: np.ndarray, thickness: float, frames: np.ndarray, sides: int
) -> tuple[np.ndarray, np.ndarray]:
    """Thin regular prisms, which shade their facets.

    Parameters
    ----------
    centres : ndarray (n, 3)
    radii : ndarray (n,)
        Of the corners.
    thickness : float
    frames : ndarray (n, 3, 3)
        Rotations: the last column is a plate's normal.
    sides : int

    Returns
    -------
    vertices : ndarray (V, 3)
    faces : ndarray (F, 3)
    """
    around = 2 * np.pi * np.arange(sides) / sides
    disc = np.stack([np.cos(around), np.sin(around)], -1)
    flat = np.concatenate([disc, disc, [[0, 0], [0, 0]]])
    z = 0.5 * thickness * np.concatenate([-np.ones(sides), np.ones(sides), [-1, 1]])
    local = np.concatenate(
        [radii[:, None, None] * flat, np.broadcast_to(z[:, None], (len(radii), len(z), 1))], -1
    )
    vertices = centres[:, None] + np.einsum("nij,nkj->nki", frames, local)
    faces = np.concatenate([sweep_faces(2, sides)[:, ::-1], *fans(2, sides)])
    return vertices.reshape(-1, 3), repeated(faces, len(flat), len(centres))


def repeated(faces: np.ndarray, size: int, count: int) -> np.ndarray:
    """Faces of `count` bodies of `size` vertices each."""
    return (faces[None] + size * np.arange(count)[:, None, None]).reshape(-1, 3)


def tilted(tilt: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) that tilt z by an angle towards an azimuth."""
    zero, one = np.zeros_like(tilt), np.ones_like(tilt)
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    c, s = np.cos(tilt), np.sin(tilt)
    lean = np.array([[c, zero, s], [zero, one, zero], [-s, zero, c]]).transpose(2, 0, 1)
    return turn @ lean @ turn.transpose(0, 2, 1)
