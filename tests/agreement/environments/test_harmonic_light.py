"""Light in spherical harmonics: GLSL against float64, and exact where the environment has few bands."""

from functools import cache

import numpy as np
import pytest
from probes import hemisphere

from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.harmonics import values
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.rendering.environment_light.harmonic_light import environment_coefficients
from btfref.rendering.environment_light.lighting import Lighting
from btfref.rendering.gl.probe import probe_environment
from btfref.rendering.offline.approximate import approximate
from btfref.scene.environment import constant
from btfref.scene.environments import harmonic_environment, shipped
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("coarse_environments")


def lookups(rng, n, *, mirrored=True):
    frame = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    frame[:, :, 2] *= np.linalg.det(frame)[:, None]
    if mirrored:
        frame[::3, :, 2] *= -1
    frame[0], frame[1] = np.eye(3), np.diag([1.0, -1.0, -1.0])
    return rng.uniform(-1, 2, (n, 2)).astype(np.float32), hemisphere(rng, n), frame.astype(np.float32)


@pytest.fixture(scope="module")
def brute_force(fits):
    """Some lookups, and ``integral(light)``: ∫ B(l) L(R l) dl there, with L a function of directions."""
    points = uv, w_view, frame = lookups(np.random.default_rng(20040601), 12)
    w, weight = gauss_hemisphere(64, 360)

    @cache
    def known():
        return fits("lpca").evaluate(uv[:, None], w, w_view[:, None])

    def integral(light):
        return np.einsum("l,nlc,nlc->nc", weight, known(), light(np.einsum("nij,lj->nli", frame, w)))

    return points, integral


@pytest.mark.parametrize(
    ("kind", "order"), [("ubo81", 5), ("scattered", 2), pytest.param("ubo81", 7, marks=pytest.mark.long)]
)
def test_shader_agrees_with_float64(need, fits, rng, kind, order):
    need("gl")
    rep, points = fits("lpca", kind), lookups(rng, 1000)
    light = Lighting(shipped("studio"), "sh", order=order).prepared(rep)
    found = agreement(
        probe_environment(rep, light, *points), light.radiance(*points), gate="environment.agreement"
    )
    assert found.passed, [gate.line for gate in found.gates]
    assert light.facts["ringing"] > 0


def test_coefficients_of_a_known_environment():
    environment, known = harmonic_environment()
    order = int(np.sqrt(len(known)))
    found = environment_coefficients(environment, order + 2)
    scale = np.abs(known).max()
    assert np.abs(found[: len(known)] - known).max() <= tolerance("environment.harmonics.max") * scale
    assert np.abs(found[len(known) :]).max() <= tolerance("environment.harmonics.max") * scale


def test_an_environment_of_few_bands_is_exact(fits, brute_force):
    """The tables' own bands do not matter: what the light lacks is orthogonal to them."""
    rep, (environment, known) = fits("lpca"), harmonic_environment()
    order = int(np.sqrt(len(known)))
    points, integral = brute_force
    truth = integral(lambda w: values(w, order) @ known)
    for bands in (order, order + 3):
        light = Lighting(environment, "sh", order=bands).prepared(rep)
        difference = np.abs(light.radiance(*points) - truth).max()
        assert difference <= tolerance("environment.harmonics.max") * truth.max()
    # One band less is another picture.
    less = Lighting(environment, "sh", order=order - 1).prepared(rep)
    difference = np.abs(less.radiance(*points) - truth).max()
    assert difference > 10 * tolerance("environment.harmonics.max") * truth.max()


def test_a_constant_environment_is_the_albedo(fits, brute_force):
    rep, (points, integral) = fits("lpca"), brute_force
    truth = integral(lambda w: np.ones((*w.shape[:-1], 3)))
    light = Lighting(constant(), "sh", order=1).prepared(rep)
    assert np.abs(light.radiance(*points) - truth).max() <= tolerance("environment.furnace.max") * truth.max()


def test_more_bands_are_better_and_windows_cost_sharpness(fits, rng):
    rep, points = fits("lpca"), lookups(rng, 24)
    environment = shipped("sky60")
    w, power = environment.cells()
    lit = power.any(1)
    truth = np.zeros((24, 3))
    for i in range(24):
        local = w[lit] @ points[2][i].astype(float)
        truth[i] = (rep.evaluate(points[0][i], local, points[1][i]) * power[lit]).sum(0)
    errors = [
        np.sqrt(np.mean((Lighting(environment, "sh", order=n).prepared(rep).radiance(*points) - truth) ** 2))
        for n in (2, 4, 8)
    ]
    assert errors[0] > errors[1] > errors[2]
    windowed = Lighting(environment, "sh", order=8, window="hanning").prepared(rep)
    assert windowed.facts["ringing"] < Lighting(environment, "sh", order=8).prepared(rep).facts["ringing"]


def test_pictures_equal_float64(need, fits):
    from btfref.rendering.gl.realtime import realtime

    need("gl"), need("llvm")
    parameters = {"btf": str(fits.path("lpca")), "lights": "envmap", "environment": "studio"}
    settings = {"parameters": parameters, "grid": 1, "size": (40, 40)}
    image = realtime(scene_file("cloth"), environment="sh", order=4, **settings)
    exact = approximate(scene_file("cloth"), path="sh", order=4, **settings)
    assert image.meta["environment_path"] == "sh"
    assert image.meta["order"] == exact.meta["order"] == 4
    classes = pixel_classes(scene_file("cloth"), **settings)
    found = compare(image, exact, classes=classes, gate="image.float64", flip=False)
    assert found.passed, [gate.line for gate in found.gates]


def test_methods_without_shared_tables_are_refused(fits):
    with pytest.raises(InputError, match="lpca"):
        Lighting(constant(), "sh").prepared(fits("raw"))
