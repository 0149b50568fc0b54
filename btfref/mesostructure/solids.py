"""Whether the surfaces of a mesostructure close, over the tile's seam as well, and whether any bodies meet.

Vertices are one where they are within a billionth of each other, modulo the tile. A closed surface uses every edge once
in each direction. Bodies do not meet where every vertical line enters a body, leaves it, and only then enters the next:
lines are those through the middles of a fine grid of cells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure

#: Cells along a side, shifted so that no line meets a vertex of regular geometry.
_SIDE, _SHIFT = 192, np.array([0.3819, 0.6180])

#: Triangles that are looked at together.
_TOGETHER = 1 << 14


def welded(vertices: np.ndarray) -> np.ndarray:
    """Number of the place of each vertex (V,), the same for vertices that are one on the torus."""
    place = np.concatenate([vertices[:, :2] % 1.0, vertices[:, 2:]], 1)
    key = np.rint(place * 1e9).astype(np.int64)
    key[:, :2] %= 10**9
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


def open_edges(mesostructure: Mesostructure) -> int:
    """How many directed edges have no partner, or more than one; those of flat planes over the whole tile do not count.

    Parameters
    ----------
    mesostructure : Mesostructure

    Returns
    -------
    int
    """
    vertices, faces, _ = _joined(mesostructure)
    place = welded(vertices)[faces]
    edges = np.concatenate([place[:, [0, 1]], place[:, [1, 2]], place[:, [2, 0]]])
    n = int(edges.max()) + 1 if len(edges) else 1
    forward, times = np.unique(edges[:, 0] * n + edges[:, 1], return_counts=True)
    backward = forward % n * n + forward // n
    partner = np.isin(backward, forward)
    return int((~partner).sum() + (times > 1).sum())


def bodies(mesostructure: Mesostructure) -> np.ndarray:
    """Number of the connected surface that each face belongs to; faces in the order of the parts, planes left out."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices, faces, _ = _joined(mesostructure)
    place = welded(vertices)[faces]
    n = int(place.max()) + 1
    row, column = place[:, [0, 1]].ravel(), place[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1])[place[:, 0]]


def meetings(mesostructure: Mesostructure) -> int:
    """On how many vertical lines bodies meet, are open, or are turned inside out.

    Parameters
    ----------
    mesostructure : Mesostructure

    Returns
    -------
    int
        Of `_SIDE`² lines. A height field is a body that ends nowhere below.
    """
    vertices, faces, plane = _joined(mesostructure)
    found = _crossings(vertices, faces, bodies(mesostructure))
    line, z, up, body = found
    order = np.lexsort((-z, line))
    line, z, up, body = line[order], z[order], up[order], body[order]
    start = np.flatnonzero(np.r_[True, line[1:] != line[:-1]])
    depth = np.arange(len(line)) - np.repeat(start, np.diff(np.r_[start, len(line)]))
    entering = depth % 2 == 0
    wrong = up != entering
    wrong[1:] |= ~entering[1:] & (body[1:] != body[:-1])
    wrong |= z < plane
    return len(np.unique(line[wrong]))


def _joined(mesostructure: Mesostructure) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices and faces of all parts but planes, and the height of the highest plane (−∞ without one)."""
    vertices, faces, first, plane = [], [], 0, -np.inf
    for part in mesostructure.parts:
        z = part.vertices[:, 2]
        if np.ptp(z) == 0 and z[0] == mesostructure.height[0]:
            plane = max(plane, float(z[0]))
            continue
        vertices.append(part.vertices)
        faces.append(part.faces.astype(np.int64) + first)
        first += len(part.vertices)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), plane
    return np.concatenate(vertices), np.concatenate(faces), plane


def _crossings(vertices: np.ndarray, faces: np.ndarray, body: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where vertical lines cross faces: number of the line, height, whether the face looks up, its body."""
    found = []
    for first in range(0, len(faces), _TOGETHER):
        some = faces[first : first + _TOGETHER]
        corners = vertices[some]
        flat = corners[..., :2] * _SIDE - _SHIFT
        low = np.ceil(flat.min(1)).astype(np.int64)
        size = np.floor(flat.max(1)).astype(np.int64) - low + 1
        count = np.prod(np.maximum(size, 0), 1)
        face = np.repeat(np.arange(len(some)), count)
        inside = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
        cell = low[face] + np.stack([inside % size[face, 0], inside // size[face, 0]], -1)
        a, b, c = (flat[face, k] - cell for k in range(3))
        weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], -1)
        total = weights.sum(-1)
        hit = ((weights > 0).all(-1) & (total > 0)) | ((weights < 0).all(-1) & (total < 0))
        face, cell, weights, total = face[hit], cell[hit], weights[hit], total[hit]
        z = (weights * corners[face, :, 2]).sum(-1) / total
        line = (cell[:, 1] % _SIDE) * _SIDE + cell[:, 0] % _SIDE
        found.append((line, z, total > 0, body[first + face]))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
