"""Lights as data: what Mitsuba's emitters bring, points that stand for area lights, sun and sky as a picture."""

import importlib

import numpy as np
import pytest

from btfref.gates import tolerance
from btfref.scene.description import read_scene
from btfref.scene.emitters.area_lights import TARGET, area_lights, estimated_error, points_of


def types_of(mi, variant):
    mi.set_variant(variant)
    return importlib.import_module(f"mitsuba.{variant}")


def camera(mi):
    look_at = mi.ScalarTransform4f().look_at([0.5, -3, 3], [0, 0, 0], [0, 0, 1])
    return {"type": "perspective", "fov": 50, "to_world": look_at}


@pytest.mark.parametrize("angles", [{}, {"cutoff_angle": 30.0, "beam_width": 25.0}])
def test_a_spot_falls_as_mitsubas(rng, angles):
    import mitsuba as mi

    types = types_of(mi, "scalar_rgb")
    look = mi.ScalarTransform4f().look_at([0.5, -1, 2], [0.1, 0.2, 0], [0, 0, 1])
    spot = {"type": "spot", "to_world": look, "intensity": {"type": "rgb", "value": [3, 5, 2]}, **angles}
    (light,) = read_scene({"type": "scene", "c": camera(mi), "l": spot}).lights
    points = rng.uniform(-2, 2, (400, 3))
    towards, irradiance = light.incident(points)
    emitter, at = mi.load_dict(spot), types.SurfaceInteraction3f()
    lit = 0
    for k, point in enumerate(points):
        at.p = point.tolist()
        sample, weight = emitter.sample_direction(at, [0.5, 0.5], True)
        lit += bool(np.any(np.array(weight) > 0))
        assert np.abs(np.array(sample.d) - towards[k]).max() < tolerance("scene.light.max")
        found = np.array(weight) - irradiance[k]
        assert np.abs(found).max() < tolerance("lights.incident.max") * max(1, irradiance[k].max())
    assert 20 < lit < 380


SHAPES = {
    "rectangle": {"type": "rectangle"},
    "disk": {"type": "disk"},
    "sphere": {"type": "sphere", "radius": 0.4},
    "cylinder": {"type": "cylinder", "p0": [0, -1, 0.2], "p1": [0.4, 1, 0], "radius": 0.5},
    "mesh": {"type": "cube"},
}


def lit_scene(mi, shape):
    placed = mi.ScalarTransform4f().translate([0.2, 0.4, 1.6]).rotate([1, 0, 0], 160).scale(0.4)
    lamp = {
        **shape,
        "to_world": placed,
        "l": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}},
    }
    return {"type": "scene", "c": camera(mi), "floor": {"type": "rectangle"}, "lamp": lamp}


@pytest.mark.parametrize("name", SHAPES)
def test_points_stand_for_area_lights(name):
    import mitsuba as mi

    types = types_of(mi, "scalar_rgb")
    scene = mi.load_dict(lit_scene(mi, SHAPES[name]))
    found = area_lights(scene, types)
    assert found.error <= TARGET
    lamp = next(shape for shape in scene.shapes() if shape.is_emitter())
    power = np.array([3, 2, 1]) * lamp.surface_area()
    np.testing.assert_allclose(found.power.sum(0), power, rtol=tolerance("lights.area.rtol"))
    assert [light.kind for light in found.lights()] == ["area"] * len(found)
    # On the shape, and shining away from it.
    away = found.position - np.array(lamp.bbox().center(), float)
    assert ((away * found.normal).sum(1) > -tolerance("lights.area.max_abs")).all()
    truth = points_of(lamp, 4096, types)
    place = np.array([[0.1, -0.4, 0], [0.5, 0.2, 0], [-0.6, 0.5, 0]])
    up = np.tile([0.0, 0, 1], (3, 1))
    few, many = (estimated_error(points_of(lamp, n, types), truth, place, up)[0] for n in (32, 256))
    assert many < tolerance("lights.area.share") * few


def test_both_kinds_of_variants_have_the_same_points(llvm):
    scenes = []
    for variant in ("scalar_rgb", "llvm_ad_rgb"):
        types = types_of(llvm, variant)
        scenes.append(area_lights(llvm.load_dict(lit_scene(llvm, SHAPES["sphere"])), types))
    scalar, jit = scenes
    assert len(scalar) == len(jit)
    for name in ("position", "normal", "power"):
        difference = np.abs(getattr(scalar, name) - getattr(jit, name)).max()
        assert difference < tolerance("lights.area.max_abs")


def test_a_sky_is_a_picture_of_mitsubas(rng):
    import mitsuba as mi

    types = types_of(mi, "scalar_rgb")
    sun = np.array([0.3, 0.5, 0.6]) / np.sqrt(0.7)
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 40)
    sky = {"type": "sunsky", "turbidity": 4.0, "sun_direction": sun.tolist(), "to_world": turned}
    environment = read_scene({"type": "scene", "c": camera(mi), "sky": sky}).environment
    emitter, si = mi.load_dict(sky), types.SurfaceInteraction3f()

    def theirs(directions):
        values = []
        for w in directions:
            si.wi = (-w).tolist()
            values.append(np.array(emitter.eval(si, True)))
        return np.array(values)

    d = rng.normal(size=(3000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = d[(np.abs(d[:, 2]) > 0.03) & (d @ sun < 0.99)]
    expected = theirs(d)
    difference = np.abs(environment.evaluate(d) - expected).max(1)
    assert np.percentile(difference, 99) < tolerance("lights.sky.sky") * expected.max()
    # All but the sun is far below a hundredth of it within a degree: power over a cap, by rings of equal area.
    n, cap = 20000, 1 - np.cos(np.radians(0.3))
    u, phi = (np.arange(n) + 0.5) / n, 2 * np.pi * 0.6180339887 * np.arange(n)
    z = 1 - u * cap
    across = np.linalg.svd(sun[None])[2][1:]
    ring = np.cos(phi)[:, None] * across[0] + np.sin(phi)[:, None] * across[1]
    power = theirs(z[:, None] * sun + np.sqrt(1 - z * z)[:, None] * ring).mean(0) * 2 * np.pi * cap
    w, cells = environment.cells()
    near = w @ sun > np.cos(np.radians(3))
    # The sky around the sun is small beside it.
    assert (np.abs(cells[near].sum(0) / power - 1) < tolerance("lights.sky.sun")).all()
    middle = cells[near][:, 0] @ w[near]
    assert middle @ sun / np.linalg.norm(middle) > np.cos(np.radians(tolerance("lights.sky.degrees")))
