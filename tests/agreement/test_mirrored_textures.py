"""Which way a texture runs: pictures in the mirror, degenerate coordinates, and what is said of mirrored ones."""

from itertools import product

import numpy as np
import pytest

from btfref.cli import main
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.registry import methods
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.reference import render
from btfref.scene.description import read_scene
from btfref.scene.hits import corner_frames
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("renderers")

RENDERERS = {
    "plugin": lambda scene: render(scene, grid=1, shadows=False),
    "GLSL": lambda scene: realtime(scene, grid=1, shadows=False),
    "float64": lambda scene: approximate(scene, grid=1),
}

#: The method whose pictures are made in the default run, in all three ways.
FIRST = "lpca"
SIZE = 24


def write_square(path, corners):
    """A square over [−1, 1]² as an OBJ file, with its texture coordinates at the corners."""
    places = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    lines = [f"v {x} {y} 0" for x, y in places] + [f"vt {u} {v}" for u, v in corners] + ["vn 0 0 1"]
    path.write_text("\n".join([*lines, "f 1/1/1 2/2/1 3/3/1 4/4/1"]) + "\n")
    return path


STRAIGHT, MIRRORED = [(0, 0), (1, 0), (1, 1), (0, 1)], [(1, 0), (0, 0), (0, 1), (1, 1)]


def square(mi, btf, path, *, side=1, to_uv=None, **shape):
    """A square under a light from the left and a lamp to the right, or, with −1, the other way around."""
    look = mi.ScalarTransform4f().look_at([0, -2.5, 3], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE}
    bsdf = {"type": "btf", "filename": str(btf), "lod": "none"}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 37, "to_world": look, "film": film},
        "shape": {
            "type": "obj",
            "filename": str(path),
            "flip_tex_coords": False,
            "bsdf": bsdf if to_uv is None else {**bsdf, "to_uv": to_uv},
            **shape,
        },
        "sun": {"type": "directional", "direction": [-0.5 * side, 0.25, -1]},
        "lamp": {"type": "point", "position": [0.5 * side, 0.25, 0.75]},
    }


def same(image, expected):
    return np.abs(image - expected).max() <= tolerance("mirror.symmetry.max") * np.abs(expected).max()


#: How a texture is mirrored: by its coordinates, by the material, by the transform of the shape; or twice.
WAYS = ("coordinates", "material", "shape", "twice")

#: In the default run one method is mirrored by its coordinates in all three ways to draw, and by the material in one.
DEFAULT = {(FIRST, renderer, "coordinates") for renderer in RENDERERS} | {(FIRST, "GLSL", "material")}

CASES = [
    pytest.param(*case, marks=[] if case in DEFAULT else pytest.mark.long)
    for case in product(methods(), RENDERERS, WAYS)
]


@pytest.mark.parametrize(("key", "renderer", "way"), CASES)
def test_a_mirrored_texture_in_mirrored_light_is_the_mirrored_picture(
    llvm, fits, tmp_path, key, renderer, way
):
    """The square and the camera are their own mirror images, so that this holds without any renderer's word for it."""
    llvm.set_variant("scalar_rgb")
    draw, btf, transform = RENDERERS[renderer], fits.path(key), llvm.ScalarTransform4f
    straight = write_square(tmp_path / "straight.obj", STRAIGHT)
    path = write_square(tmp_path / "other.obj", MIRRORED if way in ("coordinates", "twice") else STRAIGHT)
    settings = {}
    if way in ("material", "twice"):
        settings["to_uv"] = transform().translate([1, 0, 0]).scale([-1, 1, 1])
    if way == "shape":
        settings["to_world"] = transform().scale([-1, 1, 1])
    picture = draw(square(llvm, btf, straight)).image
    assert picture.max() > tolerance("rendered.subject.min_peak")
    if way == "twice":
        assert same(draw(square(llvm, btf, path, **settings)).image, picture)
        return
    expected = picture[:, ::-1]
    assert same(draw(square(llvm, btf, path, side=-1, **settings)).image, expected)
    if way == "coordinates":
        # The light tells left from right: a picture that is merely lit from there is another one.
        assert not same(draw(square(llvm, btf, straight, side=-1)).image, expected)


@pytest.mark.long
@pytest.mark.parametrize("draw", [realtime, approximate])
@pytest.mark.parametrize("way", ["sh", "transfer"])
def test_environments_in_the_mirror(llvm, fits, tmp_path, way, draw):
    """Seen from both sides: a mirrored frame is not the frame of a back."""
    llvm.set_variant("scalar_rgb")
    transform, option = llvm.ScalarTransform4f, {realtime: "environment", approximate: "path"}[draw]

    def picture(corners, side, up):
        path = write_square(tmp_path / "square.obj", corners)
        scene = square(llvm, fits.path(FIRST), path, to_world=transform().scale([1, 1, up]))
        del scene["sun"], scene["lamp"]
        scene["shape"]["bsdf"] = {"type": "twosided", "inner": scene["shape"]["bsdf"]}
        placed = transform().scale([side, 1, 1]) @ transform().rotate([0, 0, 1], 30)
        scene["sky"] = {"type": "envmap", "filename": "studio", "to_world": placed}
        return draw(scene, grid=1, **{option: way}).image

    for up in (1, -1):
        straight = picture(STRAIGHT, 1, up)
        assert straight.max() > tolerance("rendered.subject.min_peak")
        assert same(picture(MIRRORED, -1, up), straight[:, ::-1])
        assert not same(picture(STRAIGHT, -1, up), straight[:, ::-1])


def test_degenerate_coordinates_have_a_stated_frame(llvm, fits, tmp_path):
    """Where u and v span nothing the frame is Mitsuba's around the normal, in all three ways."""
    llvm.set_variant("scalar_rgb")
    path = write_square(tmp_path / "flat.obj", [(0.3, 0.6)] * 4)
    scene = square(llvm, fits.path(FIRST), path, to_world=llvm.ScalarTransform4f().rotate([1, 0.5, 0], 20))
    mesh = read_scene(scene).meshes[0]
    frame = llvm.Frame3f(mesh.normals[0].tolist())
    expected = np.stack([np.array(a) for a in (frame.s, frame.t, frame.n)], -1)
    assert (mesh.hands() == 1).all()
    assert np.abs(corner_frames(mesh) - expected).max() <= tolerance("scene.frame.exact")
    first, *others = (draw(scene).image for draw in RENDERERS.values())
    interior = pixel_classes(scene, grid=1) == PixelClass.INTERIOR
    assert first[interior].max() > tolerance("rendered.subject.min_peak")
    assert all(same(other[interior], first[interior]) for other in others)


def test_render_says_once_that_a_texture_is_mirrored(llvm, fits, tmp_path, capsys):
    """Mitsuba's OBJ reader turns v over unless it is told not to; the line names the shape and the cure."""
    write_square(tmp_path / "square.obj", STRAIGHT)
    text = """<scene version="3.0.0"><default name="flip" value="true"/><integrator type="direct"/>
    <sensor type="perspective"><transform name="to_world">
    <lookat origin="0,-2,3" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
    <shape type="obj" id="floor"><string name="filename" value="square.obj"/>
    <boolean name="flip_tex_coords" value="$flip"/><bsdf type="twosided"><bsdf type="btf">
    <string name="filename" value="{}"/></bsdf></bsdf></shape><emitter type="directional"/></scene>"""
    (tmp_path / "scene.xml").write_text(text.format(fits.path(FIRST)))
    for command, flip, count in (("render", "true", 1), ("render", "false", 0), ("realtime", "true", 1)):
        capsys.readouterr()
        arguments = [command, str(tmp_path / "scene.xml"), "-o", str(tmp_path / f"{command}.exr")]
        assert main([*arguments, "--grid", "1", "-D", f"flip={flip}"]) == 0
        said = [line for line in capsys.readouterr().out.splitlines() if "mirrored" in line]
        assert len(said) == count
        assert all("floor" in line and "flip_tex_coords" in line and "to_uv" in line for line in said)
