"""A tree of boxes around triangles, through which ``shaders/lib/light/occluders.glsl`` follows a ray.

Triangles are sorted along a curve that fills space (Morton 1966), four to a leaf; the tree above is complete, so that
numbers alone say who is whose child, and a ray needs no stack: each node names the one that follows when the ray misses
its box.
"""

from __future__ import annotations

import numpy as np

#: Triangles of a leaf: their numbers fill a texel.
LEAF = 4

#: Share of the largest coordinate by which boxes are larger than what they hold: float32 rounds rays and boxes.
MARGIN = 2e-6

#: Cells along each axis in which triangles are sorted: bits.
BITS = 10


def box_tree(triangles: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and leaves as the shader reads them.

    Parameters
    ----------
    triangles : ndarray, shape (n ≥ 1, 3, 3)
        Corners in world space.
    numbers : ndarray of int, shape (n,)
        What the shader knows them by.

    Returns
    -------
    nodes : ndarray of float64, shape (2 m, 2, 4)
        m is the number of leaves, a power of two. Nodes are numbered by rows from the root, which is 1; the children of
        i are 2 i and 2 i + 1. Least corner and the node that follows the whole of this one, 0 behind the last; largest
        corner and the number of a leaf, or -1.
    leaves : ndarray of float64, shape (m, 4)
        Numbers of triangles, -1 where there is none.
    """
    corners = np.asarray(triangles, float)
    low, high = corners.min(1), corners.max(1)
    order = np.argsort(_curve(low + high), kind="stable")
    count = -(-len(order) // LEAF)
    m = 1 << (count - 1).bit_length()
    leaves = np.full(m * LEAF, -1.0)
    leaves[: len(order)] = np.asarray(numbers)[order]
    empty = 1e30
    bounds = np.full((2, 2 * m, 3), [[[empty]], [[-empty]]])
    padded = np.full((2, m * LEAF, 3), [[[empty]], [[-empty]]])
    padded[0, : len(order)], padded[1, : len(order)] = low[order], high[order]
    bounds[0, m:] = padded[0].reshape(m, LEAF, 3).min(1)
    bounds[1, m:] = padded[1].reshape(m, LEAF, 3).max(1)
    row = m
    while row > 1:
        pairs = bounds[:, row : 2 * row].reshape(2, row // 2, 2, 3)
        row //= 2
        bounds[0, row : 2 * row], bounds[1, row : 2 * row] = pairs[0].min(1), pairs[1].max(1)
    # A box of nothing is a place that no ray reaches.
    bounds[1] = np.where(bounds[0] > bounds[1], empty, bounds[1])
    margin = MARGIN * max(np.abs(corners).max(), 1e-30)
    nodes = np.zeros((2 * m, 2, 4))
    nodes[:, 0, :3], nodes[:, 1, :3] = bounds[0] - margin, bounds[1] + margin
    # The next sibling of the nearest ancestor that has one to come.
    following = np.arange(1, 2 * m + 1)
    following //= following & -following
    nodes[:, 0, 3] = np.where(following > 1, following, 0)
    nodes[:, 1, 3] = np.where(np.arange(2 * m) < m, -1, np.arange(2 * m) - m)
    return nodes, leaves.reshape(m, LEAF)


def _curve(points: np.ndarray) -> np.ndarray:
    """Places of points along the curve: bits of their cells, one axis after the other; shape (n,)."""
    low = points.min(0)
    size = np.maximum(points.max(0) - low, 1e-30).max()
    cells = np.minimum((points - low) / size * 2**BITS, 2**BITS - 1).astype(np.int64)
    place = np.zeros(len(points), np.int64)
    for bit in range(BITS):
        for axis in range(3):
            place |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return place
