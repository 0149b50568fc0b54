"""The surface of one tile as small triangles: where points are drawn, and where visibility is kept. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure

#: Share of the points that goes by area alone: what the pilot rays took for hidden is sampled as well.
FLOOR = 0.25

#: Share of the other points that goes by the spread of direct light.
VARIED = 0.5

#: Side of the cells over which the pilot's findings are smoothed, in tile units: a triangle whose centroid is
#: hidden may still show a corner, and few points of large weight are the worst of all.
CELL = 1 / 48

#: The absorber below open geometry lies this far under its lowest point, in tile units.
ABSORBER_GAP = 1e-3

#: Part index of the absorber.
ABSORBER = -1


@dataclass
class Triangles:
    """Small triangles that cover the surface, in an order that follows a space-filling curve.

    Attributes
    ----------
    corners, normals : ndarray (T, 3, 3)
        Positions and shading normals of the corners.
    uv : ndarray (T, 3, 2)
    facet : ndarray (T, 3)
        Unit geometric normals.
    tangent : ndarray (T, 3)
        ∂p/∂u.
    area : ndarray (T,)
    part : ndarray (T,) int
        `ABSORBER` for the black plane below open geometry.
    """

    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    facet: np.ndarray
    tangent: np.ndarray
    area: np.ndarray
    part: np.ndarray

    def take(self, index: np.ndarray) -> Triangles:
        """The triangles of an index or mask."""
        return Triangles(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass
class Descent:
    """From a face of the mesh to the small triangle of it that holds a point.

    A face of level L was cut L times into four; the quarters' numbers are the digits of a code to base 4.

    Attributes
    ----------
    part_start : ndarray (parts,) uint32
        Number of each part's first face.
    level : ndarray (F,) uint32
    first : ndarray (F,) uint32
        Place in `row` of the face's code 0.
    row : ndarray (T,) uint32
        Small triangles in the order of `Triangles`.
    """

    part_start: np.ndarray
    level: np.ndarray
    first: np.ndarray
    row: np.ndarray


def triangles(mesostructure: Mesostructure, largest: float) -> tuple[Triangles, Descent]:
    """Triangles of all parts and of the absorber, split until none is larger than ``largest``.

    Parameters
    ----------
    mesostructure : Mesostructure
    largest : float
        Area in tile units.

    Returns
    -------
    Triangles, Descent
    """
    low = mesostructure.height[0] - ABSORBER_GAP
    square = np.array([[0, 0, low], [1, 0, low], [1, 1, low], [0, 1, low]], np.float64)
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    sheets = [
        (part.vertices, part.faces, part.normals, part.uv, k) for k, part in enumerate(mesostructure.parts)
    ]
    sheets.append((square, np.array([[0, 1, 2], [0, 2, 3]]), up, None, ABSORBER))
    gathered, levels, firsts, count = [], [], [], 0
    for vertices, faces, normals, uv, part in sheets:
        # float32 is what rays meet.
        vertices = vertices.astype(np.float32).astype(np.float64)
        uv = vertices[:, :2] if uv is None else np.asarray(uv, np.float64)
        corners = vertices[faces]
        facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(facet, axis=1)
        # Faces without area stay in the list, so that numbers of faces mean the same here and in the mesh.
        facet = np.where(length[:, None] > 0, facet / np.maximum(length, 1e-300)[:, None], [0.0, 0.0, 1.0])
        shading = (
            np.repeat(facet[:, None], 3, 1) if normals is None else np.asarray(normals, np.float64)[faces]
        )
        # As Mitsuba turns the geometric normal of a mesh with vertex normals to their side.
        turned = np.einsum("tx,tx->t", facet, shading.sum(1)) < 0
        facet = np.where(turned[:, None], -facet, facet)
        tangent = _tangents(corners, uv[faces], facet)
        level = np.ceil(np.log2(np.maximum(0.5 * length / largest, 1)) / 2).astype(np.int64)
        first = np.zeros(len(faces), np.int64)
        for depth in np.unique(level):
            chosen = np.flatnonzero(level == depth)
            pieces = [_quartered(values[chosen], depth) for values in (corners, shading, uv[faces])]
            edges = pieces[0][:, 1:] - pieces[0][:, :1]
            area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
            owner = np.repeat(chosen, 4**depth)
            first[chosen] = count + np.arange(len(chosen)) * 4**depth
            count += len(owner)
            gathered.append((*pieces, facet[owner], tangent[owner], area, np.full(len(area), part)))
        levels.append(level)
        firsts.append(first)
    result = Triangles(*(np.concatenate(pieces) for pieces in zip(*gathered, strict=True)))
    # Sheets one after the other, or points of one would be drawn at random among those above and below.
    key = _morton(result.corners.mean(1)) + (np.uint64(1) << np.uint64(20)) * (
        2 * (result.part - ABSORBER) + (result.facet[:, 2] < 0)
    ).astype(np.uint64)
    order = np.argsort(key, kind="stable")
    row = np.zeros(len(order), np.uint32)
    row[order] = np.arange(len(order), dtype=np.uint32)
    starts = np.concatenate([[0], np.cumsum([len(level) for level in levels])[:-1]])
    part_start, face_level, face_first = (
        word.astype(np.uint32) for word in (starts[:-1], np.concatenate(levels), np.concatenate(firsts))
    )
    return result.take(order), Descent(part_start, face_level, face_first, row)


def _quartered(values: np.ndarray, depth: int) -> np.ndarray:
    """Triangles (F, 3, k) cut ``depth`` times into four, the pieces of each in a row: (4**depth · F, 3, k)."""
    for _ in range(depth):
        a, b, c = values[:, 0], values[:, 1], values[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
        pieces = np.stack([np.stack(quarter, 1) for quarter in quarters], 1)
        values = pieces.reshape(-1, *values.shape[1:])
    return values


def _tangents(corners: np.ndarray, uv: np.ndarray, facet: np.ndarray) -> np.ndarray:
    """∂p/∂u of each triangle; any tangent where the texture coordinates are degenerate."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    good = determinant != 0
    inverse = 1 / np.where(good, determinant, 1)
    tangent = (d2[:, 1, None] * e1 - d1[:, 1, None] * e2) * inverse[:, None]
    sign = np.where(facet[:, 2] >= 0, 1.0, -1.0)
    a = -1 / (sign + facet[:, 2])
    b = facet[:, 0] * facet[:, 1] * a
    other = np.stack([1 + sign * facet[:, 0] ** 2 * a, sign * b, -sign * facet[:, 0]], 1)
    return np.where(good[:, None], tangent, other)


def _morton(points: np.ndarray) -> np.ndarray:
    """Place of points along a space-filling curve over the tile."""
    cell = np.floor((points[:, :2] % 1.0) * 1024).astype(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(2):
            key |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(2 * bit + axis)
    return key


def density(triangles: Triangles, views: np.ndarray, visible: np.ndarray, varied: np.ndarray) -> np.ndarray:
    """Points per area of each triangle, relative, to see every view's texels about equally well.

    Parameters
    ----------
    triangles : Triangles
    views : ndarray (V, 3)
    visible : ndarray (V, T) bool
        From pilot rays at the centroids.
    varied : ndarray (T,)
        Spread of light inside texels, see `surface_pilot.contrast`.

    Returns
    -------
    ndarray (T,)
        A mixture of ``varied``, of ``√mean_v ((n·v)/v_z)² V`` (the density of least mean variance where light
        varies alike everywhere, as indirect light does) and of a floor by area.
    """
    cosine = views @ triangles.facet.T
    scale = np.where(visible, np.abs(cosine) / views[:, 2:], 0.0)
    wanted = np.sqrt(np.mean(scale**2, axis=0))
    cell = np.floor(triangles.corners.mean(1) / CELL).astype(np.int64) % (1 << 18)
    key = (((triangles.part - ABSORBER) * (1 << 18) + cell[:, 0]) << 36) + (cell[:, 1] << 18) + cell[:, 2]
    _, key = np.unique(key, return_inverse=True)
    total = triangles.area.sum()
    mean = (wanted * triangles.area).sum() / total
    spread = (varied * triangles.area).sum() / total
    if spread > 0:
        wanted = (1 - VARIED) * wanted + VARIED * mean / spread * varied
    # Cells of faces without area hold none.
    around = np.bincount(key, wanted * triangles.area) / np.maximum(np.bincount(key, triangles.area), 1e-300)
    wanted = 0.5 * (wanted + around[key])
    result = wanted + FLOOR * mean
    hidden = triangles.part == ABSORBER
    if not wanted[hidden].any():
        result[hidden] = 0.0
    return result
