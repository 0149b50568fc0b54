"""Rays through height fields: hits and shadows against brute force and closed forms."""

import numpy as np
import pytest
from probes import hemisphere

from btfref.gates.tolerances import tolerance
from btfref.numerics.heightfield import MAXIMUM_TRAVEL, HeightField, first_root

EXACT = tolerance("interpolation.exact.max")


@pytest.fixture(params=["rough", "deep", "single column", "single texel"])
def field(request):
    rng = np.random.default_rng(5)
    heights = {
        "rough": rng.uniform(-0.2, 0.0, (12, 16)),
        "deep": rng.uniform(-4.0, 4.0, (8, 8)),
        "single column": rng.uniform(-0.3, 0.1, (7, 1)),
        "single texel": np.full((1, 1), -0.1),
    }
    return HeightField(heights[request.param].astype(np.float32))


def rays(rng, n):
    uv, w = rng.uniform(-2, 3, (n, 2)), hemisphere(rng, n).astype(float)
    w[: n // 4, 2] *= 10 ** rng.uniform(-9, -1, n // 4)
    w[: n // 50, :2] = 0
    return uv, w / np.linalg.norm(w, axis=1, keepdims=True)


def on_torus(a, b):
    return np.abs(np.mod(a - b + 0.5, 1) - 0.5).max(-1)


def test_every_ray_hits_the_surface_where_it_says(field, rng):
    uv, w = rays(rng, 4000)
    hit = field.view_hits(uv, w)
    size = [field.shape[1], field.shape[0]]
    place = (hit.cell + hit.local + 0.5) / size
    np.testing.assert_allclose(field.points(place).height, hit.height, atol=tolerance("heightfield.hit"))
    assert on_torus(uv + hit.height[:, None] * field.tangents(w), place).max() <= tolerance("heightfield.hit")
    assert (hit.height <= field.top).all()
    assert (hit.height >= field.bottom).all()
    assert (np.abs(field.tangents(w)).max(0) * field.depth <= MAXIMUM_TRAVEL * (1 + EXACT)).all()


def test_no_surface_before_the_hit(field, rng):
    """Points of the ray above the hit are above the surface."""
    uv, w = rays(rng, 400)
    hit = field.view_hits(uv, w)
    tangent = field.tangents(w)
    for share in np.linspace(0, 0.999, 200):
        z = field.top + share * (hit.height - field.top)
        below = field.points(np.mod(uv + z[:, None] * tangent, 1)).height
        assert (z - below >= -tolerance("heightfield.hit")).all()


def test_shadows_are_blocked_points(field, rng):
    """A point is lit if no point of its ray is below the surface, and shadowed only if one is."""
    uv, w = rays(rng, 400)
    hit = field.view_hits(uv, hemisphere(rng, 400).astype(float))
    lit = field.lit(hit, w)
    place = (hit.cell + hit.local + 0.5) / [field.shape[1], field.shape[0]]
    margin = np.full(len(uv), np.inf)
    for share in np.linspace(0.001, 1, 1500):
        rise = share * (field.top - hit.height)
        surface = field.points(np.mod(place + rise[:, None] * field.tangents(w), 1)).height
        margin = np.minimum(margin, hit.height + rise - surface)
    # The ray is sampled: what it passes between samples may block it, but nothing that it dips into lets it pass.
    depth = max(field.depth, tolerance("heightfield.shadow.least_depth_parameter"))
    assert (~lit | (margin > -tolerance("heightfield.shadow.dips") * depth)).all()
    certain = margin > tolerance("heightfield.shadow.clears") * field.depth
    assert lit[certain].all()


def test_a_light_from_above_always_arrives(field, rng):
    hit = field.view_hits(*rays(rng, 500))
    assert field.lit(hit, np.tile([0.0, 0, 1], (500, 1))).all()


def test_a_wall_casts_a_shadow_as_long_as_the_tangent_says():
    """A ridge of height 1/8: its shadow ends where the ray over its crest lands."""
    heights = np.full((4, 64), -0.125, np.float32)
    heights[:, 10] = 0
    field = HeightField(heights)
    u = (np.arange(12, 60) + 0.5) / 64
    points = field.points(np.stack([u, np.full(len(u), 0.4)], -1))
    for tangent in (0.55, 1.03, 2.1):
        w = np.array([-tangent, 0, 1]) / np.hypot(tangent, 1)
        lit = field.lit(points, np.tile(w, (len(u), 1)))
        np.testing.assert_array_equal(lit, u - 10.5 / 64 > 0.125 * tangent)


def test_slopes_of_a_wave():
    """Sobel of a sine along u: the central difference of the sine."""
    n = 32
    u = (np.arange(n) + 0.5) / n
    field = HeightField(np.tile(0.1 * np.sin(2 * np.pi * u), (8, 1)).astype(np.float32))
    expected = 0.1 * np.cos(2 * np.pi * u) * np.sin(2 * np.pi / n) * n
    np.testing.assert_allclose(
        field.slopes[..., 0], np.tile(expected, (8, 1)), atol=tolerance("heightfield.slope")
    )
    np.testing.assert_allclose(field.slopes[..., 1], 0, atol=tolerance("heightfield.slope"))


@pytest.mark.parametrize("f2", [-3.0, -1e-12, 0.0, 1e-12, 3.0])
def test_first_root(f2, rng):
    f0, f1 = rng.uniform(1e-3, 1, 1000), rng.uniform(-3, 3, 1000)
    q = first_root(f0, f1, np.full(1000, f2))
    there = q < 1e3
    at = q[there]
    residual = np.abs(f0[there] + f1[there] * at + f2 * at * at)
    assert residual.max(initial=0) <= tolerance("heightfield.root.residual")
    # Positive up to the root.
    for share in np.linspace(0, 0.99, 50):
        s = share * np.minimum(q, 10)
        assert (f0 + f1 * s + f2 * s * s >= -EXACT).all()
