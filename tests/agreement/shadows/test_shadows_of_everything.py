"""Cast shadows of all that a scene can have: exact shapes, instances, materials beside BTFs, spots and area lights."""

from importlib.resources import files

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.platform import shader_directory
from btfref.rendering.gl import device, shadows
from btfref.rendering.gl.box_tree import box_tree
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

GATES = (
    *("image.noise_free", "image.judged", "image.silhouette", "image.shadow_border", "image.background"),
    "image.negative",
)
SETTINGS = {"grid": 2}


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def everything(mi, path):
    """A BTF on a cloth, a pole, a disk and two instances of a ball; a metal sphere; a floor that is diffuse."""
    mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform4f
    both = {"type": "twosided", "inner": {"type": "btf", "filename": str(path)}}
    shipped = files("btfref.scene.shipped")
    ball, cloth = ({"type": "ply", "filename": str(shipped / f"{name}.ply")} for name in ("sphere", "cloth"))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            "type": "perspective",
            "fov": 38,
            "to_world": transform().look_at([0.9, -3.4, 2.9], [0, 0.1, 0.2], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 40, "height": 34},
        },
        "floor": {
            "type": "rectangle",
            "to_world": transform().scale(1.6),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)},
        },
        "cloth": {
            **cloth,
            "to_world": transform().translate([-0.7, 0.5, 0.5]).rotate([1, 0, 0], 25).scale(0.5),
            "bsdf": both,
        },
        "metal": {
            "type": "sphere",
            "center": [0.5, -0.6, 0.35],
            "radius": 0.3,
            "bsdf": {"type": "conductor", "material": "Cu"},
        },
        "pole": {
            "type": "cylinder",
            "p0": [-0.9, -0.7, 0],
            "p1": [-0.8, -0.7, 0.9],
            "radius": 0.1,
            "bsdf": both,
        },
        "sign": {
            "type": "disk",
            "to_world": transform().translate([1, 0.2, 0.7]).rotate([1, 0, 0], 60).scale([0.3, 0.2, 1]),
            "bsdf": both,
        },
        "group": {"type": "shapegroup", "ball": {**ball, "bsdf": both}},
        "near": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": transform().translate([-0.1, -0.5, 0.25]).scale([0.25, 0.2, 0.25]),
        },
        "far": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": transform().translate([0.5, 0.7, 0.35]).scale([-0.3, 0.3, 0.3]),
        },
        "spot": {
            "type": "spot",
            "to_world": transform().look_at([-1.8, -1.2, 2.4], [-0.1, -0.1, 0.2], [0, 0, 1]),
            "intensity": rgb(14, 11, 8),
            "cutoff_angle": 32,
            "beam_width": 25,
        },
        "lamp": {
            "type": "rectangle",
            "to_world": transform().translate([1.3, 1.4, 1.3]).rotate([1, -1, 0], 130).scale([0.05, 0.03, 1]),
            "emitter": {"type": "area", "radiance": rgb(170, 230, 340)},
        },
    }


@pytest.fixture(scope="module")
def all_of_it(fits):
    """``all_of_it(mi) -> (scene, picture in real time, reference, classes)``, rendered once."""
    made = []

    def get(mi):
        if not made:
            scene = everything(mi, fits.path("lpca"))
            classes = pixel_classes(scene, shadows=True, **SETTINGS)
            made.extend([scene, realtime(scene, **SETTINGS), render(scene, **SETTINGS), classes])
        return made

    return get


def failed(image, expected, classes):
    comparison = compare(image, expected, classes=classes, gate=GATES, flip=False)
    return {gate.name: gate.line for gate in comparison.gates if not gate.passed}


def test_a_scene_of_everything_has_the_shadows_of_the_reference(llvm, all_of_it):
    _, image, expected, classes = all_of_it(llvm)
    assert (image.meta["shadows"], expected.meta["shadows"]) == (True, True)
    assert (
        image.meta["area_light_points"] == expected.meta["area_light_points"] == image.meta["shadow_traced"]
    )
    assert image.meta["shadow_maps"] == 1
    assert failed(image, expected, classes) == {}
    shares = np.bincount(classes.ravel(), minlength=len(PixelClass)) / np.count_nonzero(classes)
    assert shares[[PixelClass.INTERIOR, PixelClass.EDGE]].sum() > tolerance("rendered.shadow.min_strict")
    assert shares[PixelClass.OTHER] > 0


FAULTS = {
    "exact shapes cast none": ("i < SHADOW_QUADRICS", "i < 0"),
    "the tree is empty": ("int node = 1;", "int node = 0;"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_shadows_that_are_missing_are_caught(llvm, all_of_it, tmp_path, monkeypatch, fault):
    right, wrong = FAULTS[fault]
    file, shipped = "lib/light/occluders.glsl", device.shader_file
    text = (shader_directory() / file).read_text("utf-8")
    assert text.count(right) == 1
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(text.replace(right, wrong), "utf-8")
    monkeypatch.setattr(device, "shader_file", lambda rep: (shipped(rep)[0], [tmp_path]))
    scene, _, expected, classes = all_of_it(llvm)
    found = failed(realtime(scene, **SETTINGS), expected, classes)
    assert {"image.noise_free.max", "image.shadow_border.relative_l2"} <= set(found)


def exact_shapes(mi, light):
    """A ground that is a huge sphere, an open tube and a ball around a lamp; without triangles."""
    mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform4f
    both = {"type": "twosided", "inner": {"type": "diffuse"}}
    shapes = {
        "ground": {"type": "sphere", "center": [0, 0, -300], "radius": 300},
        "tube": {"type": "cylinder", "p0": [-0.5, 0.2, 0.2], "p1": [0.3, 0.5, 0.5], "radius": 0.3},
        "hood": {"type": "disk", "to_world": transform().translate([0.6, 0.3, 0.8]).scale([0.3, 0.2, 1])},
        "ball": {"type": "sphere", "center": [0.5, -0.4, 0.2], "radius": 0.25},
    }
    look = transform().look_at([0.4, -2.6, 2], [0, 0, 0.1], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 48, "height": 40}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        **{name: {**shape, "bsdf": both} for name, shape in shapes.items()},
        "light": light,
    }


EXACT = {
    "sun": {"type": "directional", "direction": [-0.5, 0.4, -1]},
    "lamp in the tube": {"type": "point", "position": [-0.1, 0.33, 0.35], "intensity": rgb(1, 1, 1)},
}


@pytest.mark.parametrize("name", EXACT)
def test_exact_shapes_shadow_each_other_and_themselves(llvm, name):
    scene = exact_shapes(llvm, EXACT[name])
    image = realtime(scene, **SETTINGS)
    assert (image.meta["shadow_maps"], image.meta["shadow_traced"]) == (0, 0)
    expected, classes = render(scene, **SETTINGS), pixel_classes(scene, shadows=True, **SETTINGS)
    assert failed(image, expected, classes) == {}
    assert failed(realtime(scene, shadows=False, **SETTINGS), expected, classes) != {}


def test_lights_without_room_for_a_map_go_through_the_tree(llvm, all_of_it, monkeypatch):
    monkeypatch.setattr(shadows, "ATLAS", shadows.LEAST - 1)
    scene, _, expected, classes = all_of_it(llvm)
    image = realtime(scene, **SETTINGS)
    assert (image.meta["shadow_maps"], image.meta["shadow_traced"]) == (0, image.meta["lights"])
    assert failed(image, expected, classes) == {}


def test_a_tree_has_every_triangle_in_all_boxes_above_it(rng):
    triangles = rng.normal(size=(77, 1, 3)) + 0.1 * rng.normal(size=(77, 3, 3))
    nodes, leaves = box_tree(triangles, 100 + np.arange(77))
    assert sorted(leaves[leaves >= 0]) == list(range(100, 177))
    for leaf, numbers in enumerate(leaves):
        node = len(leaves) + leaf
        assert nodes[node, 1, 3] == leaf
        for number in numbers[numbers >= 0].astype(int) - 100:
            above = node
            while above:
                assert (nodes[above, 0, :3] < triangles[number]).all()
                assert (nodes[above, 1, :3] > triangles[number]).all()
                above //= 2
    # Whoever enters all boxes sees every leaf once; whoever misses the root is done.
    node, seen = 1, []
    while node:
        inner = nodes[node, 1, 3] < 0
        seen += [] if inner else [int(nodes[node, 1, 3])]
        node = 2 * node if inner else int(nodes[node, 0, 3])
    assert seen == list(range(len(leaves)))
    assert nodes[1, 0, 3] == 0
