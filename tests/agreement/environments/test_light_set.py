"""Directional lights that stand for an environment: their quality, and the generic path of every method."""

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.images import save_image
from btfref.registry import methods
from btfref.rendering.environment_light.light_set import TARGET, light_set
from btfref.rendering.environment_light.lighting import Lighting
from btfref.rendering.offline.approximate import approximate
from btfref.scene.environment import Environment, bright_texel, constant
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("coarse_environments")

SIZE = (32, 32)


def half_sky():
    """Bright above a sharp horizon, with a small sun."""
    picture = np.full((24, 48, 3), 0.1, np.float32)
    picture[:12] = [0.6, 0.8, 1.0]
    picture[6, 20] = 60
    return Environment(picture)


@pytest.mark.parametrize("environment", [constant(), bright_texel([0.2, 0.4, 0.6]), half_sky()])
def test_lights_keep_the_power_and_reach_the_target(environment):
    found = light_set(environment)
    assert found.error <= TARGET
    np.testing.assert_allclose(
        found.power.sum(0), environment.cells()[1].sum(0), rtol=tolerance("light_set.power")
    )
    np.testing.assert_allclose(np.linalg.norm(found.w, axis=1), 1, rtol=tolerance("light_set.power"))
    # More lights are better, and a number is kept.
    few, many = (light_set(environment, lights=n) for n in (24, 384))
    assert len(few) <= 24
    assert len(many) <= 384
    least = tolerance("light_set.more.rounding")
    assert many.error < max(tolerance("light_set.more.share") * few.error, least)
    assert light_set(environment).table().tobytes() == found.table().tobytes()


def test_a_small_source_is_one_light():
    """Median cut would spend half of the lights on it."""
    environment = half_sky()
    found = light_set(environment, lights=64)
    sun = environment.radiance.copy()
    sun[...] = 0
    sun[6, 20] = 60
    w, power = Environment(sun).cells()
    towards = power.sum(1) @ w / np.linalg.norm(power.sum(1) @ w)
    near = found.w @ towards > np.cos(np.radians(8))
    assert near.sum() < 8
    assert found.power[near].sum() > tolerance("light_set.sun.min_share") * power.sum()


def test_black_and_wrong_numbers():
    black = Environment(np.zeros((4, 8, 3), np.float32))
    assert light_set(black).power.sum() == 0
    with pytest.raises(InputError, match="light"):
        light_set(constant(), lights=0)
    with pytest.raises(InputError, match="prefiltered"):
        Lighting(constant(), "no such way")
    with pytest.raises(InputError, match="lights"):
        Lighting(constant(), "prefiltered", lights=3)


@pytest.mark.parametrize("key", list(methods()))
def test_pictures_equal_float64(need, fits, tmp_path, key):
    """The generic path of every method: GLSL against NumPy at the same rays, both sides of a cloth."""
    from btfref.rendering.gl.realtime import realtime

    need("gl"), need("llvm")
    save_image(tmp_path / "sky.exr", half_sky().radiance)
    parameters = {"btf": str(fits.path(key)), "lights": "envmap", "environment": str(tmp_path / "sky.exr")}
    settings = {"parameters": parameters, "grid": 1, "size": SIZE}
    image = realtime(scene_file("cloth"), environment="lights", lights=24, **settings)
    exact = approximate(scene_file("cloth"), path="lights", lights=24, **settings)
    for result in (image, exact):
        assert result.meta["environment_path"] == "lights"
        assert result.meta["environment_lights"] == 24
    classes = pixel_classes(scene_file("cloth"), **settings)
    found = compare(image, exact, classes=classes, gate="image.float64", flip=False)
    assert found.passed, [gate.line for gate in found.gates]
    assert image.image[classes == PixelClass.INTERIOR].mean() > tolerance("rendered.subject.min_radiance")


def test_thousands_of_lights_are_all_drawn(need, fits):
    """A software rasterizer ends long loops without a word: lights are drawn in passes, and none is lost."""
    from btfref.rendering.gl.realtime import realtime

    need("gl"), need("llvm")
    parameters = {"btf": str(fits.path("lpca")), "lights": "constant"}
    settings = {"parameters": parameters, "grid": 1, "size": (8, 8)}
    image = realtime(scene_file("sphere"), environment="lights", lights=4096, **settings).image
    exact = approximate(scene_file("sphere"), path="sh", order=1, **settings).image
    inside = pixel_classes(scene_file("sphere"), **settings) == PixelClass.INTERIOR
    difference = np.abs(image - exact)[inside].max()
    assert difference <= tolerance("environment.furnace.max") * exact[inside].max()


@pytest.mark.parametrize("key", list(methods()))
def test_a_constant_environment_is_the_albedo(fits, rng, key):
    """With as many lights as 1e-3 asks for: the integral of B over the hemisphere, by any frame."""
    from btfref.numerics.sphere.quadrature import gauss_hemisphere

    rep, n = fits(key), 8
    light = Lighting(constant(), "lights", lights=4096).prepared(rep)
    frame = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    frame[:, :, 2] *= np.linalg.det(frame)[:, None]
    uv, w_view = rng.random((n, 2)), rng.normal(size=(n, 3))
    w_view[:, 2] = np.abs(w_view[:, 2]) + 0.2
    w_view /= np.linalg.norm(w_view, axis=1, keepdims=True)
    w, weight = gauss_hemisphere(48, 96)
    expected = np.einsum("l,nlc->nc", weight, rep.evaluate(uv[:, None], w, w_view[:, None]))
    difference = light.radiance(uv, w_view, frame) - expected
    assert np.abs(difference).max() <= tolerance("environment.furnace.max") * np.abs(expected).max()


def test_a_wrong_light_is_caught(fits, rng):
    """One light of 24 mirrored."""
    rep = fits("lpca")
    light = Lighting(half_sky(), "lights", lights=24)
    frame, uv = np.eye(3)[None], np.array([[0.3, 0.6]])
    right = light.prepared(rep).radiance(uv, np.array([[0.0, 0.6, 0.8]]), frame)
    strongest = light.light_set.power.sum(1).argmax()
    light.light_set.w[strongest, 0] *= -1
    wrong = light.prepared(rep).radiance(uv, np.array([[0.0, 0.6, 0.8]]), frame)
    assert not agreement(wrong, right, gate="environment.agreement").passed
