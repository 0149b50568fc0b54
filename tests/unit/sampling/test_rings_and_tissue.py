"""Rings and tissue: closed tubes, nothing meets anything, the tile repeats without a seam."""

import numpy as np
import pytest

from btfref.mesostructure import build


def _directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def _closed_and_oriented(faces):
    """Every edge is used once in each direction."""
    edges = _directed_edges(faces)
    n = int(edges.max()) + 1
    forward, backward = (np.sort(edges @ weight) for weight in ([n, 1], [1, n]))
    return np.array_equal(forward, backward) and (np.diff(forward) > 0).all()


def _normals_agree_with_facets(part):
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    assert (np.linalg.norm(facet, axis=1) > 0).all()
    assert np.allclose(np.linalg.norm(part.normals, axis=1), 1)
    return (np.einsum("fx,fkx->fk", facet, part.normals[part.faces]) > 0).all()


@pytest.mark.parametrize("count", [1, 3])
def test_rings_are_closed_and_apart(count):
    tile = build("rings", count=count, thickness=0.08, segments=64, sides=16, gap=0.01)
    gold, base = tile.parts
    assert _closed_and_oriented(gold.faces)
    assert _normals_agree_with_facets(gold)
    assert _normals_agree_with_facets(base)
    x, y, z = (gold.vertices - [0.5, 0.5, 0]).T
    # One interval of radii per ring: they must not overlap, neither each other nor the tile's border.
    radius = np.hypot(x, y).reshape(count, -1)
    low, high = radius.min(1), radius.max(1)
    assert (low[1:] > high[:-1]).all()
    assert 0 < low[0]
    assert 2 * high[-1] < 1
    assert z.max() == 0.0
    assert z.min() > base.vertices[:, 2].max()
    assert gold.bsdf["type"] == "roughconductor"


@pytest.mark.parametrize("settings", [{}, {"count": 2, "width": 0.6, "thickness": 0.2, "amplitude": 0.12}])
def test_tissue_closes_when_tiled(settings):
    tile = build("tissue", **settings)
    for axis, part in enumerate(tile.parts[:2]):
        assert _normals_agree_with_facets(part)
        # What the first section of a yarn is on one side, the last one is on the other, bit for bit.
        near, far = (part.vertices[:, axis] == side for side in (0.0, 1.0))
        others = [k for k in range(3) if k != axis]
        assert np.array_equal(part.vertices[near][:, others], part.vertices[far][:, others])
        assert np.array_equal(part.normals[near], part.normals[far])
        # Welded there, every tube is closed.
        index = np.arange(len(part.vertices))
        index[far] = index[near]
        assert _closed_and_oriented(index[part.faces])
    assert tile.overhang == 0.0


def _inside(points, yarns, axis, count, sides):
    """Whether points lie inside yarns along `axis`: sections are convex polygons between vertices."""
    n_along = len(yarns) // (count * sides)
    rings = yarns.reshape(count, n_along, sides, 3)[..., [1 - axis, 2]]
    at = np.clip(points[:, axis] * (n_along - 1), 0, n_along - 1 - 1e-9)
    low = at.astype(int)
    t = (at - low)[:, None, None]
    inside = np.zeros(len(points), bool)
    for yarn in rings:
        section = (1 - t) * yarn[low] + t * yarn[low + 1]
        edge = np.roll(section, -1, axis=1) - section
        to_point = points[:, None, [1 - axis, 2]] - section
        side = edge[..., 0] * to_point[..., 1] - edge[..., 1] * to_point[..., 0]
        inside |= (side > 0).all(1) | (side < 0).all(1)
    return inside


def test_yarns_do_not_meet():
    tile = build("tissue")
    count, sides = (tile.parameters[key] for key in ("count", "sides"))
    warp, weft, backing = (part.vertices for part in tile.parts)
    assert not _inside(weft, warp, 0, count, sides).any()
    assert not _inside(warp, weft, 1, count, sides).any()
    # The test itself can fail: the same yarns 5 % of a tile lower.
    assert _inside(weft + np.array([0, 0, 0.05]), warp, 0, count, sides).any()
    assert max(warp[:, 2].min(), weft[:, 2].min()) > backing[:, 2].max()
    # Neighbours of one kind keep apart as well.
    assert tile.parameters["width"] < 1


def test_yarns_cross_over_and_under():
    tile = build("tissue")
    count = tile.parameters["count"]
    crossing = (np.arange(count) + 0.5) / count
    heights = []
    for axis, part in enumerate(tile.parts[:2]):
        along, across, z = part.vertices[:, axis], part.vertices[:, 1 - axis], part.vertices[:, 2]
        top = np.zeros((count, count))
        for i, x in enumerate(crossing):
            for j, y in enumerate(crossing):
                near = (np.abs(along - x) < 0.02) & (np.abs(across - y) < 0.02)
                top[(i, j) if axis == 0 else (j, i)] = z[near].max()
        heights.append(top)
    over = heights[0] > heights[1]
    checker = np.indices((count, count)).sum(0) % 2 == 0
    assert np.array_equal(over, checker) or np.array_equal(over, ~checker)


def test_the_backing_may_be_left_out():
    assert len(build("tissue", backing_colour=None).parts) == 2
