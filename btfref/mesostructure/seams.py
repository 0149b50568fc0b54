"""Does a user's geometry repeat without a seam? How bad it is, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.types import PathLike

#: Largest gap (tile units) between borders that count as meeting: what five digits in a text file leave, and a
#: hundredth of a texel at 1024².
MEETING = 1e-5

#: Points of borders compared at once with border edges; a bound on memory.
_BLOCK = 1 << 22

#: How much more neighbouring lines of a map may differ across its border than anywhere inside, in root mean
#: square: a periodic map's border is a place like any other.
SEAM_FACTOR = 1.5


@dataclass(frozen=True)
class Seam:
    """One way in which something does not tile.

    Attributes
    ----------
    what : str
        One clause for people.
    gap : float
        How far apart, tile units or the map's own; inf where nothing comes near.
    """

    what: str
    gap: float


def refuse(seams: Sequence[Seam], *, file: PathLike, allow: bool, field: str = "file") -> None:
    """InputError for the worst of some seams, unless they are allowed."""
    if not seams or allow:
        return
    others = f" (and {len(seams) - 1} more)" if len(seams) > 1 else ""
    raise InputError(
        f"does not tile: {seams[0].what}{others}",
        file=file,
        field=field,
        expected="input that repeats without a seam, or to allow seams",
    )


def open_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Edges that a mesh and its copies at all whole offsets leave open.

    Vertices are welded on the torus, whose points are x and y modulo 1; an edge is open when a single
    triangle of the tiled surface has it.

    Parameters
    ----------
    vertices : ndarray (V, 3)
        Tile units.
    faces : ndarray (F, 3)

    Returns
    -------
    ndarray (E, 2, 3)
        End points.
    """
    # Cells as wide as what counts as meeting, with whole numbers in the middle of one.
    scale = round(1.0 / MEETING)
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    whole = np.round(vertices * scale).astype(np.int64)
    welded = whole.copy()
    welded[:, :2] %= scale
    _, label = np.unique(_hashed(*welded.T), return_inverse=True)
    a = faces.ravel()
    b = faces[:, [1, 2, 0]].ravel()
    # Two edges of the torus may join the same points on different ways round: the way belongs to the key.
    # Both directions of an edge have the same one.
    way = (whole[b] - whole[a]).T
    there, back = _hashed(label[a], label[b], *way), _hashed(label[b], label[a], *-way)
    key = np.minimum(there, back)
    degenerate = (way == 0).all(0)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    lonely = (count[inverse] == 1) & ~degenerate
    return np.stack([vertices[a[lonely]], vertices[b[lonely]]], 1)


def _hashed(*columns: np.ndarray) -> np.ndarray:
    """One number per row of whole numbers: sorting these is ten times faster than sorting rows."""
    state = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        state = (state ^ column.astype(np.int64).view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        state ^= state >> np.uint64(29)
    return state


def mesh_seams(vertices: np.ndarray, faces: np.ndarray) -> list[Seam]:
    """Where a mesh on the unit tile does not meet its copies.

    Parameters
    ----------
    vertices : ndarray (V, 3)
        Tile units.
    faces : ndarray (F, 3)

    Returns
    -------
    list of Seam
        The worst first; empty for closed geometry and for borders that meet those of the copies.
    """
    edges = open_edges(vertices, faces)
    if not len(edges):
        return []
    points = np.concatenate([edges[:, 0], edges[:, 1], edges.mean(1)])
    gap, nearest = _distance_to_copies(points, edges)
    open_ = gap.reshape(3, -1).max(0) > MEETING
    if not open_.any():
        return []
    seams = []
    for axis, name in ((0, "x"), (1, "y")):
        low, high = edges[..., axis].min(), edges[..., axis].max()
        # Borders as the file has them: they need not lie at 0 and 1.
        at_low = (np.abs(edges[..., axis] - low) < 1e-3).all(1)
        at_high = (np.abs(edges[..., axis] - high) < 1e-3).all(1)
        border = np.tile(open_ & (at_low | at_high), 3)
        if high - low < 0.5 or not border.any():
            continue
        worst = np.flatnonzero(border)[np.argmax(gap[border])]
        x, y, z = points[worst]
        there = nearest[worst]
        far = f"are {gap[worst]:.3g} tiles apart", f" (nearest copy at z = {there[2]:.4g})"
        apart, copy = far if np.isfinite(gap[worst]) else ("meet no copy", "")
        seams.append(
            Seam(
                f"borders at {name} = {low:.4g} and {name} = {high:.4g} {apart} at x = {x:.4g}, y = {y:.4g}, "
                f"z = {z:.4g}{copy}",
                float(gap[worst]),
            )
        )
        open_ = open_ & ~(at_low | at_high)
    if open_.any():
        length = np.linalg.norm(edges[open_, 1] - edges[open_, 0], axis=1).sum()
        x, y, z = edges[open_][0].mean(0)
        seams.append(
            Seam(
                f"open borders inside the tile: {int(open_.sum())} edges, {length:.3g} tiles long, "
                f"the first at x = {x:.4g}, y = {y:.4g}, z = {z:.4g}",
                float("inf"),
            )
        )
    return sorted(seams, key=lambda seam: -seam.gap)


def _distance_to_copies(points: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points to the nearest border edge of the eight tiles around, and the place there."""
    offsets = np.array([[i, j, 0] for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j], np.float64)
    best = np.full(len(points), np.inf)
    place = np.full((len(points), 3), np.nan)
    for offset in offsets:
        start, along = edges[:, 0] + offset, edges[:, 1] - edges[:, 0]
        low, high = (
            np.minimum(edges[:, 0], edges[:, 1]) + offset,
            np.maximum(edges[:, 0], edges[:, 1]) + offset,
        )
        # Copies whose borders are far away from all points cannot be the nearest that matters.
        near = ((points >= low.min(0) - 0.25) & (points <= high.max(0) + 0.25))[:, :2].all(1)
        index = np.flatnonzero(near)
        step = max(1, _BLOCK // len(edges))
        for first in range(0, len(index), step):
            part = index[first : first + step]
            d = points[part][:, None] - start
            t = np.einsum("pex,ex->pe", d, along) / np.einsum("ex,ex->e", along, along)
            d -= np.clip(t, 0, 1)[..., None] * along
            distance = np.sqrt(np.einsum("pex,pex->pe", d, d))
            edge = np.argmin(distance, 1)
            row = np.arange(len(part))
            better = distance[row, edge] < best[part]
            best[part] = np.where(better, distance[row, edge], best[part])
            foot = points[part] - d[row, edge]
            place[part] = np.where(better[:, None], foot, place[part])
    return best, place


def bounds_seams(low: np.ndarray, high: np.ndarray) -> list[Seam]:
    """Whether a mesh's bounds can be those of one unit tile.

    Parameters
    ----------
    low, high : ndarray (2,)
        Bounds in x and y, tile units.

    Returns
    -------
    list of Seam
    """
    seams = []
    for axis, name in ((0, "x"), (1, "y")):
        outside = max(-low[axis], high[axis] - 1.0)
        if outside > 0.5 or high[axis] - low[axis] < 0.5:
            seams.append(
                Seam(
                    f"bounds in {name} are {low[axis]:.4g} … {high[axis]:.4g} and do not fit the unit tile; "
                    "say with `tile` where one tile lies in the mesh",
                    float(outside),
                )
            )
    return seams


def map_seams(values: np.ndarray, name: str) -> list[Seam]:
    """Where a map's opposite borders do not continue each other.

    Parameters
    ----------
    values : ndarray (rows, columns, channels)
    name : str
        What the map is, for the message.

    Returns
    -------
    list of Seam
        A seam where neighbouring rows (columns) differ across the border by more than `SEAM_FACTOR` times
        what any two neighbours inside do, in root mean square.
    """
    seams = []
    for axis, line, along in ((1, "columns", "row"), (0, "rows", "column")):
        n = values.shape[axis]
        if n < 3:
            continue
        step = np.abs(np.diff(values, axis=axis, append=np.take(values, [0], axis)))
        step = np.moveaxis(step, axis, 0).reshape(n, values.shape[1 - axis], -1).max(-1)
        spread = np.sqrt(np.mean(step**2, axis=1))
        if spread[-1] <= SEAM_FACTOR * spread[:-1].max():
            continue
        worst = int(np.argmax(step[-1]))
        seams.append(
            Seam(
                f"{name}: {line} 0 and {n - 1} differ by up to {step[-1, worst]:.3g} (at {along} {worst}; root "
                f"mean square {spread[-1]:.3g}, neighbours inside at most {spread[:-1].max():.3g})",
                float(step[-1, worst]),
            )
        )
    return sorted(seams, key=lambda seam: -seam.gap)
