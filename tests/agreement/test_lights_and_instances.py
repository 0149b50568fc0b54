"""Instances, spots and area lights in real time against noise-free references and against light sampled all over."""

from importlib.resources import files

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.rendering.gl import renderer
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.converged import converged
from btfref.rendering.offline.reference import render
from btfref.scene.description import read_scene
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

GRID = 2
SIZE = (32, 24)
GATES = ("image.noise_free", "image.silhouette", "image.background")

HEAD = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>{path}
<sensor type="{sensor}"><float name="fov" value="45"/><transform name="to_world">
<lookat origin="0.5,-3.5,3.2" target="0,0,0.4" up="0,0,1"/></transform>{lens}<film type="hdrfilm">
<integer name="width" value="32"/><integer name="height" value="24"/>{crop}</film></sensor>
<bsdf type="twosided" id="m"><bsdf type="btf"><string name="filename" value="{file}"/></bsdf></bsdf>"""
CLOTH = '<shape type="ply"><string name="filename" value="{cloth}"/><ref id="m"/></shape>'
BOX = '<shape type="cube" id="box"><boolean name="face_normals" value="true"/><ref id="m"/>{placed}</shape>'
FLOOR = """<shape type="rectangle" id="floor"><transform name="to_world"><scale value="3"/>
<translate z="-0.3"/></transform><ref id="m"/></shape>"""
PLACES = (
    '<transform name="to_world"><scale value="0.5"/><translate x="-0.7"/></transform>',
    '<transform name="to_world"><scale x="-0.5" y="0.6" z="0.4"/><rotate z="1" angle="30"/><translate x="0.8" y="0.2"/>'
    "</transform>",
)
SUN = '<emitter type="directional"><vector name="direction" value="0.3,0.4,-1"/></emitter>'
SPOT = """<emitter type="spot"><transform name="to_world"><lookat origin="-1,-1.5,2.5" target="-0.2,0,0" up="0,0,1"/>
</transform><rgb name="intensity" value="9,8,6"/><float name="cutoff_angle" value="28"/>
<float name="beam_width" value="12"/></emitter>"""
LAMP = """<shape type="rectangle" id="lamp"><transform name="to_world"><scale x="0.4" y="0.3"/>
<rotate x="1" angle="120"/><translate x="0.2" y="1.2" z="1"/></transform>
<emitter type="area"><rgb name="radiance" value="6,7,9"/></emitter></shape>"""


def group(*shapes):
    """A group and its instances, one mirrored."""
    inside = "".join(shapes).replace("{placed}", "")
    placed = "".join(
        f'<shape type="instance" id="i{k}"><ref id="g"/>{place}</shape>' for k, place in enumerate(PLACES)
    )
    return f'<shape type="shapegroup" id="g">{inside}</shape>{placed}'


@pytest.fixture
def write(tmp_path, fits):
    def write(*parts, file=None, path="", sensor="perspective", lens="", crop="", name="scene.xml"):
        head = {"file": file or fits.path("lpca"), "path": path, "sensor": sensor, "lens": lens, "crop": crop}
        text = "".join(parts).replace("{cloth}", str(files("btfref.scene.shipped").joinpath("cloth.ply")))
        (tmp_path / name).write_text(HEAD.format(**head) + text + "</scene>")
        return tmp_path / name

    return write


def held(image, reference, scene, gate=GATES, grid=GRID, size=None):
    classes = pixel_classes(scene, grid=grid, size=size)
    found = compare(image, reference, classes=classes, gate=gate, flip=False)
    return [found.passed, *(gate.line for gate in found.gates if not gate.passed)]


def test_two_instances_under_a_spot_and_an_area_light(write):
    scene = write(group(CLOTH), FLOOR, SPOT, LAMP)
    image = realtime(scene, grid=GRID, shadows=False)
    reference = render(scene, grid=GRID, shadows=False)
    assert reference.meta["integrator"] == "noise-free direct"
    assert image.meta["area_light_points"] == reference.meta["area_light_points"]
    assert held(image, reference, scene) == [True]
    # One of the instances mirrors its texture.
    assert image.meta["mirrored"] == ["i1/ply"]
    image = realtime(scene, grid=1, shadows=False)
    assert held(image, approximate(scene, grid=1), scene, ("image.float64",), grid=1) == [True]
    # Both are there, and the lamp is seen from its front.
    without = realtime(write(FLOOR, SPOT, LAMP, name="without.xml"), grid=1, shadows=False).image
    changed = np.abs(image.image - without).max(-1) > 0
    assert changed[:, :12].any()
    assert changed[:, -12:].any()
    assert (image.image == np.array([6, 7, 9], np.float32)).all(-1).any()
    assert np.array_equal(realtime(scene, grid=1, keep="needed", shadows=False).image, image.image)


def test_points_against_light_from_all_over_an_area(write, monkeypatch):
    """Equivalence, and a light without its own cosine is caught."""
    scene = write(FLOOR, LAMP)
    gate, small = "image.area_lights", {"size": (16, 12)}
    classes = pixel_classes(scene, grid=GRID, **small)
    inside = classes == PixelClass.INTERIOR
    reference = converged(scene, inside, gate=gate, shadows=False, grid=GRID, **small)
    assert reference.meta["noise_ratio"] <= 1
    assert held(realtime(scene, grid=GRID, shadows=False, **small), reference, scene, gate, **small) == [True]
    made = renderer.light_table

    def points(lights):
        table = made(lights)
        table[:, 0, 3] = 1
        return table

    monkeypatch.setattr(renderer, "light_table", points)
    assert (
        held(realtime(scene, grid=GRID, shadows=False, **small), reference, scene, gate, **small)[0] is False
    )


def test_mirrored_instances_of_shapes_with_face_normals(write):
    """A group of a box and a rectangle; the rectangle shines, but not in a group."""
    scene = write(group(BOX, '<shape type="rectangle"><ref id="m"/></shape>'), SUN)
    pictures = (show(scene, grid=GRID, shadows=False) for show in (realtime, render))
    assert held(*pictures, scene) == [True]
    assert [mesh.name for mesh in read_scene(scene).meshes] == [
        "i0/box",
        "i0/rectangle",
        "i1/box",
        "i1/rectangle",
    ]


def test_merged_shapes_are_separate_ones(write):
    boxes = [BOX.replace("{placed}", place).replace("box", f"box{k}") for k, place in enumerate(PLACES)]
    merged = write(f'<shape type="merge">{"".join(boxes)}</shape>', SUN)
    apart = write(*boxes, SUN, name="apart.xml")
    for image in (realtime, render):
        assert np.array_equal(image(merged, grid=1).image, image(apart, grid=1).image)


def test_a_shape_that_shines_and_reflects(write):
    shining = FLOOR.replace(
        "</shape>", '<emitter type="area"><rgb name="radiance" value="0.3,0.2,0.1"/></emitter></shape>'
    )
    scene = write(shining, SUN)
    image, dark = realtime(scene, grid=1).image, realtime(write(FLOOR, SUN, name="dark.xml"), grid=1).image
    seen = pixel_classes(scene, grid=1) == PixelClass.INTERIOR
    own = np.tile([0.3, 0.2, 0.1], (seen.sum(), 1))
    np.testing.assert_allclose((image - dark)[seen], own, rtol=tolerance("rendered.sum.rtol"))
    assert held(realtime(scene, grid=GRID), render(scene, grid=GRID, shadows=False), scene) == [True]


def test_search_paths_whole_crops_and_lenses_of_no_size(write, tmp_path, fits, monkeypatch):
    away = tmp_path / "a" / "b"
    away.mkdir(parents=True)
    (away / "there.exr").write_bytes(fits.path("lpca").read_bytes())
    expected = realtime(write(FLOOR, SUN), grid=1)
    assert expected.meta["notes"] == []
    monkeypatch.chdir(tmp_path.parent)
    crop = "".join(
        f'<integer name="crop_{name}" value="{value}"/>'
        for name, value in {"width": 32, "height": 24, "offset_x": 0}.items()
    )
    lens = '<float name="aperture_radius" value="{}"/><float name="focus_distance" value="3"/>'
    more = {"file": "there.exr", "path": '<path value="a/b"/>', "crop": crop, "sensor": "thinlens"}
    scene = write(FLOOR, SUN, lens=lens.format(0), **more)
    image = realtime(scene, grid=1)
    assert np.array_equal(image.image, expected.image)
    assert image.meta["notes"] == ["thinlens with aperture_radius 0: drawn as a perspective camera"]
    assert np.array_equal(
        render(scene, grid=1, shadows=False).image,
        render(tmp_path / "scene.xml", grid=1, shadows=False, size=SIZE).image,
    )
    wide = write(FLOOR, SUN, lens=lens.format(0.1), name="wide.xml", **more)
    for reader in (realtime, render):
        with pytest.raises(InputError, match="depth of field"):
            reader(wide, grid=1)


def test_both_renderers_refuse_alike(write, tmp_path):
    part = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1//1 3//1 4//1\nvn 0 0 1\n"
    (tmp_path / "part.obj").write_text(part)
    uneven = '<shape type="obj" id="part"><string name="filename" value="part.obj"/><ref id="m"/></shape>'
    slip = FLOOR.replace(
        '<ref id="m"/>',
        '<bsdf type="btf"><string name="filename" value="{}"/><float name="scall" value="2"/></bsdf>',
    )
    directed = '<shape type="rectangle"><emitter type="directionalarea"/></shape>'
    cases = {
        "part": ((uneven, SUN), r"part.obj, line 9.*part"),
        "slip": ((slip, SUN), r"scall.*filename, filter_type, interpolation, scale"),
        "dark": ((FLOOR,), r"dark.xml: the scene has no light"),
        "directed": ((FLOOR, directed), "directionalarea.*tracing particles"),
    }
    for name, (parts, reason) in cases.items():
        scene = write(*parts, name=f"{name}.xml")
        for reader in (realtime, lambda scene, **more: render(scene, spp=1), render):
            with pytest.raises(InputError, match=reason) as caught:
                reader(scene, grid=1)
            assert "\n" not in str(caught.value)


def test_a_cylinder_is_read_under_any_variant(llvm):
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    camera = {"type": "perspective", "film": film}
    shape = {"type": "cylinder", "p0": [0, -1, 0.2], "p1": [0.4, 1, 0], "radius": 0.7}
    scene = {"type": "scene", "c": camera, "s": shape}
    read = {}
    for variant in ("scalar_rgb", "llvm_ad_rgb"):
        llvm.set_variant(variant)
        read[variant] = read_scene(scene).meshes[0].positions
    assert np.array_equal(*read.values())
