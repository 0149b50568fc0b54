"""Environments: Mitsuba's conventions, what filters of them must give, and what is refused."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.registry import image_light, methods
from btfref.rendering.environment_light import prefilter
from btfref.representations.analytic.light_functions import held
from btfref.scene.environment import Environment, bright_texel, constant, from_emitter, sunsky

SMALL = {"size": 32}


def sphere(n_theta=200, n_phi=800):
    """Directions over the whole sphere and solid angles."""
    w, weight = gauss_hemisphere(n_theta, n_phi)
    return np.concatenate([w, w * [1, 1, -1]]), np.concatenate([weight, weight])


def random_directions(rng, n):
    w = rng.normal(size=(n, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def sky(rng, shape=(8, 16)):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Environment(rng.uniform(0.2, 2, (*shape, 3)).astype(np.float32), turn)


def test_it_reads_pictures_as_mitsuba_does(llvm, tmp_path, rng):
    import drjit as dr

    picture = rng.uniform(0, 1, (9, 14, 3)).astype(np.float32)
    llvm.Bitmap(picture).write(str(tmp_path / "sky.exr"))
    turn = llvm.ScalarTransform4f().rotate([0.6, 0, 0.8], 40)
    emitter = llvm.load_dict(
        {"type": "envmap", "filename": str(tmp_path / "sky.exr"), "scale": 2.0, "to_world": turn}
    )
    environment = from_emitter("envmap", emitter, llvm)
    w = random_directions(rng, 20_000).astype(np.float32)
    si = dr.zeros(llvm.SurfaceInteraction3f, len(w))
    si.wi = -llvm.Vector3f(w.T)
    difference = environment.evaluate(w) - np.array(emitter.eval(si)).T
    assert np.abs(difference).max() <= tolerance("environment.mitsuba.max")


def test_cells_hold_the_whole_environment(rng):
    environment = sky(rng)
    w, weight = sphere()
    expected = weight @ environment.evaluate(w)
    cells, power = environment.cells()
    np.testing.assert_allclose(power.sum(0), expected, rtol=tolerance("environment.cells.relative"))
    np.testing.assert_allclose(
        constant().cells()[1].sum(0), 4 * np.pi, rtol=tolerance("environment.constant")
    )
    # A single light is where it was put, within half a texel, with the power asked for.
    direction = np.array([0.4, 0.3, 0.86]) / np.linalg.norm([0.4, 0.3, 0.86])
    cells, power = bright_texel(direction, irradiance=3.0).cells()
    np.testing.assert_allclose(power.sum(0), 3, rtol=tolerance("environment.texel"))
    centre = power[:, 0] @ cells
    assert centre @ direction / np.linalg.norm(centre) > np.cos(np.pi / 63)


def test_lobes_of_a_constant_environment_see_that_constant():
    maps = prefilter.lobe_maps(constant([1.0, 2.0, 0.5]), **SMALL)
    np.testing.assert_allclose(
        maps, np.broadcast_to([1, 2, 0.5], maps.shape), rtol=tolerance("environment.filter.constant")
    )


def test_lobes_of_a_small_light_are_powers_of_cosines(rng):
    light = np.array([0.36, 0.48, -0.8])
    environment = bright_texel(light, shape=(512, 1024))
    cells, power = environment.cells()
    light = power[:, 0] @ cells
    light /= np.linalg.norm(light)
    maps = prefilter.lobe_maps(environment)
    w = random_directions(rng, 4000)
    for i, n in enumerate(prefilter.exponents()):
        expected = np.maximum(w @ light, 0) ** n * (n + 1) / (2 * np.pi)
        found = prefilter.map_lookup(maps, np.full(len(w), i), w)[:, 0]
        limit = tolerance("environment.filter.light") * max(1, n / 32)
        assert np.abs(found - expected).max() <= limit * expected.max()


def test_lobes_of_a_sky_are_its_integrals(rng, monkeypatch):
    monkeypatch.setattr("btfref.scene.environment.CELL_ROWS", 64)
    environment = sky(rng)
    w, weight = sphere(100, 400)
    radiance = environment.evaluate(w) * weight[:, None]
    maps = prefilter.lobe_maps(environment)
    axis = random_directions(rng, 30)
    for i in (0, 3, 10):
        n = prefilter.exponents()[i]
        expected = np.maximum(axis @ w.T, 0) ** n @ radiance * (n + 1) / (2 * np.pi)
        found = prefilter.map_lookup(maps, np.full(len(axis), i), axis)
        np.testing.assert_allclose(found, expected, rtol=tolerance("environment.filter.sky"))


def test_moments_of_a_constant_environment(rng):
    """Over a hemisphere about n: ∫ l l dω = 2π/3 I and ∫ l dω = π n."""
    maps = prefilter.moment_maps(constant(), 0.0, **SMALL)
    n = random_directions(rng, 500)
    found = np.stack([prefilter.map_lookup(maps, np.full(len(n), i), n)[:, 0] for i in range(9)], 1)
    limit = tolerance("environment.moments.max")
    assert np.abs(found[:, :3] - 2 * np.pi / 3).max() <= limit * 2 * np.pi
    assert np.abs(found[:, 3:6]).max() <= limit * 2 * np.pi
    assert np.abs(found[:, 6:] - np.pi * n).max() <= limit * 2 * np.pi


def test_shares_above_the_horizon():
    n = prefilter.exponents(prefilter.CLIPPED)
    for cosine, upright in ((False, np.ones_like(n)), (True, (n + 1) / (n + 2))):
        shares = prefilter.clipped_lobes(0.0, cosine=cosine)[..., 0]
        assert np.abs(shares[:, -1] - upright).max() <= tolerance("environment.shares.max")
        assert np.abs(shares[:, 0]).max() <= tolerance("environment.shares.max")
        assert (np.diff(shares, axis=1) >= -tolerance("environment.shares.max")).all()
    # Half of a lobe along the horizon is above it: heights are symmetric about 0.
    half = prefilter.clipped_lobes(0.0, cosine=False)[..., 0]
    assert np.abs(half + half[:, ::-1] - 1).max() <= tolerance("environment.shares.max")


@pytest.mark.parametrize("cosine", [False, True])
@pytest.mark.parametrize("edge", [0.0, 0.26])
def test_clipped_lobes_keep_their_first_moment(rng, edge, cosine):
    """Environments linear in the direction come out exactly: against quadrature over the hemisphere."""
    w, weight = gauss_hemisphere(96, 192)
    raised, fade = held(w, edge)
    weight = weight * fade * (raised[:, 2] if cosine else 1)
    clipped = prefilter.clipped_lobes(edge, cosine=cosine)
    axis = random_directions(rng, 200)
    axis = axis[axis[:, 2] > -0.8]
    exponent = 2 ** rng.uniform(0, 5, len(axis))
    expected = np.maximum(axis @ raised.T, 0) ** exponent[:, None] * weight @ w
    # Maps of the environments x, y, z: the mean of a lobe is its axis times (n + 1) / (n + 2).
    share = (prefilter.exponents() + 1) / (prefilter.exponents() + 2)
    maps = np.repeat(share, 2)[:, None, None, None] * np.tile(
        prefilter.map_directions(), (prefilter.SLICES, 1, 1, 1)
    )
    found = prefilter.lobe_lookup(maps, clipped, axis, np.eye(3), exponent)
    assert (
        np.abs(found - expected).max() <= tolerance("environment.first_moment.max") * np.abs(expected).max()
    )


@pytest.mark.parametrize("cosine", [False, True])
def test_clipped_lobes_keep_the_difference_of_variances(cosine):
    """What is left of a lobe along the horizon is wider along it than across it: so are the two that stand for it."""
    w, weight = gauss_hemisphere(128, 256)
    weight = weight * (w[:, 2] if cosine else 1)
    clipped = prefilter.clipped_lobes(0.0, cosine=cosine)
    for exponent in (4.0, 16.0, 64.0):
        for height in (0.0, 0.15):
            axis = np.array([np.sqrt(1 - height**2), 0, height])
            lobe = np.maximum(w @ axis, 0) ** exponent * weight
            moments = np.einsum("n,ni,nj->ij", lobe / lobe.sum(), w, w)
            centre = lobe @ w / lobe.sum()
            across = np.array([-centre[2], 0, centre[0]]) / np.hypot(centre[0], centre[2])
            expected = moments[1, 1] - across @ moments @ across
            _, axes, position = prefilter.stand_ins(clipped, axis[None], np.array([exponent]))
            m = 2 ** (position[0] / 2)
            assert axes[0][0, 1] == -axes[1][0, 1]
            found = m / (m + 3) * axes[0][0, 1] ** 2
            assert found == pytest.approx(expected, rel=tolerance("environment.second_moment.relative"))


def test_sun_and_sky(need):
    need("llvm")
    sun = np.array([0.4, 0.3, 0.86])
    environment = sunsky(shape=(64, 128), sun_direction=sun)
    cells, power = environment.cells()
    brightest = cells[power.sum(1).argmax()]
    assert brightest @ sun / np.linalg.norm(sun) > np.cos(np.radians(3))
    assert (environment.evaluate([0, 0, 1]) > 0).all()
    np.testing.assert_array_equal(environment.evaluate([0.1, 0.1, -0.9]), 0)


@pytest.mark.parametrize(
    ("radiance", "turn", "field"),
    [
        (np.ones((4, 8)), np.eye(3), "radiance"),
        (np.full((4, 8, 3), -1.0), np.eye(3), "radiance"),
        (np.full((4, 8, 3), np.nan), np.eye(3), "radiance"),
        (np.ones((4, 8, 3)), 2 * np.eye(3), "to_world"),
    ],
)
def test_what_is_no_environment(radiance, turn, field):
    with pytest.raises(InputError) as caught:
        Environment(radiance, turn)
    assert caught.value.field == field


def test_the_registry_knows_who_can():
    having = {key for key, row in methods().items() if row.image_light}
    assert having >= {"rf_poly", "rf_lobes", "lafortune", "lafortune_lut"}
    for key in having:
        assert image_light(key).SHADER
    with pytest.raises(InputError, match="prefiltered") as caught:
        image_light("raw", file="x.raw.exr")
    assert "rf_lobes" in caught.value.expected


def test_pictures_are_read_after_one_thread_was_asked_for(llvm, tmp_path, rng):
    """A worker with one thread that reads a sky must not wait forever."""
    import drjit as dr

    from btfref.platform import use_processors

    before = dr.thread_count()
    use_processors(1)
    try:
        llvm.Bitmap(rng.random((4, 8, 3)).astype(np.float32)).write(str(tmp_path / "sky.exr"))
        assert np.array(llvm.Bitmap(str(tmp_path / "sky.exr"))).shape == (4, 8, 3)
    finally:
        dr.set_thread_count(before)
