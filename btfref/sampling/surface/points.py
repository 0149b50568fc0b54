"""Points on the surface of one tile, and which of them each texel sees from each view: NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.sampling.surface.triangles import Triangles


@dataclass
class Points:
    """Points on the surface: two independent halves, even and odd numbers; pairs (2s, 2s + 1) share a stratum.

    Attributes
    ----------
    p, n, s, shading : ndarray (P, 3) float32
        Position, geometric normal, tangent and shading normal.
    uv : ndarray (P, 2) float32
    part : ndarray (P,) int
    weight : ndarray (P,) float64
        Area that a point stands for in its half.
    """

    p: np.ndarray
    n: np.ndarray
    s: np.ndarray
    shading: np.ndarray
    uv: np.ndarray
    part: np.ndarray
    weight: np.ndarray


def sample_points(triangles: Triangles, density: np.ndarray, count: int, rng: np.random.Generator) -> Points:
    """Two independent sets of points, each stratified along the curve through the triangles.

    Parameters
    ----------
    triangles : Triangles
    density : ndarray (T,)
        Relative.
    count : int
        Even.
    rng : numpy.random.Generator

    Returns
    -------
    Points
    """
    mass = np.cumsum(density * triangles.area)
    place = (np.arange(count) // 2 + rng.random(count)) / (count // 2) * mass[-1]
    index = np.minimum(np.searchsorted(mass, place, side="right"), len(mass) - 1)
    # The rest of the stratified number places the point inside its triangle.
    first = np.clip(1 - (mass[index] - place) / (density * triangles.area)[index], 0.0, 1.0)
    root, second = np.sqrt(first), rng.random(count)
    bary = np.stack([1 - root, root * (1 - second), root * second], 1)
    weight = mass[-1] / (count // 2 * density[index])
    return _at(triangles.take(index), bary, weight)


def centroids(triangles: Triangles) -> Points:
    """The centroids of all triangles, as `Points` whose weights are the triangles' areas."""
    bary = np.full((len(triangles.area), 3), 1 / 3)
    return _at(triangles, bary, triangles.area)


def _at(triangles: Triangles, bary: np.ndarray, weight: np.ndarray) -> Points:
    p, shading, uv = (
        np.einsum("pk,pkx->px", bary, values)
        for values in (triangles.corners, triangles.normals, triangles.uv)
    )
    shading = shading / np.linalg.norm(shading, axis=1, keepdims=True)
    s = triangles.tangent - shading * np.einsum("px,px->p", shading, triangles.tangent)[:, None]
    s = s / np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-30)
    p, n, s, shading, uv = (a.astype(np.float32) for a in (p, triangles.facet, s, shading, uv))
    return Points(p, n, s, shading, uv, triangles.part, weight)


def texel_of(p: np.ndarray, w: np.ndarray, texels: tuple[int, int]) -> np.ndarray:
    """Texel whose square on z = 0 the ray from ``p`` along ``w`` crosses.

    Parameters
    ----------
    p : ndarray (P, 3)
    w : ndarray (3,)
    texels : tuple of int

    Returns
    -------
    ndarray (P,) int64
    """
    rows, columns = texels
    xy = p[:, :2].astype(np.float64) - p[:, 2:3].astype(np.float64) * (w[:2] / w[2])
    xy -= np.floor(xy)
    column = np.minimum((xy[:, 0] * columns).astype(np.int64), columns - 1)
    return np.minimum((xy[:, 1] * rows).astype(np.int64), rows - 1) * columns + column


@dataclass
class Bins:
    """Records that the texels of one direction see, texel by texel, pairs of a stratum side by side.

    Attributes
    ----------
    record : ndarray (E,) uint32
    weight : ndarray (E,) float32
        Share of the texel's footprint that a record stands for in its half; its half's sum has expectation 1.
    half : ndarray (E,) uint8
    flux : ndarray (E,) float32
        What a photon that starts at an entry drawn by weight counts.
    start : ndarray (texels + 1,) uint32
        Where a texel's entries begin.
    totals : ndarray (2, texels)
        Sum of weights of each half and texel.
    part : ndarray (E,) float32
        Weight of an entry in the mean of both halves, each corrected by the other (`surface_gather`).
    """

    record: np.ndarray
    weight: np.ndarray
    half: np.ndarray
    flux: np.ndarray
    start: np.ndarray
    totals: np.ndarray
    part: np.ndarray

    @classmethod
    def sorted(
        cls,
        texel: np.ndarray,
        record: np.ndarray,
        weight: np.ndarray,
        half: np.ndarray,
        flux: np.ndarray,
        n_texels: int,
    ) -> Bins:
        """From entries in the order of their records."""
        totals = np.bincount(half * n_texels + texel, weight, 2 * n_texels).reshape(2, -1)
        shares = np.where(totals > 0, 0.5 * (1 + totals - totals[::-1]) / np.maximum(totals, 1e-300), 0.0)
        part = weight * shares[half, texel]
        # Two bytes are sorted by radix; the order inside a texel stays.
        order = np.argsort(texel.astype(np.uint16) if n_texels <= 1 << 16 else texel, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(texel, minlength=n_texels))])
        return cls(
            record[order].astype(np.uint32),
            weight[order].astype(np.float32),
            half[order].astype(np.uint8),
            flux[order].astype(np.float32),
            start.astype(np.uint32),
            totals,
            part[order].astype(np.float32),
        )


def starts(bins: Sequence[Bins]) -> np.ndarray:
    """Where the entries of several bins, one after the other, begin: (len(bins) · texels + 1,) uint32."""
    offsets = np.cumsum([0, *(len(some.record) for some in bins)])
    parts = [some.start[:-1] + np.uint32(k) for some, k in zip(bins, offsets, strict=False)]
    return np.append(np.concatenate(parts), offsets[-1]).astype(np.uint32)


def footprints(
    points: Points, visible: np.ndarray, w: np.ndarray, texels: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the visible points fall in one view.

    Parameters
    ----------
    points : Points
    visible : ndarray (P,) bool
    w : ndarray (3,)
        The view.
    texels : tuple of int

    Returns
    -------
    texel, point : ndarray (k,) int
    weight : ndarray (k,)
        As in `Bins`.
    """
    index = np.flatnonzero(visible)
    cosine = np.abs(points.n[index] @ w.astype(np.float32))
    scale = texels[0] * texels[1] / w[2]
    return texel_of(points.p[index], w, texels), index, cosine * points.weight[index] * scale
