"""Cast shadows in real time against the reference's: inside, outside, at their borders, and where there are none."""

import json
import subprocess
from importlib.resources import files

import numpy as np
import pytest

from btfref.cli import main
from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.platform import shader_directory
from btfref.rendering.gl import composer, device
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

GATES = (
    *("image.noise_free", "image.judged", "image.silhouette", "image.shadow_border", "image.background"),
    "image.negative",
)
SETTINGS = {"grid": 2}

SUN = {"type": "directional", "direction": [-0.6, 0.3, -1], "irradiance": {"type": "rgb", "value": [3, 2, 2]}}
SKY = {"type": "constant"}


def lamp(x, y, z):
    return {"type": "point", "position": [x, y, z], "intensity": {"type": "rgb", "value": [1, 2, 1]}}


#: One tile, one in a cone, and the six of a cube.
LIGHTS = {
    "sun and lamp above": {"sun": SUN, "lamp": lamp(-0.5, -0.6, 2.0)},
    "lamp among shapes": {"lamp": lamp(-0.1, 0.1, 0.2)},
}
MAPS = {"sun and lamp above": 2, "lamp among shapes": 6}


def scene_of(mi, path, lights, *, shapes=True):
    """A ball, a box and a fence whose bars are thinner than a pixel, above a floor."""
    mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform4f
    material = {"type": "twosided", "inner": {"type": "btf", "filename": str(path)}}
    ball = str(files("btfref.scene.shipped") / "sphere.ply")
    things = {
        "ball": {
            "type": "ply",
            "filename": ball,
            "to_world": transform().translate([0.35, 0.2, 0.4]).scale(0.3),
        },
        "box": {
            "type": "cube",
            "to_world": transform().translate([-0.5, 0.4, 0.25]).rotate([0, 0, 1], 30).scale(0.2),
        },
        **{
            f"bar{k}": {
                "type": "rectangle",
                "to_world": transform().translate([0.2 * k - 0.5, -0.6, 0.3]).scale([0.012, 0.25, 1]),
            }
            for k in range(5)
        },
    }
    shown = {"floor": {"type": "rectangle"}, **(things if shapes else {})}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            "type": "perspective",
            "fov": 38,
            "to_world": transform().look_at([0.8, -2.6, 2.4], [0, 0, 0.1], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 60, "height": 48},
        },
        "material": material,
        **{name: {**shape, "bsdf": {"type": "ref", "id": "material"}} for name, shape in shown.items()},
        **lights,
    }


@pytest.fixture(scope="module")
def shadowed(fits):
    """``shadowed(mi, name) -> (scene, reference, classes)``, rendered once."""
    made = {}

    def get(mi, name):
        if name not in made:
            scene = scene_of(mi, fits.path("lpca"), LIGHTS[name])
            classes = pixel_classes(scene, shadows=True, **SETTINGS)
            made[name] = scene, render(scene, **SETTINGS), classes
        return made[name]

    return get


@pytest.mark.parametrize("name", LIGHTS)
def test_shadows_are_those_of_the_reference(llvm, shadowed, name):
    scene, expected, classes = shadowed(llvm, name)
    image = realtime(scene, **SETTINGS)
    assert (image.meta["shadows"], expected.meta["shadows"]) == (True, True)
    assert image.meta["shadow_maps"] == MAPS[name]
    comparison = compare(image, expected, classes=classes, gate=GATES, flip=False)
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]
    # There is a shadow, and its border is where both sides of it meet.
    lit = render(scene, shadows=False, **SETTINGS).image
    darker = (expected.image < tolerance("rendered.shadow.share") * lit).any(-1)
    strict = np.isin(classes, (PixelClass.INTERIOR, PixelClass.EDGE))
    assert (darker & strict).mean() > tolerance("rendered.shadow.min_pixels")
    border = (classes == PixelClass.SHADOW_BORDER).mean()
    assert tolerance("rendered.shadow.min_border") < border < tolerance("rendered.shadow.border")
    # Without shadows it would not have passed.
    without = compare(lit, expected, classes=classes, gate="image.noise_free", flip=False)
    assert not without.passed


FAULTS = {
    "leaks": ("if (inside && met.w > 0.0", "if (inside && met.w > 0.3", "image.noise_free.max"),
    "its own": ("met.w > 0.0 && met.w < reach", "met.w > -0.01 && met.w < reach", "image.noise_free.p999"),
    "beside": (
        "vec3 origin = point +",
        "vec3 origin = point + vec3(0.03, 0, 0) +",
        "image.shadow_border.relative_l2",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_shadows_are_caught(llvm, shadowed, tmp_path, monkeypatch, fault):
    right, wrong, meant = FAULTS[fault]
    file, shipped = "lib/light/shadows.glsl", device.shader_file
    text = (shader_directory() / file).read_text("utf-8")
    assert text.count(right) == 1
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(text.replace(right, wrong), "utf-8")
    monkeypatch.setattr(device, "shader_file", lambda rep: (shipped(rep)[0], [tmp_path]))
    scene, expected, classes = shadowed(llvm, "sun and lamp above")
    image = realtime(scene, **SETTINGS)
    gates = ("image.noise_free", "image.shadow_border")
    comparison = compare(image, expected, classes=classes, gate=gates, flip=False)
    assert meant in {gate.name for gate in comparison.gates if not gate.passed}


def test_a_scene_without_occluders_is_drawn_as_without_shadows(llvm, fits):
    """By default nothing is looked up; and what is looked up all the same finds nothing."""
    scene = scene_of(llvm, fits.path("lpca"), LIGHTS["sun and lamp above"], shapes=False)
    usual, asked = (realtime(scene, grid=1, shadows=shadows) for shadows in (None, True))
    assert (usual.meta["shadows"], "shadow_maps" in usual.meta) == (False, False)
    assert asked.meta["shadow_maps"] == 0
    np.testing.assert_array_equal(asked.image, usual.image)
    references = [render(scene, grid=1, shadows=shadows) for shadows in (None, True)]
    assert [r.meta["shadows"] for r in references] == [False, True]
    np.testing.assert_array_equal(*(r.image for r in references))


def test_an_environment_keeps_its_light(llvm, fits):
    """Its own light casts no shadows, so that a lamp beside it casts some where that is asked for alone."""
    scene = scene_of(llvm, fits.path("lpca"), {"sky": SKY, "sun": SUN})
    usual, asked = (
        realtime(scene, grid=1, environment="lights", lights=16, shadows=shadows) for shadows in (None, True)
    )
    assert (usual.meta["shadows"], asked.meta["shadows"]) == (False, True)
    assert (asked.image <= usual.image).all()
    assert (asked.image < usual.image).any(-1).mean() > tolerance("rendered.shadow.min_pixels")


def test_a_picture_with_shadows_is_compared_with_such_a_reference(fits, tmp_path, capsys):
    scene = ["cloth", "-D", "lights=points2", "-D", f"btf={fits.path('lpca')}"]
    out, cache = str(tmp_path / "a.exr"), str(tmp_path / "cache")
    size = ["--grid", "2"]
    assert main(["realtime", *scene, "-o", out, "--size", "40x40", *size]) == 0
    capsys.readouterr()
    assert main(["compare", out, *scene, *size, "--cache", cache, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["differs"] == []
    assert "image.shadow_border.relative_l2" in {gate["name"] for gate in found["gates"]}
    assert main(["compare", out, *scene, *size, "--cache", cache, "--no-shadows"]) == 1
    assert "shadows in the test alone" in capsys.readouterr().out


@pytest.mark.parametrize("target", composer.TARGETS)
def test_glslang_accepts_shadows(need, fits, tmp_path, target):
    validator = need("glslang")
    rep = fits("lpca")
    shader, directories = device.shader_file(rep)
    counts = {"N_LIGHTS": 2, "SHADOWS": 1, "SHADOW_VIEWS": 7, "SHADOW_TRACED": 1, "SHADOW_QUADRICS": 3}
    defines = {**device.shader_defines(rep), **counts}
    settings = {"representation": shader, "directories": directories, "target": target}
    source = composer.compose("hosts/mesh.frag", defines, **settings)
    (tmp_path / "mesh.frag").write_text(source, encoding="utf-8")
    command = [validator, str(tmp_path / "mesh.frag")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, source.explain(done.stdout)
