"""Points on the surface of one tile, and which of them each texel sees from each view: NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Share of the points that goes by area alone: what the pilot rays took for hidden is sampled as well.
FLOOR = 0.25

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

    def take(self, index):
        """The triangles of an index or mask."""
        return Triangles(
            *(
                getattr(self, name)[index]
                for name in ("corners", "normals", "uv", "facet", "tangent", "area", "part")
            )
        )


def triangles(mesostructure, largest):
    """Triangles of all parts and of the absorber, split until none is larger than ``largest``.

    Parameters
    ----------
    mesostructure : Mesostructure
    largest : float
        Area in tile units.

    Returns
    -------
    Triangles
    """
    low = mesostructure.height[0] - ABSORBER_GAP
    square = np.array([[0, 0, low], [1, 0, low], [1, 1, low], [0, 1, low]], np.float64)
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    sheets = [
        (part.vertices, part.faces, part.normals, part.uv, k) for k, part in enumerate(mesostructure.parts)
    ]
    sheets.append((square, np.array([[0, 1, 2], [0, 2, 3]]), up, None, ABSORBER))
    gathered = []
    for vertices, faces, normals, uv, part in sheets:
        # float32 is what rays meet.
        vertices = vertices.astype(np.float32).astype(np.float64)
        uv = vertices[:, :2] if uv is None else np.asarray(uv, np.float64)
        corners = vertices[faces]
        facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(facet, axis=1)
        corners, facet, faces, length = (a[length > 0] for a in (corners, facet, faces, length))
        facet = facet / length[:, None]
        shading = (
            np.repeat(facet[:, None], 3, 1) if normals is None else np.asarray(normals, np.float64)[faces]
        )
        # As Mitsuba turns the geometric normal of a mesh with vertex normals to their side.
        turned = np.einsum("tx,tx->t", facet, shading.sum(1)) < 0
        facet = np.where(turned[:, None], -facet, facet)
        tangent = _tangents(corners, uv[faces], facet)
        corners, shading, uv, owner = _split(corners, shading, uv[faces], 0.5 * length, largest)
        area = 0.5 * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        gathered.append((corners, shading, uv, facet[owner], tangent[owner], area, np.full(len(area), part)))
    result = Triangles(*(np.concatenate(pieces) for pieces in zip(*gathered, strict=True)))
    # Sheets one after the other, or points of one would be drawn at random among those above and below.
    key = _morton(result.corners.mean(1)) + (np.uint64(1) << np.uint64(20)) * (
        2 * (result.part - ABSORBER) + (result.facet[:, 2] < 0)
    ).astype(np.uint64)
    return result.take(np.argsort(key, kind="stable"))


def _tangents(corners, uv, facet):
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


def _split(corners, normals, uv, area, largest):
    """Cut triangles into four until they are small enough; also says which triangle each came from."""
    owner = np.arange(len(corners))
    done = []
    while len(corners):
        small = area <= largest
        done.append((corners[small], normals[small], uv[small], owner[small]))
        corners, normals, uv, area, owner = (a[~small] for a in (corners, normals, uv, area, owner))
        pieces = []
        for values in (corners, normals, uv):
            a, b, c = values[:, 0], values[:, 1], values[:, 2]
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
            pieces.append(np.concatenate([np.stack(quarter, 1) for quarter in quarters]))
        corners, normals, uv = pieces
        area, owner = np.tile(area / 4, 4), np.tile(owner, 4)
    return tuple(np.concatenate(parts) for parts in zip(*done, strict=True))


def _morton(points):
    """Place of points along a space-filling curve over the tile."""
    cell = np.floor((points[:, :2] % 1.0) * 1024).astype(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(2):
            key |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(2 * bit + axis)
    return key


def density(triangles, views, visible):
    """Points per area of each triangle, relative, to see every view's texels about equally well.

    Parameters
    ----------
    triangles : Triangles
    views : ndarray (V, 3)
    visible : ndarray (V, T) bool
        From pilot rays at the centroids.

    Returns
    -------
    ndarray (T,)
        ``√mean_v ((n·v)/v_z)² V`` (the density of least mean variance) and a floor by area.
    """
    cosine = views @ triangles.facet.T
    scale = np.where(visible, np.abs(cosine) / views[:, 2:], 0.0)
    wanted = np.sqrt(np.mean(scale**2, axis=0))
    cell = np.floor(triangles.corners.mean(1) / CELL).astype(np.int64) % (1 << 18)
    key = (((triangles.part - ABSORBER) * (1 << 18) + cell[:, 0]) << 36) + (cell[:, 1] << 18) + cell[:, 2]
    _, key = np.unique(key, return_inverse=True)
    around = np.bincount(key, wanted * triangles.area) / np.bincount(key, triangles.area)
    wanted = 0.5 * (wanted + around[key])
    mean = (wanted * triangles.area).sum() / triangles.area.sum()
    result = wanted + FLOOR * mean
    hidden = triangles.part == ABSORBER
    if not wanted[hidden].any():
        result[hidden] = 0.0
    return result


@dataclass
class Points:
    """Points on the surface.

    Attributes
    ----------
    p, n, s, shading : ndarray (P, 3) float32
        Position, geometric normal, tangent and shading normal.
    uv : ndarray (P, 2) float32
    part : ndarray (P,) int
    weight : ndarray (P,) float64
        1 / density.
    """

    p: np.ndarray
    n: np.ndarray
    s: np.ndarray
    shading: np.ndarray
    uv: np.ndarray
    part: np.ndarray
    weight: np.ndarray


def sample_points(triangles, density, count, rng):
    """Stratified points along the curve through the triangles.

    Parameters
    ----------
    triangles : Triangles
    density : ndarray (T,)
        Relative.
    count : int
    rng : numpy.random.Generator

    Returns
    -------
    Points
    """
    mass = np.cumsum(density * triangles.area)
    place = (np.arange(count) + rng.random(count)) / count * mass[-1]
    index = np.minimum(np.searchsorted(mass, place, side="right"), len(mass) - 1)
    # The rest of the stratified number places the point inside its triangle.
    first = np.clip(1 - (mass[index] - place) / (density * triangles.area)[index], 0.0, 1.0)
    root, second = np.sqrt(first), rng.random(count)
    bary = np.stack([1 - root, root * (1 - second), root * second], 1)
    chosen = triangles.take(index)
    p, shading, uv = (
        np.einsum("pk,pkx->px", bary, values) for values in (chosen.corners, chosen.normals, chosen.uv)
    )
    shading = shading / np.linalg.norm(shading, axis=1, keepdims=True)
    s = chosen.tangent - shading * np.einsum("px,px->p", shading, chosen.tangent)[:, None]
    s = s / np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-30)
    weight = mass[-1] / (count * density[index])
    f = np.float32
    return Points(
        p.astype(f), chosen.facet.astype(f), s.astype(f), shading.astype(f), uv.astype(f), chosen.part, weight
    )


def texel_of(p, w, texels):
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
    """Points that the texels of one view see, texel by texel.

    Attributes
    ----------
    point : ndarray (E,) uint32
    weight : ndarray (E,) float32
        Projected area that a point stands for.
    start : ndarray (texels + 1,) uint32
        Where a texel's entries begin.
    """

    point: np.ndarray
    weight: np.ndarray
    start: np.ndarray

    @property
    def count(self):
        """Entries of each texel."""
        return np.diff(self.start.astype(np.int64))

    def extended(self, texel, point, weight):
        """These bins with the entries of some texels replaced; (k,), (k, r), (k, r)."""
        replaced = np.zeros(len(self.start) - 1, bool)
        replaced[texel] = True
        owner = np.repeat(np.arange(len(self.start) - 1), self.count)
        kept = ~replaced[owner]
        owners = np.concatenate([owner[kept], np.repeat(texel, point.shape[1])])
        order = np.argsort(owners, kind="stable")
        points = np.concatenate([self.point[kept], point.ravel().astype(np.uint32)])[order]
        weights = np.concatenate([self.weight[kept], weight.ravel().astype(np.float32)])[order]
        return Bins(points, weights, _starts(owners, len(replaced)))

    def choose(self, texel, u):
        """One entry of each given texel, drawn by weight with numbers u in [0, 1); −1 for empty texels."""
        total = np.concatenate([[0.0], np.cumsum(self.weight, dtype=np.float64)])
        low, high = total[self.start[texel]], total[self.start[texel + 1]]
        entry = np.searchsorted(total, low + u * (high - low), side="right") - 1
        first, last = self.start[texel].astype(np.int64), self.start[texel + 1].astype(np.int64) - 1
        return np.where(last >= first, np.clip(entry, first, np.maximum(last, first)), -1)


def _starts(texel, n_texels):
    return np.concatenate([[0], np.cumsum(np.bincount(texel, minlength=n_texels))]).astype(np.uint32)


def bin_points(points, visible, w, texels):
    """Sort the visible points into the texels of one view.

    Parameters
    ----------
    points : Points
    visible : ndarray (P,) bool
    w : ndarray (3,)
        The view.
    texels : tuple of int

    Returns
    -------
    Bins
    """
    index = np.flatnonzero(visible)
    texel = texel_of(points.p[index], w, texels)
    weight = np.abs(points.n[index] @ w.astype(np.float32)) * points.weight[index]
    n_texels = texels[0] * texels[1]
    # Two bytes are sorted by radix; the order inside a texel stays that along the curve.
    order = np.argsort(texel.astype(np.uint16) if n_texels <= 1 << 16 else texel, kind="stable")
    return Bins(index[order].astype(np.uint32), weight[order].astype(np.float32), _starts(texel, n_texels))
