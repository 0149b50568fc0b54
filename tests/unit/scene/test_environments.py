"""Environments that ship by name."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.harmonics import values
from btfref.rendering.offline.reference import render
from btfref.scene import environments
from btfref.scene.description import read_scene
from btfref.scene.shipped import scene_file


@pytest.mark.parametrize("name", ["studio", "harmonics", "bright-texel", "constant"])
def test_shipped_by_name(fits, name):
    parameters = {"btf": str(fits.path("raw")), "lights": "envmap", "environment": name}
    found = read_scene(scene_file("plane"), parameters).environment
    shipped = environments.shipped(name)
    np.testing.assert_array_equal(found.radiance, shipped.radiance)
    if name != "constant":
        np.testing.assert_allclose(
            found.to_world, shipped.to_world, atol=tolerance("environment.shipped.max_abs")
        )


def test_sky_by_elevation(need):
    need("llvm")
    for name, elevation in (("sky", environments.ELEVATION), ("sky60", 60)):
        w, power = environments.shipped(name).cells()
        sun = w[power.sum(1).argmax()]
        assert np.degrees(np.arcsin(sun[2])) == pytest.approx(
            elevation, abs=tolerance("environment.sun.elevation")
        )
        assert np.degrees(np.arctan2(sun[1], sun[0])) == pytest.approx(
            environments.AZIMUTH, abs=tolerance("environment.sun.azimuth")
        )


def test_soft_boxes_are_where_they_are_said_to_be():
    studio = environments.shipped("studio")
    for centre, _, _, radiance in environments.SOFTBOXES:
        towards = np.array(centre) / np.linalg.norm(centre)
        np.testing.assert_allclose(
            studio.evaluate(towards), radiance, rtol=tolerance("environment.shipped.rtol")
        )
    np.testing.assert_allclose(
        studio.evaluate([0, 0, -1.0]), environments.FLOOR, rtol=tolerance("environment.shipped.rtol")
    )


def test_the_random_environment_is_its_formula(rng):
    environment, coefficients = environments.harmonic_environment()
    w = rng.normal(size=(200, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    expected = values(w, environments.ORDER) @ coefficients
    error = np.abs(environment.evaluate(w) - expected).max() / expected.max()
    assert error <= tolerance("environment.harmonics.max")
    assert environment.radiance.min() > 0


@pytest.mark.parametrize("name", ["sky0", "sky91", "nowhere"])
def test_unknown_names(fits, name):
    assert not environments.is_shipped(name)
    with pytest.raises(InputError, match="environment"):
        environments.shipped(name)
    parameters = {"btf": str(fits.path("raw")), "lights": "envmap", "environment": name}
    for reader in (read_scene, render):
        with pytest.raises(InputError, match="studio"):
            reader(scene_file("plane"), parameters=parameters)
