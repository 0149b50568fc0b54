"""Interpolation over sets of directions: the one definition that all evaluators share.

Two kinds of sets, one contract: ``stencil(w)`` returns indices and non-negative weights that sum to 1, are
continuous in ``w`` and exact at the samples. On ring grids the two neighbouring rings are blended, linear in φ
on each and linear in θ between them; inside a first ring that is no pole, its two sides (:func:`across_the_cap`).
Any other set is triangulated (spherical Delaunay) and blended with barycentric weights. What the ports need is in
:meth:`arrays`, in float32; :func:`from_arrays` rebuilds the interpolation from those same arrays, so that the float64
definition sees exactly what the ports see.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.numerics.draws import chosen
from btfref.numerics.sphere.parabolic import hemisphere_to_square
from btfref.precision import real

#: Columns of a row of ``triangles``: vertices a and b, dual normals of a, b and c, indices, neighbours, padding.
TRIANGLE_FLOATS = 24

#: Cells per side of the map that holds the triangle where the search starts.
START_CELLS = 32


@dataclass(frozen=True)
class RingInterpolation:
    """Interpolation on rings of equally spaced azimuths around the pole, with a sample there or without.

    Parameters
    ----------
    rings : ndarray, shape (n_rings, 4)
        Polar angle in radians, azimuth of the first sample in radians, number of samples and index of the
        first sample, for each ring; sorted by polar angle. The first ring is the pole with one sample, or a ring
        around it, whose inside is the polar cap.
    """

    rings: np.ndarray

    size = 4

    def stencil(
        self, w: ArrayLike, *, hold: bool = True, draw: ArrayLike | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Neighbouring samples of the directions ``w`` and their weights.

        Parameters
        ----------
        w : array_like, shape (..., 3)
            Unit vectors in the upper hemisphere.
        hold : bool
            True (views): the last ring is held down to the horizon. False (lights): it is held and multiplied by
            cos θ / cos θ_last, so that the weights fall to zero at the horizon.
        draw : array_like, shape (...), optional
            In [0, 1): one neighbour is drawn, and has the weight of all (:func:`btfref.numerics.draws.chosen`).

        Returns
        -------
        index : ndarray of int64, shape (..., 4), or (..., 1) with ``draw``
        weight : ndarray of float64, of the same shape
        """
        x, y, z = np.moveaxis(real(w), -1, 0)
        # acos(z) would lose half of the digits near the pole.
        theta = np.arctan2(np.hypot(x, y), z)
        turn = np.arctan2(y, x) / (2 * np.pi)
        table = real(self.rings)
        last = len(table) - 1
        low = np.clip(np.searchsorted(table[:, 0], theta, side="right") - 1, 0, last)
        high = np.minimum(low + 1, last)
        step = table[high, 0] - table[low, 0]
        t = np.clip((theta - table[low, 0]) / np.where(step > 0, step, 1), 0, 1)
        if draw is not None:
            # Beyond the last ring its samples are there twice: the lower ones have all of it, as in the ports.
            t = np.where(step > 0, t, 0)
        indices, weights = [], []
        for ring, share in ((low, 1 - t), (high, t)):
            count = table[ring, 2]
            position = (turn - table[ring, 1] / (2 * np.pi)) * count
            position = position - np.floor(position / count) * count
            first = np.minimum(np.floor(position), count - 1)
            fraction = position - first
            following = np.where(first + 1 < count, first + 1, 0)
            indices += [table[ring, 3] + first, table[ring, 3] + following]
            weights += [share * (1 - fraction), share * fraction]
            if ring is low and table[0, 0] > 0:
                cap = theta < table[0, 0]
                inset = (table[0, 0] - theta[cap]) / table[0, 0]
                inner = across_the_cap(first[cap], fraction[cap], inset, table[0, 2])
        weight, index = np.stack(weights, -1), np.stack(indices, -1)
        if table[0, 0] > 0:
            index[cap], weight[cap] = inner[0] + table[0, 3], inner[1]
        if not hold:
            edge = table[last, 0]
            if np.cos(edge) > 1e-6:
                fade = np.where(theta > edge, np.maximum(z, 0) / np.cos(edge), 1)
                weight = weight * fade[..., None]
        index = index.astype(np.int64)
        return (index, weight) if draw is None else chosen(index, weight, draw)

    def arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """The tables of the ports: ``{prefix}_rings``, float32 (n_rings, 4)."""
        return {f"{prefix}_rings": np.asarray(self.rings, np.float32)}


def across_the_cap(
    first: np.ndarray, fraction: np.ndarray, inset: np.ndarray, count: float
) -> tuple[np.ndarray, np.ndarray]:
    """Samples and weights inside the first ring of a set without a sample at the pole.

    The ring's samples are the corners of a regular polygon, sample 0 at (1, 0); a direction lies on the way from the
    middle to where its azimuth meets the polygon's edge, θ / θ_first of it. Its chord at right angles to the axis
    through sample 0 meets the polygon on either side: linear on both edges, as on the ring itself, and linear along the
    chord. So functions that are linear in the plane are kept, and the four samples are two neighbouring pairs, as
    those of two rings are; a mean of all samples at the pole would need them all.

    Parameters
    ----------
    first, fraction : ndarray, shape (n,)
        Sample at or before the azimuth, and the way from there to the next, [0, 1).
    inset : ndarray, shape (n,)
        1 − θ / θ_first, [0, 1].
    count : float
        Samples of the ring.

    Returns
    -------
    index : ndarray, shape (n, 4)
        On the ring, as floats.
    weight : ndarray, shape (n, 4)
        Non-negative, sum 1; for an inset of 0 those of the ring.
    """
    step, radius = 2 * np.pi / count, 1 - inset
    # The lower side is the mirror image of the upper one.
    lower = first + fraction > count / 2
    first, fraction = np.where(lower, count - 1 - first, first), np.where(lower, 1 - fraction, fraction)
    x = radius * ((1 - fraction) * np.cos(step * first) + fraction * np.cos(step * (first + 1)))
    # The corner at or before the chord on the upper side. Its mirror image is the corner after it on the lower side.
    corner = np.clip(np.floor(np.arccos(np.clip(x, -1, 1)) / step), 0, max(count // 2 - 1, 0))

    def before(k: np.ndarray) -> np.ndarray:
        """Cosine at the corner less that at corner k, as a product: near the axis, differences of cosines cancel."""
        return 2 * np.sin(0.5 * step * (corner + k)) * np.sin(0.5 * step * (k - corner))

    way = (1 - fraction) * before(first) + fraction * before(first + 1)
    way, width = inset * np.cos(step * corner) + radius * way, before(corner + 1)
    along = np.clip(way / np.where(width > 0, width, 1), 0, 1)
    y = radius * ((1 - fraction) * np.sin(step * first) + fraction * np.sin(step * (first + 1)))
    height = (1 - along) * np.sin(step * corner) + along * np.sin(step * (corner + 1))
    # At a corner on the axis the chord is a point, and any share of it will do.
    far = np.clip(0.5 - 0.5 * y / np.maximum(height, 1e-30), 0, 1)
    below = np.where(lower, 1 - far, far)
    mirrored = count - 1 - corner
    index = [corner, np.mod(corner + 1, count), mirrored, np.mod(mirrored + 1, count)]
    above = 1 - below
    weight = [above * (1 - along), above * along, below * along, below * (1 - along)]
    return np.stack(index, -1), np.stack(weight, -1)


@dataclass(frozen=True)
class TriangleInterpolation:
    """Barycentric interpolation on the spherical Delaunay triangulation of scattered directions.

    The triangulation includes the nadir as a vertex without data. In its triangles (a, b, nadir) only the edge
    (a, b) carries weight: directions beyond the outermost samples take the value at the same azimuth on that edge.

    Parameters
    ----------
    triangles : ndarray, shape (n_triangles, 24)
        a (3), b (3), dual normals n_a, n_b, n_c (9), sample indices (3, the third is -1 beyond the edge), the
        triangles across the edges opposite a, b and c (3), padding (3).
    cells : ndarray, shape (START_CELLS, START_CELLS)
        For each cell of the parabolic map the triangle that holds the cell's centre: where a search starts.
    """

    triangles: np.ndarray
    cells: np.ndarray

    size = 3

    def locate(self, w: ArrayLike) -> np.ndarray:
        """Triangle that holds each direction, by walking from the start cell; shape (..., 3) -> (...)."""
        w = real(w)
        table = real(self.triangles)
        square = hemisphere_to_square(w)
        n = len(self.cells)
        cell = np.clip(((square + 1) * (0.5 * n)).astype(np.int64), 0, n - 1)
        current = np.asarray(self.cells)[cell[..., 1], cell[..., 0]].astype(np.int64)
        flat, points = current.reshape(-1), np.broadcast_to(w, (*current.shape, 3)).reshape(-1, 3)
        # Most are where they start: only those that have to move go on.
        moving = np.arange(len(flat))
        for _ in range(len(table)):
            row = table[flat[moving]]
            coordinates = barycentric(row, points[moving])
            worst = np.argmin(coordinates, -1)[:, None]
            outside = np.take_along_axis(coordinates, worst, -1)[:, 0] < -1e-12
            moving = moving[outside]
            if not len(moving):
                break
            flat[moving] = np.take_along_axis(row[outside, 18:21], worst[outside], -1)[:, 0].astype(np.int64)
        return flat.reshape(current.shape)

    def stencil(
        self, w: ArrayLike, *, hold: bool = True, draw: ArrayLike | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Neighbouring samples and weights, as :meth:`RingInterpolation.stencil`, with three samples."""
        w = real(w)
        row = real(self.triangles)[self.locate(w)]
        weight = np.maximum(barycentric(row, w), 0)
        beyond = row[..., 17] < 0
        weight[..., 2] = np.where(beyond, 0, weight[..., 2])
        weight = weight / weight.sum(-1, keepdims=True)
        if not hold:
            edge = weight[..., :1] * row[..., 0:3] + weight[..., 1:2] * row[..., 3:6]
            length = np.linalg.norm(edge, axis=-1)
            cos_edge = edge[..., 2] / np.where(length > 0, length, 1)
            fade = np.maximum(w[..., 2], 0) / np.maximum(cos_edge, 1e-6)
            weight = weight * np.where(beyond, np.minimum(fade, 1), 1)[..., None]
        index = np.maximum(row[..., 15:18], 0).astype(np.int64)
        return (index, weight) if draw is None else chosen(index, weight, draw)

    def arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """The tables of the ports: ``{prefix}_triangles`` float32 and ``{prefix}_cells`` float32."""
        return {
            f"{prefix}_triangles": np.asarray(self.triangles, np.float32),
            f"{prefix}_cells": np.asarray(self.cells, np.float32),
        }


def barycentric(row: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Unnormalised barycentric coordinates of ``w`` in the triangles of ``row``; (..., 24), (..., 3) -> (..., 3).

    Differences to a vertex are taken first: each dual normal is orthogonal to it, and float32 ports keep their
    accuracy next to a sample.
    """
    from_a, from_b = w - row[..., 0:3], w - row[..., 3:6]
    return np.stack(
        [
            np.einsum("...i,...i->...", row[..., 6:9], from_b),
            np.einsum("...i,...i->...", row[..., 9:12], from_a),
            np.einsum("...i,...i->...", row[..., 12:15], from_a),
        ],
        -1,
    )


def triangulate(vectors: np.ndarray) -> TriangleInterpolation:
    """Spherical Delaunay triangulation of directions and the nadir.

    Parameters
    ----------
    vectors : ndarray, shape (n, 3)
        At least three unit vectors of the upper hemisphere, no two equal, not all on one great circle.

    Returns
    -------
    TriangleInterpolation
    """
    from scipy.spatial import ConvexHull

    n = len(vectors)
    points = np.vstack([vectors, [[0.0, 0.0, -1.0]]])
    # Regular sets are full of cocircular quadruples; a perturbation far below the spacing, the same in every run,
    # makes the hull simplicial. Only its combinatorics are used.
    radius = 1 + 1e-9 * np.random.default_rng(0).random(n + 1)
    simplices = ConvexHull(points * radius[:, None]).simplices.astype(np.int64)
    # The nadir goes last, so that beyond the edge the first two vertices carry the weight.
    simplices = np.sort(simplices, axis=1)
    simplices = simplices[np.lexsort(simplices.T[::-1])]
    a, b, c = (points[simplices[:, k]] for k in range(3))
    determinant = np.einsum("ij,ij->i", a, np.cross(b, c))[:, None]
    duals = [np.cross(b, c) / determinant, np.cross(c, a) / determinant, np.cross(a, b) / determinant]
    table = np.zeros((len(simplices), TRIANGLE_FLOATS))
    table[:, 0:3], table[:, 3:6] = a, b
    table[:, 6:15] = np.concatenate(duals, 1)
    table[:, 15:18] = np.where(simplices == n, -1, simplices)
    table[:, 18:21] = _neighbours(simplices)
    interpolation = TriangleInterpolation(table.astype(np.float32), np.zeros((1, 1)))
    return TriangleInterpolation(interpolation.triangles, _start_cells(interpolation))


def _neighbours(simplices: np.ndarray) -> np.ndarray:
    """Triangle across the edge opposite each vertex; (n, 3) -> (n, 3)."""
    n = len(simplices)
    edges = np.concatenate([simplices[:, [1, 2]], simplices[:, [0, 2]], simplices[:, [0, 1]]])
    owner = np.tile(np.arange(n), 3)
    corner = np.repeat(np.arange(3), n)
    order = np.lexsort(edges.T)
    first, second = order[0::2], order[1::2]
    result = np.zeros((n, 3), np.int64)
    result[owner[first], corner[first]] = owner[second]
    result[owner[second], corner[second]] = owner[first]
    return result


def _start_cells(interpolation: TriangleInterpolation) -> np.ndarray:
    from btfref.numerics.sphere.parabolic import square_to_hemisphere

    centre = (np.arange(START_CELLS) + 0.5) / START_CELLS * 2 - 1
    s, t = np.meshgrid(centre, centre)
    return interpolation.locate(square_to_hemisphere(np.stack([s, t], -1))).astype(np.float32)


#: Slot of a sample that is not kept.
MISSING = 0xFFFFFFFF


class ResidentInterpolation:
    """An interpolation of which only some samples are kept: its indices are slots.

    Parameters
    ----------
    inner : RingInterpolation or TriangleInterpolation
    slots : ndarray of uint32, shape (n, 1)
    kind : {"view", "light"}
        For messages.
    """

    def __init__(
        self, inner: RingInterpolation | TriangleInterpolation, slots: np.ndarray, kind: str = "view"
    ) -> None:
        self.inner, self.slots, self.kind = inner, slots[:, 0].astype(np.int64), kind

    def stencil(
        self, w: ArrayLike, *, hold: bool = True, draw: ArrayLike | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """As the interpolation's own, in slots; a drawn lookup needs only what it draws.

        Raises
        ------
        InputError
            When a sample with weight is not kept.
        """
        index, weight = self.inner.stencil(w, hold=hold, draw=draw)
        slot = self.slots[index]
        absent = slot == MISSING
        needed = absent & (weight > 0)
        if needed.any():
            raise InputError(
                f"a lookup needs {self.kind}s that are not resident",
                field=f"{self.kind}s",
                got=", ".join(map(str, np.unique(index[needed])[:8])),
            )
        return np.where(absent, 0, slot), weight


#: What interpolates over a set of directions.
Interpolation = RingInterpolation | TriangleInterpolation | ResidentInterpolation


def whole(
    interpolation: Interpolation,
) -> RingInterpolation | TriangleInterpolation:
    """The interpolation whose indices are samples, not slots: that inside of one of which only some are kept."""
    return interpolation.inner if isinstance(interpolation, ResidentInterpolation) else interpolation


def from_arrays(arrays: Mapping[str, np.ndarray], prefix: str) -> Interpolation:
    """The interpolation whose tables are stored under ``prefix`` (see :meth:`RingInterpolation.arrays`).

    With a table ``{prefix}_slots`` its samples are the slots of what is kept: :class:`ResidentInterpolation`.
    """
    found: RingInterpolation | TriangleInterpolation
    if f"{prefix}_rings" in arrays:
        found = RingInterpolation(arrays[f"{prefix}_rings"])
    else:
        found = TriangleInterpolation(arrays[f"{prefix}_triangles"], arrays[f"{prefix}_cells"])
    slots = arrays.get(f"{prefix}_slots")
    return found if slots is None else ResidentInterpolation(found, slots, prefix)
