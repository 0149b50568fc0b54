"""Spheres, disks and cylinders in real time: the exact surface, with poles and centres, for every method."""

from dataclasses import replace

import pytest

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.registry import methods
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.reference import render
from btfref.scene.description import read_scene
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

GATES = ("image.noise_free", "image.silhouette", "image.mesostructure", "image.background", "image.judged")

#: The method whose pictures are all made in the default run.
FIRST = "lpca"
GRID, SIZE = 2, (64, 64)


def shapes_of(mi):
    """Single shapes by name: as they are, turned to show a pole or a centre, mirrored, stretched, from inside."""
    transform = mi.ScalarTransform4f
    towards = transform().look_at([0, 0, 0], [1.5, -3, 3.2], [0, 0, 1])
    return {
        "sphere": {"type": "sphere", "center": [0.1, 0, 0.2], "radius": 1.1},
        "pole": {"type": "sphere", "to_world": towards},
        "mirrored": {"type": "sphere", "to_world": transform().rotate([1, 0, 0], 60).scale([-1, 1, 1])},
        "flipped": {"type": "sphere", "flip_normals": True},
        "disk": {"type": "disk", "to_world": transform().rotate([1, 0, 0], 20).scale([1.5, 0.7, 1])},
        "mirrored disk": {"type": "disk", "to_world": towards @ transform().scale([-1, 1, 1])},
        "cylinder": {"type": "cylinder", "p0": [-0.8, 0, 0], "p1": [0.8, 0.3, 0.2], "radius": 0.7},
        "from inside": {"type": "cylinder", "p0": [0, 0, -0.5], "p1": [0.1, 0.2, 0.7], "radius": 0.9},
    }


def scene_of(mi, shapes, bsdf, **lights):
    look = mi.ScalarTransform4f().look_at([1.5, -3, 3.2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1]}
    both = {"type": "twosided", "inner": bsdf}
    lights = lights or {
        "sun": {"type": "directional", "direction": [-0.3, 0.6, -1.0]},
        "lamp": {
            "type": "point",
            "position": [-1.5, 0.5, 2.9],
            "intensity": {"type": "rgb", "value": [2, 7, 1]},
        },
    }
    camera = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    placed = {f"shape{i}": {**shape, "bsdf": both} for i, shape in enumerate(shapes)}
    return {"type": "scene", "camera": camera, **placed, **lights}


def together(mi, bsdf, **lights):
    """All of them in one picture, small and side by side."""
    transform = mi.ScalarTransform4f
    shapes = []
    for number, shape in enumerate(shapes_of(mi).values()):
        row, column = divmod(number, 3)
        place = transform().translate([0.9 * column - 0.9, 0.9 * row - 0.9, 0]).scale(0.4)
        shapes.append({**shape, "to_world": place @ shape.get("to_world", transform())})
    return scene_of(mi, shapes, bsdf, **lights)


def btf(fits, key):
    return {"type": "btf", "filename": str(fits.path(key)), "lod_bias": 0.2}


def judged(scene, image, classes=None):
    classes = pixel_classes(scene, grid=GRID) if classes is None else classes
    expected = render(scene, grid=GRID, shadows=False)
    assert expected.image[classes == PixelClass.INTERIOR].max() > tolerance("rendered.subject.min_peak")
    return compare(image, expected, classes=classes, gate=GATES, flip=False)


def assert_passed(comparison):
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]


@pytest.mark.parametrize(
    "key", [FIRST, *(pytest.param(k, marks=pytest.mark.long) for k in methods() if k != FIRST)]
)
def test_every_method_on_exact_shapes(llvm, fits, key):
    llvm.set_variant("scalar_rgb")
    scene = together(llvm, btf(fits, key))
    assert_passed(judged(scene, realtime(scene, grid=GRID, shadows=False)))


@pytest.mark.long
@pytest.mark.parametrize("key", methods())
def test_each_shape_alone(llvm, fits, key):
    llvm.set_variant("scalar_rgb")
    for shape in shapes_of(llvm).values():
        scene = scene_of(llvm, [shape], btf(fits, key))
        assert_passed(judged(scene, realtime(scene, grid=GRID, shadows=False)))


@pytest.mark.parametrize("scale", [[0.5, 0.9, 0.6], pytest.param([-0.6, 0.6, 0.6], marks=pytest.mark.long)])
def test_exact_shapes_of_an_instance(llvm, fits, scale):
    """Stretched and mirrored: Mitsuba meets them in the group's space, and so does the shader."""
    llvm.set_variant("scalar_rgb")
    known, transform = shapes_of(llvm), llvm.ScalarTransform4f
    scene = scene_of(llvm, [], None)
    both = {"type": "twosided", "inner": btf(fits, FIRST)}
    shapes = {name: {**known[name], "bsdf": both} for name in ("sphere", "from inside")}
    shapes["disk"] = {"type": "disk", "to_world": transform().translate([0.2, 0.8, 1.4]), "bsdf": both}
    shapes["from inside"]["p1"] = [0.1, 1.2, 1.7]
    scene["group"] = {"type": "shapegroup", **{name.split()[-1]: shape for name, shape in shapes.items()}}
    turned = transform().rotate([0.6, 0.8, 0], 50) @ transform().scale(scale)
    scene["instance"] = {"type": "instance", "to_world": turned, "group": {"type": "ref", "id": "group"}}
    assert_passed(judged(scene, realtime(scene, grid=GRID, shadows=False)))


def test_triangles_in_their_place_fail(llvm, fits):
    llvm.set_variant("scalar_rgb")
    scene = scene_of(llvm, [shapes_of(llvm)["pole"]], btf(fits, FIRST))
    described = read_scene(scene)
    meshes = tuple(replace(mesh, quadric=None) for mesh in described.meshes)
    comparison = judged(scene, realtime(replace(described, meshes=meshes), grid=GRID, shadows=False))
    failed = {gate.name for gate in comparison.gates if not gate.passed}
    assert "image.noise_free.p999" in failed


@pytest.mark.parametrize(
    "lights", [pytest.param(8, marks=pytest.mark.long), 40], ids=["one pass", "two passes"]
)
def test_exact_shapes_and_a_mesh_under_an_environment(llvm, fits, lights):
    """Pictures that add up find the same surface each time, shapes of both kinds before and behind each other."""
    llvm.set_variant("scalar_rgb")
    scene = together(llvm, btf(fits, FIRST), sky={"type": "envmap", "filename": "studio"})
    floor = {"type": "rectangle", "to_world": llvm.ScalarTransform4f().scale(1.2), "bsdf": btf(fits, FIRST)}
    scene["floor"] = floor
    image = realtime(scene, grid=1, size=(48, 48), environment="lights", lights=lights)
    expected = approximate(scene, grid=1, size=(48, 48), path="lights", lights=lights)
    classes = pixel_classes(scene, grid=1, size=(48, 48))
    assert_passed(compare(image, expected, classes=classes, gate=GATES, flip=False))


def test_a_camera_inside_of_a_sphere_sees_its_far_side(llvm, fits):
    llvm.set_variant("scalar_rgb")
    shape = {"type": "sphere", "radius": 9, "flip_normals": True}
    scene = scene_of(llvm, [shape], btf(fits, FIRST))
    image = realtime(scene, grid=GRID, shadows=False)
    assert (pixel_classes(scene, grid=GRID) != PixelClass.BACKGROUND).all()
    assert_passed(judged(scene, image))


def test_a_sample_at_a_pole_is_ambiguous_and_those_around_it_are_not(llvm):
    llvm.set_variant("scalar_rgb")
    scene = scene_of(llvm, [shapes_of(llvm)["pole"]], {"type": "diffuse"})
    # An odd number of pixels has one in the middle, whose centre sees the pole.
    at_the_pole, around = (pixel_classes(scene, grid=grid, size=(33, 33)) for grid in (1, 2))
    assert at_the_pole[16, 16] == PixelClass.SILHOUETTE
    assert (around[12:21, 12:21] == PixelClass.INTERIOR).all()
