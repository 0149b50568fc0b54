"""Scenes are read as Mitsuba reads them, and bad ones are refused in one line. No LLVM is needed."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.numerics.sphere.frames import Turn, shading_frame
from btfref.scene.description import read_scene
from btfref.scene.shapes import BtfMaterial, neighbours
from btfref.scene.shipped import meshes


@pytest.fixture
def mi():
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def camera(mi, **more):
    look_at = mi.ScalarTransform4f().look_at([1, 2, 5], [0.3, 0, 0.1], [0.1, 1, 0.2])
    film = {"type": "hdrfilm", "width": 31, "height": 20}
    return {"type": "perspective", "fov": 50, "to_world": look_at, "film": film, **more}


def placed(mi):
    turn = mi.ScalarTransform4f().rotate((np.array([1, 2, 3]) / np.sqrt(14)).tolist(), 37)
    return mi.ScalarTransform4f().translate([0.1, 0.2, 0.3]) @ turn


SHAPES = {
    "rectangle": {"type": "rectangle"},
    "rectangle, flipped": {"type": "rectangle", "flip_normals": True},
    "cube": {"type": "cube"},
    "cube, flipped": {"type": "cube", "flip_normals": True},
    "cube, face normals": {"type": "cube", "face_normals": True},
    "cylinder": {"type": "cylinder", "p0": [0, -1, 0.2], "p1": [0.4, 1, 0], "radius": 0.7},
    "cylinder, flipped": {"type": "cylinder", "flip_normals": True},
    "sphere": {"type": "sphere", "center": [0.3, 0.1, 0], "radius": 1.3},
    "sphere, flipped": {"type": "sphere", "flip_normals": True},
    "disk": {"type": "disk"},
}


STRETCHES = {"": [1, 1, 1], "stretched": [1, 2, 0.5], "mirrored": [-1, 1, 1]}
#: Mitsuba's round shapes allow rotations, translations, mirrors and uniform scales only.
CASES = [
    (name, how)
    for name in SHAPES
    for how in STRETCHES
    if how != "stretched" or name.startswith(("rectangle", "cube"))
]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_triangles_have_mitsubas_frames_and_uv(mi, rng, name, how):
    shape, stretch = dict(SHAPES[name]), STRETCHES[how]
    shape["to_world"] = placed(mi) @ mi.ScalarTransform4f().scale(stretch)
    scene = {"type": "scene", "camera": camera(mi), "shape": shape}
    mesh = read_scene(scene).meshes[0]
    positions, normals, uv, dp_du = mesh.corners()
    choice = rng.integers(0, len(positions), 100)
    weight = rng.dirichlet([1, 1, 1], 100)[:, :, None]
    point, normal, uv = (np.sum(weight * array[choice], 1) for array in (positions, normals, uv))
    frame = shading_frame(normal / np.linalg.norm(normal, axis=1, keepdims=True), dp_du[choice])
    side = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])[choice]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    made = mi.load_dict(scene)
    # Chords of round shapes lie inside: their frames and uv are those of a point beside.
    limit = tolerance(
        "scene.frame.tessellated" if shape["type"] in ("sphere", "disk") else "scene.frame.exact"
    )
    for i in range(len(point)):
        start = point[i] + 0.05 * side[i]
        si = made.ray_intersect(mi.Ray3f(mi.Point3f(start.tolist()), mi.Vector3f((-side[i]).tolist())))
        assert si.is_valid()
        theirs = np.array([si.sh_frame.s, si.sh_frame.t, si.sh_frame.n])
        # Around a pole or the centre of a disk the tangent turns within a triangle.
        turning = {"sphere": abs(uv[i, 1] - 0.5) > 0.48, "disk": uv[i, 0] < 0.2}.get(shape["type"], False)
        if not turning:
            assert np.abs(theirs - frame[i]).max() < limit
            difference = np.abs(np.array(si.uv) - uv[i])
            assert np.minimum(difference, 1 - difference).max() < limit


@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger", "diagonal"])
@pytest.mark.parametrize("size", [None, (16, 24)])
def test_camera_rays(mi, axis, size):
    described = camera(mi, fov_axis=axis)
    ours = read_scene({"type": "scene", "c": described}, size=size).camera
    if size:
        described = {**described, "film": {"type": "hdrfilm", "width": size[0], "height": size[1]}}
    sensor = mi.load_dict(described)
    corner, right, down = ours.ray_basis()
    for x, y in ((0, 0), (0.3, 0.7), (1, 1)):
        ray, _ = sensor.sample_ray(0, 0.5, [x, y], [0.5, 0.5])
        direction = corner + x * ours.width * right + y * ours.height * down
        assert np.abs(direction / np.linalg.norm(direction) - np.array(ray.d)).max() < tolerance(
            "scene.ray.max"
        )
        assert np.linalg.norm(np.cross(np.array(ray.o) - ours.origin, ray.d)) < tolerance("scene.ray.max")


def test_lights(mi):
    scene = {
        "type": "scene",
        "c": camera(mi),
        "sun": {
            "type": "directional",
            "direction": [0, -3, -4],
            "irradiance": {"type": "rgb", "value": [1, 2, 3]},
        },
        "lamp": {"type": "point", "position": [1, 2, 3], "intensity": {"type": "rgb", "value": [4, 5, 6]}},
    }
    sun, lamp = read_scene(scene).lights
    assert (sun.kind, lamp.kind) == ("directional", "point")
    for ours, expected in [
        (sun.position, [0, 0.6, 0.8]),
        (sun.power, [1, 2, 3]),
        (lamp.position, [1, 2, 3]),
        (lamp.power, [4, 5, 6]),
    ]:
        assert np.abs(ours - expected).max() < tolerance("scene.light.max")


MATERIAL = '<bsdf type="btf"><string name="filename" value="$btf"/>{}</bsdf>'
SENSOR = '<sensor type="perspective"><float name="fov" value="40"/></sensor>'


@pytest.fixture
def write(tmp_path):
    def write(body, name="scene.xml"):
        (tmp_path / "file.exr").write_bytes(b"not read here")
        path = tmp_path / name
        path.write_text(f'<scene version="3.0.0"><default name="btf" value="file.exr"/>{body}</scene>')
        return path

    return write


def test_material_and_parameters(mi, write, tmp_path, monkeypatch):
    inner = (
        '<string name="filter_type" value="$filter"/><float name="scale" value="0.5"/>'
        '<transform name="to_uv"><rotate z="1" angle="90"/><scale x="3" y="2"/>'
        '<translate x="0.25"/></transform>'
    )
    body = SENSOR + f'<bsdf type="twosided" id="m">{MATERIAL.format(inner)}</bsdf>'
    body += '<shape type="rectangle" id="a"><ref id="m"/></shape><shape type="sphere" id="b"/>'
    path = write(body)
    # Relative names are looked up beside the scene as well.
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    a, b = read_scene(path, {"filter": "nearest"}).meshes
    assert (a.name, a.plugin, b.name, b.bsdf, b.material) == ("a", "rectangle", "b", "diffuse", None)
    assert (a.material.filename, a.material.filter_type) == (str(tmp_path / "file.exr"), "nearest")
    assert (a.material.scale, a.material.twosided) == (0.5, True)
    assert np.abs(a.material.to_uv - [[0, -3, 0.25], [2, 0, 0]]).max() < tolerance("scene.light.max")
    # The nearest rotation to [[0, -3], [2, 0]] is a quarter turn.
    turn = a.material.turn
    found = np.array([turn.cosine, turn.sine, turn.hand])
    assert np.abs(found - [0, 1, 1]).max() < tolerance("scene.light.max")


RECTANGLE = '<shape type="rectangle"/>'
BAD = {
    "malformed": ("<shape", "tag|XML|pars"),
    "no sensor": (RECTANGLE, "sensor"),
    "two sensors": (SENSOR + SENSOR + RECTANGLE, "sensor"),
    "unsupported sensor": (
        '<sensor type="thinlens"><float name="aperture_radius" value="1"/></sensor>',
        "thinlens",
    ),
    "lens without a size": (SENSOR.replace("perspective", "thinlens"), "aperture_radius|thinlens"),
    "unsupported light": (SENSOR + '<emitter type="projector"/>', "projector"),
    "light of Mitsuba 0.6": (SENSOR + '<emitter type="sky"/>', "sunsky with sun_scale 0"),
    "textured spot": (
        SENSOR + '<emitter type="spot"><texture name="texture" type="checkerboard"/></emitter>',
        "textured spot",
    ),
    "textured area light": (
        SENSOR
        + '<shape type="rectangle"><emitter type="area"><texture name="radiance" type="checkerboard"/>'
        + "</emitter></shape>",
        "textured area",
    ),
    "light along its normal": (
        SENSOR + '<shape type="rectangle"><emitter type="directionalarea"/></shape>',
        "directionalarea.*tracing particles",
    ),
    "unknown property": (
        SENSOR
        + f'<shape type="rectangle">{MATERIAL.format("<float name=%s value=%s/>")}</shape>'
        % ('"scall"', '"2"'),
        "scall.*filename, filter_type, interpolation, scale",
    ),
    "object in a material": (
        SENSOR + f'<shape type="rectangle">{MATERIAL.format("<bsdf type=%s/>")}</shape>' % '"diffuse"',
        "nested",
    ),
    "instance of an instance": (
        SENSOR
        + '<shape type="shapegroup" id="g"><shape type="cube"/></shape>'
        + '<shape type="shapegroup" id="h"><shape type="instance"><ref id="g"/></shape></shape>'
        + '<shape type="instance"><ref id="h"/></shape>',
        "instances within instances",
    ),
    "instance of a shape": (SENSOR + '<shape type="instance"><shape type="cube"/></shape>', "shapegroup"),
    "light in a group": (
        SENSOR
        + '<shape type="shapegroup" id="g"><shape type="cube"><emitter type="area"/></shape></shape>'
        + '<shape type="instance"><ref id="g"/></shape>',
        "emitters",
    ),
    "some faces without uv": (
        SENSOR
        + '<shape type="obj" id="part"><string name="filename" value="part.obj"/>'
        + MATERIAL.format("")
        + "</shape>",
        "part.obj, line 9: .*part",
    ),
    "unknown filter": (
        SENSOR
        + f'<shape type="rectangle">{MATERIAL.format("<string name=%s value=%s/>")}</shape>'
        % ('"filter_type"', '"cubic"'),
        "cubic",
    ),
    "singular texture transform": (
        SENSOR
        + '<shape type="rectangle">'
        + MATERIAL.format('<transform name="to_uv"><scale x="0"/></transform>')
        + "</shape>",
        "singular",
    ),
    "missing BTF": (
        SENSOR
        + '<shape type="rectangle"><bsdf type="btf"><string name="filename" value="no.exr"/></bsdf></shape>',
        "no.exr",
    ),
    "no BTF": (SENSOR + '<shape type="rectangle"><bsdf type="btf"/></shape>', "filename"),
    "cropped film": (
        SENSOR.replace(
            "</sensor>", '<film type="hdrfilm"><integer name="crop_width" value="9"/></film></sensor>'
        ),
        "crop_width",
    ),
    "no uv": (
        SENSOR
        + '<shape type="ply" id="bare"><string name="filename" value="bare.ply"/>'
        + MATERIAL.format("")
        + "</shape>",
        "bare",
    ),
    "unknown shape": (SENSOR + '<shape type="sdfgrid"/>', "sdfgrid|failed"),
    "unknown parameter": (SENSOR + '<shape type="$nothing"/>', "nothing"),
    "missing include": ('<include filename="lights_$btf.xml"/>', "not found"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_scenes_are_one_line(mi, write, tmp_path, name):
    body, reason = BAD[name]
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "bare.ply").write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    vertices = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
    (tmp_path / "part.obj").write_text(vertices + "f 1/1 2/2 3/3\nf 1/1 3/3 4 # 1/1\n")
    path = write(body)
    with pytest.raises(InputError, match=reason) as caught:
        read_scene(path)
    assert "\n" not in str(caught.value)
    assert "scene.xml" in str(caught.value)


def test_missing_file_unused_parameter_and_finished_object(mi, write, tmp_path):
    with pytest.raises(InputError, match="no such scene"):
        read_scene(tmp_path / "none.xml")
    with pytest.raises(InputError, match=r"no such parameter.*unused"):
        read_scene(write(SENSOR), {"unused": "1"})
    with pytest.raises(InputError, match="finished"):
        read_scene({"type": "scene", "c": camera(mi), "s": mi.load_dict({"type": "sphere"})})


def test_variant_stays(mi):
    for variant in ("scalar_rgb", "scalar_spectral"):
        mi.set_variant(variant)
        sensor, light = camera(mi), {"type": "directional", "irradiance": 2.0}
        found = read_scene({"type": "scene", "c": sensor, "l": light})
        assert mi.variant() == variant
        np.testing.assert_allclose(found.lights[0].power, 2)


def test_neighbours_of_a_closed_mesh_are_mutual(mi):
    mesh = read_scene({"type": "scene", "c": camera(mi), "s": {"type": "cube"}}).meshes[0]
    across = neighbours(mesh.positions, mesh.faces)
    assert (across >= 0).all()
    for k in range(3):
        assert (across[across[:, k]] == np.arange(len(across))[:, None]).any(1).all()
    # An open sheet of two triangles: only the diagonal is shared.
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    assert neighbours(square, np.array([[0, 1, 2], [0, 2, 3]])).tolist() == [[-1, 1, -1], [-1, -1, 0]]


def test_rotation_of_a_scaled_texture_is_none():
    assert BtfMaterial("", None, 1.0, np.array([[4.0, 0, 0], [0, 4, 0]]), False).turn == Turn()


@pytest.mark.parametrize("name", sorted(meshes.SURFACES))
def test_shipped_meshes_are_what_the_script_writes(name, tmp_path):
    from importlib.resources import files

    meshes.write(tmp_path)
    assert (tmp_path / f"{name}.ply").read_bytes() == files("btfref.scene.shipped").joinpath(
        f"{name}.ply"
    ).read_bytes()
    positions, normals, uv, faces = meshes.surface_mesh(name)
    p = positions[faces]
    geometric = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (np.einsum("mx,mkx->mk", geometric, normals[faces]) > 0).all()
    d0, d1 = uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]
    # Every triangle has texture coordinates of the same orientation: no mirrored or degenerate ones.
    assert (d0[:, 0] * d1[:, 1] - d0[:, 1] * d1[:, 0] > 0).all()
