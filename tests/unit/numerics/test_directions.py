"""Direction sets, their interpolation and quadrature."""

import numpy as np
import pytest
from probes import hemisphere

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import DirectionSet, directions, spherical
from btfref.numerics.sphere.frames import shading_frame
from btfref.numerics.sphere.interpolation import from_arrays
from btfref.numerics.sphere.parabolic import hemisphere_to_square, solid_angle_density, square_to_hemisphere
from btfref.numerics.sphere.quadrature import gauss_hemisphere

EXACT = tolerance("interpolation.exact.max")
NAMES = ("ubo81", "ubo151", "10x5", "16x8", "2x3", "3x12", "scattered")


def direction_set(name):
    if name == "scattered":
        w = hemisphere(np.random.default_rng(5), 60).astype(float)
        return directions(w / np.linalg.norm(w, axis=1, keepdims=True))
    return directions(name)


@pytest.fixture(params=NAMES)
def some(request):
    return direction_set(request.param)


def test_ubo81_is_the_measured_order():
    d = directions("ubo81")
    assert len(d) == 81
    np.testing.assert_allclose(
        np.degrees(d.theta[[0, 1, 7, 19, 37, 57]]), [0, 15, 30, 45, 60, 75], atol=EXACT
    )
    np.testing.assert_allclose(np.degrees(d.phi[[1, 2, 8, 20, 38, 58]]), [0, 60, 30, 20, 18, 15], atol=EXACT)
    np.testing.assert_array_equal(d.rings[:, 2:], [[1, 0], [6, 1], [12, 7], [18, 19], [20, 37], [24, 57]])


def test_ubo151_offsets():
    d = directions("ubo151")
    assert len(d) == 151
    np.testing.assert_allclose(np.degrees(d.rings[:, 1]), [0, 15, 0, 15, 0, 0, 7.5, 0, 7.5, 0], atol=EXACT)


def test_regular_grid_is_cell_centred():
    d = directions("10x5")
    assert len(d) == 50
    np.testing.assert_allclose(np.degrees(d.theta[::5]), 4.5 + 9 * np.arange(10))


@pytest.mark.parametrize(
    "spec",
    [
        "ubo80",
        "0x5",
        "10x",
        np.zeros((3, 2)),
        [[0, 0, 1], [0, 0, 1]],
        [[0, 0, -1.0]],
        [[np.nan, 0, 1]],
        [[0, 0, 0.0]],
        [[0, 0.6, 0.8], [0, 0.8, 0.6]],
        np.zeros((0, 3)),
    ],
)
def test_bad_sets_are_refused(spec):
    with pytest.raises(InputError):
        directions(spec)


def test_weights_are_a_partition_of_unity(some, rng):
    index, weight = some.stencil(hemisphere(rng, 20_000))
    assert (weight >= 0).all()
    np.testing.assert_allclose(weight.sum(-1), 1, atol=tolerance("interpolation.exact.max"))
    assert index.min() >= 0
    assert index.max() < len(some)


def test_exact_at_the_samples(some):
    index, weight = some.stencil(some.vectors)
    weight_of_own = np.where(index == np.arange(len(some))[:, None], weight, 0).sum(-1)
    # Tables are float32, so that the definition sees what the ports see.
    np.testing.assert_allclose(weight_of_own, 1, atol=tolerance("interpolation.float32.max"))


def in_the_cap(some, rng, n):
    """Directions inside the first ring."""
    theta, phi = some.rings[0, 0] * rng.random(n), 2 * np.pi * rng.random(n)
    return spherical(theta, phi)


@pytest.mark.parametrize("name", ["10x5", "16x8", "2x3", "3x12"])
def test_the_cap_is_continuous_and_keeps_the_plane(name, rng):
    """Rings without a pole: no seam at the ring nor at the chords; what is linear in the plane of the polygon stays."""
    some = direction_set(name)
    value, w = rng.random(len(some)), in_the_cap(some, rng, 20_000)
    index, weight = some.stencil(w)
    assert (weight >= 0).all()
    assert index.max() < some.rings[0, 2]
    np.testing.assert_allclose(weight.sum(-1), 1, atol=EXACT)
    edge, phi = some.rings[0, 0], 2 * np.pi * rng.random(5_000)
    sides = [
        np.einsum("nk,nk->n", weight, value[index])
        for index, weight in (some.stencil(spherical(edge + e, phi)) for e in (-1e-9, 1e-9))
    ]
    assert np.abs(sides[0] - sides[1]).max() <= tolerance("interpolation.continuity.max")
    # A moved direction changes the value by no more than the steepest slope: the width of the cap's narrowest part.
    near = w + 1e-9 * rng.normal(size=w.shape)
    index_near, weight_near = some.stencil(near / np.linalg.norm(near, axis=1, keepdims=True))
    change = np.einsum("nk,nk->n", weight, value[index]) - np.einsum(
        "nk,nk->n", weight_near, value[index_near]
    )
    assert np.abs(change).max() <= tolerance("interpolation.continuity.max")
    corners = np.exp(1j * some.phi[: int(some.rings[0, 2])])
    place = np.einsum("nk,nk->n", weight, corners[index])
    turn = np.angle(w[:, 0] + 1j * w[:, 1])
    radius = np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]) / edge
    # The way to the polygon's edge is divided as the chord of two corners by the azimuth between them.
    step = 2 * np.pi / some.rings[0, 2]
    share = np.mod(turn, step) / step
    first = np.exp(1j * (turn - share * step))
    expected = radius * first * (1 - share + share * np.exp(1j * step))
    np.testing.assert_allclose(place, expected, atol=tolerance("interpolation.float32.max"))


def test_only_rings_around_the_pole_are_rings():
    """Any directions in the order of their polar angles would be rings of one sample each, or of two."""
    phi = np.arange(6) * 2.4
    assert directions(spherical(0.2 + 0.1 * np.arange(6), phi)).rings is None
    pairs = spherical(np.repeat([0.3, 0.6, 0.9], 2), [0, np.pi, 1, 1 + np.pi, 2, 2 + np.pi])
    assert directions(pairs).rings is None
    threes = spherical(np.repeat([0.3, 0.6], 3), np.tile(np.arange(3) * 2 * np.pi / 3, 2) + 0.4)
    np.testing.assert_allclose(directions(threes).rings[:, 1:], [[0.4, 3, 0], [0.4, 3, 3]], atol=EXACT)


def test_continuous(some, rng):
    """Values at directions 1e-7 apart differ by no more than the steepest slope allows: no seam, no edge, no pole."""
    value = rng.random(len(some))
    w = hemisphere(rng, 40_000).astype(float)
    near = w + rng.normal(size=w.shape) * 1e-7
    near[:, 2] = np.abs(near[:, 2])
    for hold in (True, False):
        a, b = (
            np.einsum("nk,nk->n", weight, value[index])
            for index, weight in (
                some.stencil(x / np.linalg.norm(x, axis=1, keepdims=True), hold=hold) for x in (w, near)
            )
        )
        assert np.abs(a - b).max() <= tolerance("interpolation.continuity.max")


def test_lights_fade_to_the_horizon(some):
    phi = np.linspace(0, 2 * np.pi, 50)
    weight = [some.stencil(spherical(np.radians(t), phi), hold=False)[1].sum(-1) for t in (89.0, 89.9, 89.99)]
    held = some.stencil(spherical(np.radians(89.99), phi))[1].sum(-1)
    assert (weight[0] > weight[1]).all()
    assert (weight[1] > weight[2]).all()
    assert weight[2].max() <= tolerance("directions.horizon.weight")
    np.testing.assert_allclose(held, 1, atol=tolerance("interpolation.exact.max"))


def test_beyond_the_last_ring_is_the_stated_factor():
    d = directions("ubo81")
    _, weight = d.stencil(spherical(np.radians(80), 0.3), hold=False)
    expected = np.cos(np.radians(80)) / np.cos(np.radians(75))
    assert abs(weight.sum() - expected) <= tolerance("interpolation.float32.max")


def test_tables_rebuild_the_interpolation(some, rng):
    w = hemisphere(rng, 1000)
    arrays = some.interpolation.arrays("view")
    rebuilt = from_arrays(arrays, "view").stencil(w)
    own = some.stencil(w)
    value = rng.random(len(some))
    a, b = ((weight * value[index]).sum(-1) for index, weight in (rebuilt, own))
    np.testing.assert_allclose(a, b, atol=tolerance("interpolation.float32.max"))


def test_quadrature_integrates_cosines(some):
    weight, z = some.quadrature_weights, some.vectors[:, 2]
    limit = tolerance("interpolation.weights.max")
    assert (weight > 0).all()
    assert abs(weight.sum() / (2 * np.pi) - 1) <= limit
    assert abs(weight @ z / np.pi - 1) <= limit
    assert abs(weight @ some.vectors[:, 0]) <= limit


def test_gauss_rule_is_exact_for_polynomials():
    w, weight = gauss_hemisphere(8, 16)
    x, _, z = w.T
    assert abs(weight @ z**7 - 2 * np.pi / 8) <= tolerance("interpolation.exact.max")
    assert abs(weight @ (x**2 * z) - np.pi / 4) <= tolerance("interpolation.exact.max")


def test_stored_sets_compare_equal():
    d = directions("ubo81")
    assert directions(d.vectors) == d
    assert d != directions("ubo151")
    assert isinstance(directions(d), DirectionSet)


def test_parabolic_map_round_trip(rng):
    w = hemisphere(rng, 1000).astype(float)
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    np.testing.assert_allclose(
        square_to_hemisphere(hemisphere_to_square(w)), w, atol=tolerance("interpolation.exact.max")
    )
    # The solid angle of the unit disc is the hemisphere: midpoint rule in polar coordinates.
    r = (np.arange(20_000) + 0.5) / 20_000
    total = (solid_angle_density(np.stack([r, 0 * r], -1)) * r).sum() * 2 * np.pi / len(r)
    assert abs(total / (2 * np.pi) - 1) <= tolerance("interpolation.quadrature.max")


def test_frames_are_those_of_mitsuba(llvm, rng):
    import drjit as dr

    mi = llvm
    normal, dp_du = rng.normal(size=(2, 500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    si.sh_frame.n, si.dp_du = mi.Normal3f(normal.T), mi.Vector3f(dp_du.T)
    si.initialize_sh_frame()
    theirs = np.stack([np.array(v).T for v in (si.sh_frame.s, si.sh_frame.t, si.sh_frame.n)], 1)
    np.testing.assert_allclose(
        shading_frame(normal, dp_du), theirs, atol=tolerance("interpolation.frame.max")
    )
