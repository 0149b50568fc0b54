"""What of a tile is seen from above: places without a surface, and surfaces that show a back that reflects nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Part

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Places along a side that are looked at: smaller holes than a cell are found by their borders (`seams`).
_SIDE = 64

#: Where in its cell a place lies: off the lines on which people put vertices.
_PLACE = (0.4871, 0.5237)

#: Pairs of a triangle and a place that are held at once.
_BLOCK = 1 << 20

#: Slack of barycentric coordinates: places on a shared edge belong to both triangles.
_SLACK = 1e-9

#: Share of a tile's places that may show a back: rounding at steep walls.
_MOST_BACKS = 1e-3

#: Mitsuba's materials that reflect on their front alone.
_ONE_SIDED = (
    *("diffuse", "conductor", "roughconductor", "plastic", "roughplastic", "principled"),
    *("measured", "pplastic", "normalmap", "bumpmap", "blendbsdf"),
)


def topmost(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The highest triangle over places of the tile, copies of it counted in.

    Parameters
    ----------
    vertices : ndarray (V, 3)
        Tile units.
    faces : ndarray (F, 3)

    Returns
    -------
    face : ndarray (64, 64) int
        −1 where there is none; row along y.
    z : ndarray (64, 64)
    """
    corners = vertices[faces]
    a = corners[:, 0, :2]
    e1, e2 = corners[:, 1, :2] - a, corners[:, 2, :2] - a
    determinant = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    low = np.ceil(corners[..., :2].min(1) * _SIDE - _PLACE - _SLACK).astype(np.int64)
    high = np.floor(corners[..., :2].max(1) * _SIDE - _PLACE + _SLACK).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = np.where(np.abs(determinant) > 1e-14, size.prod(1), 0)
    z = np.full(_SIDE * _SIDE, -np.inf)
    face = np.full(_SIDE * _SIDE, -1)
    wanted = np.flatnonzero(count)
    ends = np.cumsum(count[wanted])
    first = 0
    while first < len(wanted):
        begin = ends[first - 1] if first else 0
        last = max(int(np.searchsorted(ends, begin + _BLOCK, side="right")), first + 1)
        some = wanted[first:last]
        first = last
        owner = np.repeat(some, count[some])
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
        column, row = low[owner, 0] + step % size[owner, 0], low[owner, 1] + step // size[owner, 0]
        p = (np.stack([column, row], 1) + _PLACE) / _SIDE - a[owner]
        u = (p[:, 0] * e2[owner, 1] - p[:, 1] * e2[owner, 0]) / determinant[owner]
        v = (p[:, 1] * e1[owner, 0] - p[:, 0] * e1[owner, 1]) / determinant[owner]
        inside = (u >= -_SLACK) & (v >= -_SLACK) & (u + v <= 1 + _SLACK)
        owner, u, v = owner[inside], u[inside], v[inside]
        place = (row[inside] % _SIDE) * _SIDE + column[inside] % _SIDE
        heights = corners[owner, :, 2]
        height = heights[:, 0] + u * (heights[:, 1] - heights[:, 0]) + v * (heights[:, 2] - heights[:, 0])
        # Of faces that lie on each other the one that looks up counts.
        height = height + 1e-9 * (determinant[owner] > 0)
        order = np.argsort(height, kind="stable")
        place, height, owner = place[order], height[order], owner[order]
        better = height > z[place]
        # The last of equal indices is what an assignment keeps: the highest.
        z[place[better]], face[place[better]] = height[better], owner[better]
    return face.reshape(_SIDE, _SIDE), z.reshape(_SIDE, _SIDE)


def refuse_gaps(vertices: np.ndarray, faces: np.ndarray, *, file: PathLike, allow: bool) -> None:
    """InputError for a tile of which a part has no surface, unless that is allowed.

    Parameters
    ----------
    vertices : ndarray (V, 3)
        Tile units.
    faces : ndarray (F, 3)
    file : path-like
    allow : bool
    """
    empty = topmost(vertices, faces)[0] < 0
    if allow or not empty.any():
        return
    edges = vertices[faces[:, 1:], :2] - vertices[faces[:, :1], :2]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    twice = f"; faces lie over each other, in all {area:.3g} tiles" if area > 1.01 * (~empty).mean() else ""
    where = ", ".join(
        f"{name} = {_place(index.min(), 0)} … {_place(index.max(), 1)}"
        for name, index in zip("xy", np.nonzero(empty.T), strict=True)
    )
    raise InputError(
        "no surface over a part of the tile",
        file=file,
        field="file",
        got=f"{empty.mean():.3g} of its area empty, in {where}{twice}",
        expected="a surface that covers the tile, or to allow seams",
    )


def _place(index: int, end: int) -> str:
    return f"{(index + end) / _SIDE:.3g}"


def refuse_undersides(parts: Sequence[Part], *, file: PathLike) -> None:
    """InputError where a surface shows views the back of a material that reflects on its front alone.

    Parameters
    ----------
    parts : sequence of Part
    file : path-like
    """
    if not any(_one_sided(part.bsdf) for part in parts):
        return
    ups, blinds = [], []
    for part in parts:
        corners = part.vertices[part.faces]
        up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if part.normals is not None:  # Mitsuba turns a face to their side
            turned = np.einsum("fx,fx->f", up, part.normals[part.faces].sum(1)) < 0
            up = np.where(turned[:, None], -up, up)
        ups.append(up[:, 2] > 0)
        blinds.append(np.full(len(up), _one_sided(part.bsdf)))
    count = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate(
        [part.faces.astype(np.int64) + first for part, first in zip(parts, count, strict=False)]
    )
    face, _ = topmost(vertices, faces)
    seen = face[face >= 0]
    black = (~np.concatenate(ups) & np.concatenate(blinds))[seen]
    if black.mean() > _MOST_BACKS if len(black) else False:
        raise InputError(
            "the surface is wound downwards and its material reflects on its front alone: it would be black",
            file=file,
            field="bsdf",
            got=f"{black.mean():.3g} of the surface seen from above shows its back",
            expected="faces counter-clockwise seen from above, or <bsdf type='twosided'> around the material",
        )


def _one_sided(bsdf: Facts) -> bool:
    """Whether a material is known to reflect on its front alone."""
    kind = bsdf.get("type")
    inner = [value for value in bsdf.values() if isinstance(value, dict) and "type" in value]
    if kind in ("normalmap", "bumpmap", "blendbsdf"):
        nested = [
            value for value in inner if value["type"] not in ("bitmap", "rgb", "transform", "checkerboard")
        ]
        return bool(nested) and all(_one_sided(value) for value in nested)
    return kind in _ONE_SIDED and not bsdf.get("spec_trans")
