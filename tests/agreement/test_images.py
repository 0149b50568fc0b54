"""Real-time images against noise-free references: gates that pass, and gates that catch injected faults."""

import numpy as np
import pytest
from oracle import oracle_btf

from btfref import registry, representations
from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.scene.description import read_scene
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

GRID = 4
SIZE = (96, 96)
GATES = ("image.noise_free", "image.silhouette", "image.background")


def save_fitted(directory, key, **settings):
    rep = registry.method(key).fit(oracle_btf((32, 32)), **settings)
    path = directory / f"oracle.{key}.exr"
    representations.save(rep, path)
    return str(path)


def room(mi, *, shapes, lights, size=SIZE, **more):
    """A scene dictionary; imports of Mitsuba stay with the caller."""
    look = mi.ScalarTransform4f().look_at([1.5, -3, 3.2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    camera = {"type": "perspective", "fov": 38, "to_world": look, "film": film}
    path = {"type": "path", "max_depth": 2}
    return {"type": "scene", "integrator": path, "camera": camera, **shapes, **lights, **more}


LIGHTS = {
    "sun": {
        "type": "directional",
        "direction": [-0.3, 0.6, -1.0],
        "irradiance": {"type": "rgb", "value": [3, 2.5, 2]},
    },
    "lamp": {"type": "point", "position": [-1.5, 0.5, 0.9], "intensity": {"type": "rgb", "value": [2, 7, 1]}},
}


def test_several_files_texture_transforms_scale_and_both_sides(llvm, tmp_path):
    """Two shapes with their own files, turned and shifted textures, one seen from behind."""
    llvm.set_variant("scalar_rgb")
    transform = llvm.ScalarTransform4f
    svd, raw = save_fitted(tmp_path, "svd"), save_fitted(tmp_path, "raw")
    turned = (
        transform().translate([0.3, -0.2, 0])
        @ transform().rotate([0, 0, 1], 30)
        @ transform().scale([3, 2, 1])
    )
    front = {"type": "btf", "filename": svd, "to_uv": turned, "scale": 0.7}
    both = {"type": "twosided", "material": {"type": "btf", "filename": raw, "filter_type": "bilinear"}}
    away = (
        transform().translate([0.3, 0.6, 0.8]) @ transform().rotate([1, 0, 0], 120) @ transform().scale(0.5)
    )
    shapes = {
        "floor": {"type": "rectangle", "bsdf": front},
        "wall": {"type": "rectangle", "to_world": away, "bsdf": both},
        "box": {
            "type": "cube",
            "to_world": transform().translate([-0.6, -0.3, 0.2]).scale(0.2),
            "bsdf": both,
        },
    }
    scene = room(llvm, shapes=shapes, lights=LIGHTS)
    described = read_scene(scene)
    image = realtime(described, grid=GRID, shadows=False)
    expected = render(scene, grid=GRID, shadows=False)
    comparison = compare(image, expected, classes=pixel_classes(scene, grid=GRID), gate=GATES, flip=False)
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]


LAMBERT = """// Provides btf_eval of a Lambertian surface.
// Expects reflectance [1, 4].
#include "lib/lookup/table.glsl"
uniform sampler2DArray reflectance;
vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    return w_light.z > 0.0 && w_view.z > 0.0 ? table_fetch(reflectance, 0).rgb * w_light.z : vec3(0.0);
}
"""


class Lambert:
    """A third party's representation, with a shader of its own."""

    meta = {"method": "lambert", "filter_type": "bilinear"}  # noqa: RUF012 - read only

    def arrays(self):
        return {"reflectance": np.full((1, 3), 0.5 / np.pi, np.float32)}

    def port_arrays(self):
        return {"reflectance": np.array([[0.5 / np.pi] * 3 + [0]], np.float32)}


@pytest.mark.parametrize("shape", ["rectangle", "cube"])
@pytest.mark.parametrize("twosided", [False, True])
def test_lambert_is_mitsubas_diffuse(llvm, tmp_path, monkeypatch, shape, twosided):
    """End to end without a table: camera, rows, frames, lights. The method is a third party's."""
    llvm.set_variant("scalar_rgb")
    package = tmp_path / "lambert_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "lambert.glsl").write_text(LAMBERT)
    monkeypatch.syspath_prepend(tmp_path)
    row = registry.Method("lambert", "", "", "", "", "lambert.glsl", "lambert_package")
    monkeypatch.setattr(registry, "method", lambda key, **_: row)
    monkeypatch.setattr(representations, "load", lambda path: Lambert())
    (tmp_path / "any.exr").touch()

    def scene(bsdf):
        bsdf = {"type": "twosided", "inside": bsdf} if twosided else bsdf
        turned = llvm.ScalarTransform4f().rotate([0, 1, 0], 160 if twosided else 20)
        return room(llvm, shapes={"shape": {"type": shape, "to_world": turned, "bsdf": bsdf}}, lights=LIGHTS)

    shown = scene({"type": "btf", "filename": str(tmp_path / "any.exr")})
    image = realtime(shown, grid=GRID, shadows=False)
    plain = scene({"type": "diffuse"})
    expected = render(plain, grid=GRID, shadows=False)
    classes = pixel_classes(plain, grid=GRID)
    assert (expected.image[classes == PixelClass.INTERIOR].max(-1) > 0).any()
    comparison = compare(
        image, expected, classes=classes, gate=("image.lambert", "image.background"), flip=False
    )
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]


def test_shadows_can_be_left_out(llvm):
    """With shadows the reference is never brighter, and darker somewhere; path tracing agrees with it."""
    llvm.set_variant("scalar_rgb")
    transform = llvm.ScalarTransform4f
    shapes = {
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.3, "bsdf": {"type": "diffuse"}},
        "flat": {"type": "rectangle", "to_world": transform().translate([0, 0, 0.9]).scale(0.2)},
    }
    scene = room(llvm, shapes=shapes, lights=LIGHTS, size=(48, 48))
    lit = render(scene, grid=2, shadows=False).image
    shadowed = render(scene, grid=2).image
    assert (shadowed <= lit).all()
    darker = shadowed < tolerance("rendered.shadow.share") * lit
    assert darker.mean() > tolerance("rendered.shadow.min_pixels")
    traced = render(scene, spp=256, seed=3, with_variance=True)
    comparison = compare(traced, render(scene, grid=16), gate="image.difference", flip=False)
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]


def test_a_regular_grid_is_random_under_an_environment_only(llvm):
    llvm.set_variant("scalar_rgb")
    sphere, sky = {"a": {"type": "sphere"}}, {"sky": {"type": "constant"}}
    exact = render(room(llvm, shapes=sphere, lights=LIGHTS, size=(16, 16)), grid=2, spp=64)
    assert (exact.variance, exact.pictures, exact.meta["grid"]) == (None, None, 2)
    noisy = render(room(llvm, shapes=sphere, lights=sky, size=(16, 16)), grid=2, spp=64)
    assert noisy.variance.max() > 0
    assert noisy.pictures.shape == (4, 16, 16, 3)
    assert (noisy.meta["grid"], noisy.meta["spp"]) == (2, 64)


def test_same_seed_same_image(llvm):
    llvm.set_variant("scalar_rgb")
    scene = room(llvm, shapes={"a": {"type": "sphere"}}, lights=LIGHTS, size=(16, 16))
    first, second, other = (render(scene, spp=4, seed=seed).image for seed in (1, 1, 2))
    assert (first == second).all()
    assert (first != other).any()
    assert llvm.variant() == "scalar_rgb"


def test_a_silhouette_is_where_surfaces_meet_the_background(llvm):
    llvm.set_variant("scalar_rgb")
    scene = room(llvm, shapes={"a": {"type": "sphere"}}, lights=LIGHTS, size=(64, 64))
    classes = pixel_classes(scene, grid=2)
    assert classes[32, 32] == PixelClass.INTERIOR
    assert classes[0, 0] == PixelClass.BACKGROUND
    ring = np.isin(classes, (PixelClass.EDGE, PixelClass.SILHOUETTE))
    # A closed ring: no interior pixel touches the background.
    for axis in (0, 1):
        for step in (1, -1):
            assert not (
                (classes == PixelClass.INTERIOR) & (np.roll(classes, step, axis) == PixelClass.BACKGROUND)
            ).any()
    assert tolerance("rendered.ring.min_share") < ring.mean() < tolerance("rendered.ring.share")


def test_a_fold_in_front_of_the_surface_is_a_silhouette(llvm, tmp_path):
    """One mesh, two sheets: no other shape and no background beside the edge."""
    llvm.set_variant("scalar_rgb")
    sheets = np.array(
        [
            [-9, -9, 0],
            [9, -9, 0],
            [9, 9, 0],
            [-9, 9, 0],
            [-9, -9, 0.3],
            [0, -9, 0.3],
            [0, 9, 0.3],
            [-9, 9, 0.3],
        ]
    )
    import trimesh

    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    trimesh.Trimesh(sheets, faces, process=False).export(tmp_path / "sheets.ply")
    shape = {"type": "ply", "filename": str(tmp_path / "sheets.ply")}
    classes = pixel_classes(room(llvm, shapes={"a": shape}, lights=LIGHTS, size=(64, 64)), grid=2)
    assert (
        tolerance("rendered.edge.min_share")
        < np.isin(classes, (PixelClass.EDGE, PixelClass.SILHOUETTE)).mean()
        < tolerance("rendered.edge.share")
    )
    assert (classes == PixelClass.BACKGROUND).sum() == 0


def test_realtime_refuses_what_it_cannot_show(llvm):
    llvm.set_variant("scalar_rgb")
    sphere = {"a": {"type": "sphere", "bsdf": {"type": "conductor"}}}
    with pytest.raises(InputError, match="light"):
        realtime(room(llvm, shapes={}, lights={}))
    with pytest.raises(InputError, match="grid"):
        realtime(room(llvm, shapes={}, lights=LIGHTS), grid=0)
    lamp = {"a": {"type": "sphere", "emitter": {"type": "directionalarea"}}}
    with pytest.raises(InputError, match="directional or area"):
        render(room(llvm, shapes=lamp, lights=LIGHTS), grid=1)
    bare = room(llvm, shapes=sphere, lights=LIGHTS)
    del bare["integrator"]
    with pytest.raises(InputError, match="integrator"):
        render(bare, spp=1)
    with pytest.raises(InputError, match="variant"):
        render(room(llvm, shapes=sphere, lights=LIGHTS), variant="scalar_float")
    with pytest.raises(InputError, match="JIT"):
        render(room(llvm, shapes=sphere, lights=LIGHTS), variant="scalar_rgb", grid=1)
