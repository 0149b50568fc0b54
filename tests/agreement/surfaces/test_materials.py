"""Materials beside BTFs: diffuse exactly, every other one as its mean albedo, and what judges them."""

import subprocess
from itertools import product

import numpy as np
import pytest

from btfref.cli import main
from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.rendering.environment_light.lighting import lighting_of
from btfref.rendering.gl import composer, device
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.gl.renderer import Renderer
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.reference import render
from btfref.scene.description import read_scene
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.surfaces.materials import PlainMaterial

pytestmark = pytest.mark.usefixtures("renderers", "coarse_environments")

GATES = ("image.noise_free", "image.silhouette", "image.background")

GRID, SIZE = 2, (72, 64)


def picture(mi, dtype, channels=3):
    """A small bitmap of random values."""
    values = np.random.default_rng(5).random((5, 7, channels))
    top = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    return mi.Bitmap((values * top).astype(dtype))


def bitmaps(mi):
    """Diffuse materials with bitmaps of every type, filter and way beyond the border."""
    turned = mi.ScalarTransform4f().translate([0.3, -0.2, 0]).rotate([0, 0, 1], 30).scale([3, 2, 1])
    kinds = [(np.uint8, 3, False), (np.uint8, 1, True), (np.uint16, 3, False), (np.float32, 1, False)]
    ways = product(("repeat", "mirror", "clamp"), ("bilinear", "nearest"))
    for k, (wrap, how) in enumerate(ways):
        dtype, channels, raw = kinds[k % len(kinds)]
        texture = {"type": "bitmap", "bitmap": picture(mi, dtype, channels), "raw": raw}
        texture |= {"wrap_mode": wrap, "filter_type": how, "to_uv": turned}
        yield {"type": "diffuse", "reflectance": texture}


def room(mi, materials, **more):
    """Squares with materials, in rows of three, under a sun and a lamp."""
    transform = mi.ScalarTransform4f
    look = transform().look_at([0.5, -2.5, 3.4], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1]}
    squares = {}
    for k, material in enumerate(materials):
        row, column = divmod(k, 3)
        place = transform().translate([0.9 * column - 0.9, 0.9 * row - 0.9, 0]).scale(0.4)
        squares[f"square{k}"] = {"type": "rectangle", "to_world": place, "bsdf": material}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        "sun": {"type": "directional", "direction": [-0.3, 0.6, -1.0]},
        "lamp": {
            "type": "point",
            "position": [-1.5, 0.5, 0.9],
            "intensity": {"type": "rgb", "value": [2, 7, 1]},
        },
        **squares,
        **more,
    }


def assert_passed(comparison):
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]


def test_diffuse_is_mitsubas_own(llvm, tmp_path):
    """Bitmaps and colours, from both sides, on a sphere and on a mesh without coordinates, in all three ways."""
    llvm.set_variant("scalar_rgb")
    transform = llvm.ScalarTransform4f
    textured = list(bitmaps(llvm))
    colour = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.2, 0.1]}}
    both = {"type": "twosided", "inner": textured[0]}
    bare = tmp_path / "bare.obj"
    bare.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0.2\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    behind = transform().translate([0.8, 0.6, 0.5]).rotate([1, 0, 0], 150).scale(0.3)
    scene = room(
        llvm,
        [*textured, colour],
        behind={"type": "rectangle", "to_world": behind, "bsdf": both},
        black={"type": "disk", "to_world": transform().translate([-0.8, 0.6, 0.5]) @ behind, "bsdf": colour},
        ball={"type": "sphere", "center": [0, 0.9, 0.3], "radius": 0.4, "bsdf": textured[1]},
        bare={
            "type": "obj",
            "filename": str(bare),
            "to_world": transform().translate([0.4, -1, 0.3]),
            "bsdf": textured[3],
        },
    )
    image = realtime(scene, grid=GRID, shadows=False)
    assert image.meta["other_materials"] == {}
    classes = pixel_classes(scene, grid=GRID)
    assert not (classes == PixelClass.OTHER).any()
    for expected in (render(scene, grid=GRID, shadows=False), approximate(scene, grid=GRID)):
        assert_passed(compare(image, expected, classes=classes, gate=GATES, flip=False))


def mixed(mi, fits):
    """A BTF, a diffuse floor, and a metal."""
    btf = {"type": "btf", "filename": str(fits.path("lpca"))}
    metal = {"type": "conductor", "material": "Au"}
    ball = {"type": "sphere", "center": [0.4, 0, 0.5], "radius": 0.4, "bsdf": metal}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.1]).scale(2)}
    return room(mi, [btf], ball=ball, floor=floor)


def test_other_materials_are_counted_and_not_judged(llvm, fits):
    llvm.set_variant("scalar_rgb")
    scene = mixed(llvm, fits)
    image, classes = realtime(scene, grid=GRID, shadows=False), pixel_classes(scene, grid=GRID)
    expected = render(scene, grid=GRID, shadows=False)
    comparison = compare(image, expected, classes=classes, gate=(*GATES, "image.judged"), flip=False)
    assert_passed(comparison)
    other = classes == PixelClass.OTHER
    assert comparison.counts["other"] == other.sum() > 0
    assert image.meta["other_materials"] == {"ball": "conductor"}
    assert [note for note in image.meta["notes"] if "ball: conductor" in note]
    # A smooth metal is black under delta lights, and its albedo is not: nothing else sees the difference.
    assert image.image[other].mean() > expected.image[other].mean()
    everything = compare(image, expected, gate="image.noise_free", flip=False)
    assert not everything.passed


def test_needed_maps_are_those_of_the_btf(llvm, fits):
    llvm.set_variant("scalar_rgb")
    scene = mixed(llvm, fits)
    whole, some = (realtime(scene, grid=1, keep=keep) for keep in ("all", "needed"))
    assert np.array_equal(whole.image, some.image)
    assert len(some.meta["kept"]) == 1


@pytest.mark.parametrize("way", ["sh", pytest.param("transfer", marks=pytest.mark.long)])
def test_a_diffuse_surface_under_an_environment(llvm, fits, way):
    """Whatever way lights the BTF: plain surfaces have the environment's lights."""
    llvm.set_variant("scalar_rgb")
    scene = mixed(llvm, fits)
    del scene["sun"], scene["lamp"]
    scene["sky"] = {"type": "envmap", "filename": "studio"}
    size = (36, 32)
    classes = pixel_classes(scene, grid=1, size=size)
    image = realtime(scene, grid=1, size=size, environment=way)
    expected = approximate(scene, grid=1, size=size, path=way)
    assert image.image[np.isin(classes, (PixelClass.INTERIOR, PixelClass.OTHER))].min() > 0
    assert_passed(compare(image, expected, classes=classes, gate=GATES, flip=False))


def test_plain_surfaces_follow_an_environment_that_changes(llvm, fits):
    llvm.set_variant("scalar_rgb")
    scene = room(llvm, [{"type": "btf", "filename": str(fits.path("lpca"))}, {"type": "diffuse"}])
    del scene["sun"], scene["lamp"]
    pictures, skies = [], ({"type": "constant"}, {"type": "envmap", "filename": "studio"})
    described = [read_scene({**scene, "sky": sky}, size=(36, 32)) for sky in skies]
    for first in described:
        with Renderer(first, lighting=lighting_of(first, "transfer")) as renderer:
            renderer.relight(described[1].environment)
            renderer.draw()
            pictures.append(renderer.read().copy())
    assert_passed(compare(*pictures, gate="image.noise_free", flip=False))


ALBEDOS = {
    "checkerboard": ({"type": "diffuse", "reflectance": {"type": "checkerboard"}}, 0.3),
    "half opaque": ({"type": "mask", "opacity": 0.5, "inner": {"type": "diffuse"}}, 0.25),
    "nothing": ({"type": "null"}, 0.0),
    "two sides": ({"type": "twosided", "front": {"type": "diffuse"}, "back": {"type": "conductor"}}, 0.5),
    "mirror": ({"type": "conductor", "material": "none"}, 1.0),
    "rough": ({"type": "roughconductor", "material": "none", "alpha": 0.05}, 1.0),
}


@pytest.mark.parametrize("name", ALBEDOS)
def test_albedos_of_other_materials(llvm, name):
    llvm.set_variant("scalar_rgb")
    material, expected = ALBEDOS[name]
    for shape in ("rectangle", "cube", "sphere"):
        (mesh,) = read_scene(room(llvm, [], shape={"type": shape, "bsdf": material})).meshes
        assert not mesh.plain.exact
        assert np.abs(mesh.plain.albedo - expected).max() < tolerance("material.albedo.max_abs")


def test_a_scene_without_a_btf_is_drawn_and_says_what_stands_for_what(llvm, tmp_path, capsys):
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
        <lookat origin="0,-2,3" target="0,0,0" up="0,0,1"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
        <shape type="cube" id="block"><bsdf type="principled"/></shape>
        <shape type="rectangle" id="floor"/><emitter type="directional"/></scene>"""
    )
    out = tmp_path / "out.exr"
    assert main(["realtime", str(tmp_path / "scene.xml"), "-o", str(out), "--grid", "1"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "albedo" in line]
    assert len(said) == 1
    assert "block: principled" in said[0]


@pytest.mark.parametrize("target", composer.TARGETS)
def test_glslang_accepts_diffuse(need, tmp_path, target):
    validator = need("glslang")
    for filter_type, exact in product(("bilinear", "nearest"), ({}, {"QUADRIC": 1})):
        rep = PlainMaterial(np.full((1, 1, 3), 0.5, np.float32), filter_type).representation
        shader, _ = device.shader_file(rep)
        defines = {**device.shader_defines(rep), "N_LIGHTS": 2, **exact}
        source = composer.compose("hosts/mesh.frag", defines, representation=shader, target=target)
        (tmp_path / "mesh.frag").write_text(source, encoding="utf-8")
        done = subprocess.run(
            [validator, str(tmp_path / "mesh.frag")], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, source.explain(done.stdout)
