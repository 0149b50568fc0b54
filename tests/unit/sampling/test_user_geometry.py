"""Meshes and height maps of a user: geometry, textures and materials as meant, and seams reported."""

import json

import numpy as np
import pytest
from PIL import Image
from user_files import FACES, SQUARE, grid, texture, write_obj

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.mesostructure.materials import bsdf_from_xml, load_bsdf
from btfref.mesostructure.seams import mesh_seams, open_edges


def _waves(n, periods=(1, 1)):
    """Heights in [0, 1] at pixel centres."""
    x = (np.arange(n) + 0.5) / n
    return 0.5 + 0.25 * (
        np.sin(2 * np.pi * periods[0] * x)[None] + np.cos(2 * np.pi * periods[1] * x)[:, None]
    )


def _png16(path, values):
    Image.fromarray(np.round(values * 65535).astype(np.uint16)).save(path)
    return str(path)


def _exr(path, values):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": values.astype(np.float32)}) as file:
        file.write(str(path))
    return str(path)


# --- height maps


def test_heights_pass_through_the_pixels_and_close_bit_for_bit(tmp_path):
    heights = _waves(16)[:, :12]
    heights = np.concatenate([heights, heights[:, ::-1]], 1)  # 16 x 24, periodic along u
    tile = build(_png16(tmp_path / "h.png", heights), amplitude=0.2)
    (part,) = tile.parts
    stored = np.round(heights * 65535) / 65535
    # A texel of the map is at the centre of its pixel.
    place = {(round(x * 24 - 0.5), round(y * 16 - 0.5)): z for x, y, z in part.vertices}
    z = np.array([[place[column, row] for column in range(24)] for row in range(16)])
    assert np.array_equal(z, 0.2 * (stored - stored.max()))
    # What lies beyond the last pixel is the first one of the next tile, to the last bit, normals as well.
    grid, normals = part.vertices.reshape(17, 25, 3), part.normals.reshape(17, 25, 3)
    assert np.array_equal(grid[-1, :, 2], grid[0, :, 2])
    assert np.array_equal(grid[:, -1, 2], grid[:, 0, 2])
    assert np.array_equal(normals[:, -1], normals[:, 0])
    assert np.array_equal(normals[-1], normals[0])
    assert not mesh_seams(part.vertices, part.faces)
    assert tile.overhang == pytest.approx(0.5 / 16)


def test_an_exr_holds_heights_as_they_are(tmp_path):
    heights = 3 * _waves(16) - 7
    low, high = build(_exr(tmp_path / "h.exr", heights), amplitude=0.1).height
    assert high == 0
    assert low == pytest.approx(0.1 * (heights.min() - heights.max()), rel=tolerance("metric.float32.rtol"))


def test_a_height_map_with_a_seam_is_refused(tmp_path):
    ramp = _waves(32) + np.linspace(0, 0.4, 32)
    file = _png16(tmp_path / "h.png", ramp / ramp.max())
    with pytest.raises(InputError, match=r"columns 0 and 31 differ by up to 0\.\d+ \(at row \d+") as error:
        build(file)
    assert "rows 0" not in str(error.value)
    assert "\n" not in str(error.value)
    assert build(file, allow_seams=True).parameters["allow_seams"]
    turned = _png16(tmp_path / "turned.png", ramp.T / ramp.max())
    with pytest.raises(InputError, match="rows 0 and 31 differ"):
        build(turned)


def test_a_periodic_map_with_steps_is_taken(tmp_path):
    """Bricks: steps inside are as high as anything at the border, also when the border is a joint."""
    bricks = np.ones((24, 24))
    bricks[::8] = 0
    bricks[:, ::8] = 0
    for shift in (0, 3, 23):
        assert build(_png16(tmp_path / f"{shift}.png", np.roll(bricks, shift, (0, 1)))).parts


def test_albedo_and_roughness_maps_reach_the_material(tmp_path, llvm):
    height = _png16(tmp_path / "h.png", _waves(8))
    Image.fromarray(texture()).save(tmp_path / "a.png")
    rough = np.linspace(0.2, 0.9, 64).reshape(8, 8)
    settings = {"albedo": str(tmp_path / "a.png"), "roughness": _exr(tmp_path / "r.exr", rough)}
    with pytest.raises(InputError, match="does not tile: roughness"):
        build(height, **settings | {"albedo": [0.5, 0.5, 0.5]})
    (part,) = build(height, allow_seams=True, **settings).parts
    assert part.bsdf["type"] == "principled"
    lambert = build(height, allow_seams=True, albedo=settings["albedo"]).parts[0]
    mi = llvm
    si = mi.SurfaceInteraction3f()
    column, row = np.meshgrid(np.arange(8), np.arange(8))
    si.uv = mi.Point2f(((column + 0.5) / 8).ravel(), ((row + 0.5) / 8).ravel())
    got = np.array(load_bsdf(lambert).eval_diffuse_reflectance(si)).T.reshape(8, 8, 3)
    encoded = texture() / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    assert np.abs(got - linear).max() <= tolerance("mesostructure.texture")


# --- meshes


def _colours(mi, part, xy):
    """Diffuse reflectance of a part at places of the plane z = 0, by way of a Mitsuba scene."""
    from btfref.mesostructure.tiling import tiled_shapes

    mesostructure = type("Tile", (), {"parts": (part,), "name": "t"})
    scene = mi.load_dict({"type": "scene", **tiled_shapes(mesostructure, [0], [0])})
    xy = np.asarray(xy, np.float32)
    ray = mi.Ray3f(mi.Point3f(xy[:, 0], xy[:, 1], np.ones(len(xy), np.float32)), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).T


CENTRES = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) / 8


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_textures_of_obj_and_glb_lie_where_mitsuba_and_gltf_put_them(tmp_path, llvm, suffix):
    """Image row 0 is at v = 1 of an OBJ file, whose v points up; a GLB made of it shows the same."""
    import trimesh

    file = write_obj(tmp_path)
    settings = {"up": "z"}
    if suffix == ".glb":
        scene = trimesh.load_scene(file, process=False)
        (geometry,) = scene.geometry.values()
        image = Image.fromarray(texture())
        geometry.visual.material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.5
        )
        file = tmp_path / "m.glb"
        scene.export(file)
        vertices = SQUARE @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        lying = write_obj(tmp_path, "lying.obj", vertices=vertices, uv=SQUARE[:, :2])
        assert build(lying, up="y").parts[0].vertices == pytest.approx(
            build(tmp_path / "m.obj").parts[0].vertices
        )
    (part,) = build(file, **settings).parts
    encoded = texture()[::-1].reshape(-1, 3) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    got = _colours(llvm, part, CENTRES)
    if suffix == ".obj":
        own = llvm.load_dict(
            {
                "type": "scene",
                "m": {
                    "type": "obj",
                    "filename": str(file),
                    "bsdf": {
                        "type": "diffuse",
                        "reflectance": {"type": "bitmap", "filename": str(tmp_path / "t.png")},
                    },
                },
            }
        )
        ray = llvm.Ray3f(llvm.Point3f(*CENTRES.T.astype(np.float32), 1.0), llvm.Vector3f(0, 0, -1))
        si = own.ray_intersect(ray)
        assert np.abs(np.array(si.bsdf().eval_diffuse_reflectance(si)).T - got).max() <= tolerance(
            "mesostructure.texture"
        )
    assert np.abs(got - linear).max() <= tolerance("mesostructure.texture")


def test_factors_multiply_textures(tmp_path, llvm):
    one = _colours(llvm, build(write_obj(tmp_path)).parts[0], CENTRES)
    scaled = _colours(llvm, build(write_obj(tmp_path, kd="0.5 0.25 1")).parts[0], CENTRES)
    assert np.abs(scaled - one * [0.5, 0.25, 1]).max() <= tolerance("mesostructure.texture")


XML = """<scene version="3.0.0"><bsdf type="twosided"><bsdf type="principled">
<texture type="bitmap" name="base_color"><string name="filename" value="maps/t.png"/>
<string name="filter_type" value="nearest"/><transform name="to_uv"><scale x="2" y="1"/></transform></texture>
<float name="roughness" value="0.3"/></bsdf></bsdf></scene>"""


def test_a_material_from_xml_is_mitsubas_own(tmp_path, llvm):
    (tmp_path / "maps").mkdir()
    Image.fromarray(texture()).save(tmp_path / "maps" / "t.png")
    (tmp_path / "b.xml").write_text(XML)
    file = write_obj(tmp_path)
    (part,) = build(file, bsdf=str(tmp_path / "b.xml")).parts
    json.dumps(part.bsdf)
    rng = np.random.default_rng(0)
    w = np.abs(rng.normal(size=(2, 64, 3)))
    w = (w / np.linalg.norm(w, axis=-1, keepdims=True)).astype(np.float32)
    si = llvm.SurfaceInteraction3f()
    si.uv, si.wi = llvm.Point2f(*CENTRES.T.astype(np.float32)), llvm.Vector3f(w[0].T)
    reference = llvm.load_dict(
        {"type": "twosided", "b": {"type": "principled", "roughness": 0.3, "base_color": {
            "type": "bitmap", "filename": str(tmp_path / "maps" / "t.png"), "filter_type": "nearest",
            "to_uv": llvm.ScalarTransform4f().scale([2, 1, 1])}}}
    )  # fmt: skip
    values = [
        np.array(bsdf.eval(llvm.BSDFContext(), si, llvm.Vector3f(w[1].T)))
        for bsdf in (load_bsdf(part), reference)
    ]
    assert np.array_equal(*values)
    assert values[0].std() > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<scene version='3.0.0'/>", "materials in the file"),
        ("<bsdf version='3.0.0' type='diffuse'", "cannot read the material"),
        (XML, "no such file"),
        (None, "no such file"),
    ],
)
def test_a_bad_material_is_one_clear_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "b.xml").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        bsdf_from_xml(tmp_path / "b.xml")
    assert "\n" not in str(error.value)


def test_a_tile_of_a_larger_mesh_in_other_units(tmp_path):
    vertices, faces = grid(8, lambda x, y: 0.1 * np.cos(2 * np.pi * x))
    file = write_obj(tmp_path, vertices=vertices * 40 + [10, -30, 7], faces=faces, uv=vertices[:, :2])
    with pytest.raises(InputError, match=r"bounds in x are 10 … 50 .* `tile`"):
        build(file)
    for tile in ((10, -30, 50, 10), "bounds"):
        got = build(file, tile=tile)
        assert got.parts[0].vertices == pytest.approx(
            vertices - [0, 0, vertices[:, 2].max()], abs=tolerance("mesostructure.units")
        )
    with pytest.raises(InputError, match="a square"):
        build(file, tile=(10, -30, 50, 9))


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_shading_normals_are_those_of_the_file(tmp_path, suffix):
    import trimesh

    vertices, faces = grid(4, lambda x, y: 0.1 * np.cos(2 * np.pi * x))
    normals = np.stack([vertices[:, 1] - 0.5, vertices[:, 0] - 0.5, np.ones(len(vertices))], -1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    file = tmp_path / f"m{suffix}"
    trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False).export(file)
    assert b"vn" in file.read_bytes() or b"nx" in file.read_bytes()
    (tmp_path / "b.xml").write_text('<bsdf version="3.0.0" type="diffuse"/>')
    (part,) = build(file, bsdf=str(tmp_path / "b.xml")).parts
    xy = np.stack([part.normals[:, 1], part.normals[:, 0]], -1) / part.normals[:, 2:] + 0.5
    assert xy == pytest.approx(part.vertices[:, :2], abs=tolerance("mesostructure.units"))


# --- seams of meshes


def test_borders_that_meet_have_no_seam():
    for height in (lambda x, y: 0 * x, lambda x, y: 0.1 * np.sin(2 * np.pi * (x + 2 * y))):
        assert not mesh_seams(*grid(8, height))
    assert not len(open_edges(SQUARE, FACES))
    tissue = build("tissue")
    assert not mesh_seams(tissue.parts[0].vertices, tissue.parts[0].faces)
    # Other triangles on the other side, but the same border.
    vertices, faces = grid(8, lambda x, y: 0 * x)
    vertices[(vertices[:, 0] == 1) & (vertices[:, 1] > 0) & (vertices[:, 1] < 1), 1] += 0.01
    assert len(open_edges(vertices, faces))
    assert not mesh_seams(vertices, faces)


def test_a_gap_is_measured_and_placed():
    vertices, faces = grid(10, lambda x, y: 0.03 * x * np.exp(-8 * np.sin(np.pi * (y - 0.3)) ** 2))
    (seam,) = mesh_seams(vertices, faces)
    assert seam.gap == pytest.approx(0.03, rel=tolerance("mesostructure.gap"))
    assert "x = 0 and x = 1" in seam.what
    assert "y = 0.3" in seam.what


def test_a_hole_is_an_open_border():
    vertices, faces = grid(8, lambda x, y: 0 * x)
    (seam,) = mesh_seams(vertices, faces[np.arange(len(faces)) != 27])
    assert "open borders inside the tile: 3 edges" in seam.what


def test_a_mesh_too_small_for_its_tile_is_reported(tmp_path):
    vertices, faces = grid(8, lambda x, y: 0 * x)
    file = write_obj(tmp_path, vertices=vertices * 0.9, faces=faces, uv=vertices[:, :2])
    with pytest.raises(InputError, match=r"x = 0 and x = 0\.9 are 0\.1 tiles apart"):
        build(file)
    assert build(file, allow_seams=True).parts


# --- command line


def test_the_command_line_takes_files(tmp_path, llvm, capsys):
    height = _png16(tmp_path / "h.png", _waves(8))
    small = ["--texels", "4", "--views", "2x3", "--lights", "2x3", "--spp", "2", "--json"]
    out = tmp_path / "h.btf.zarr"
    options = ["--albedo", "0.7,0.5,0.2", "--roughness", "0.5", "--amplitude", "0.2"]
    assert main(["synth", height, "-o", str(out), *options, *small]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["parent"]["name"] == "height_map"
    assert facts["parent"]["parameters"]["roughness"] == 0.5
    # The same name, but another surface: not continued.
    _png16(tmp_path / "h.png", _waves(8, (1, 2)))
    assert main(["synth", height, "-o", str(out), *options, *small]) == 2
    assert "parent.geometry" in capsys.readouterr().err
    ramp = _png16(tmp_path / "r.png", _waves(32) * np.linspace(0.5, 1, 32))
    other = tmp_path / "r.btf.zarr"
    assert main(["synth", ramp, "-o", str(other), *small]) == 2
    message = capsys.readouterr().err
    assert "does not tile" in message
    assert message.count("\n") == 1
    assert not other.exists()
    assert main(["synth", ramp, "-o", str(other), "--allow-seams", *small]) == 0
    mesh = write_obj(tmp_path)
    (tmp_path / "b.xml").write_text(
        '<bsdf version="3.0.0" type="roughconductor"><float name="alpha" value="0.3"/></bsdf>'
    )
    arguments = ["--bsdf", str(tmp_path / "b.xml"), "--estimator", "surface"]
    assert main(["synth", str(mesh), "-o", str(tmp_path / "m.btf.zarr"), *arguments, *small]) == 0


def test_geometry_truth_of_a_file_that_changed_is_refused(tmp_path, llvm):
    from btfref.rendering.offline.geometry import _built
    from btfref.sampling import open_store
    from btfref.sampling.synthesis import synthesize_store

    file = _png16(tmp_path / "h.png", _waves(8))
    out = tmp_path / "h.btf.zarr"
    synthesize_store(out, file, texels=2, views="1x3", lights="1x3", spp=2)
    parent = open_store(out).attributes["parent"]
    again = _built("h.lpca.exr", parent)
    assert np.array_equal(again.parts[0].vertices, build(file).parts[0].vertices)
    _png16(tmp_path / "h.png", _waves(8, (1, 2)))
    with pytest.raises(InputError, match="has changed"):
        _built("h.lpca.exr", parent)


def test_a_textured_mesh_is_synthesized_alike_by_both_estimators(tmp_path, llvm):
    import btfref

    settings = {"texels": 8, "views": "1x3", "lights": "1x3", "dtype": "float32"}
    file = write_obj(tmp_path)
    path, surface = (
        btfref.synthesize(str(file), spp=64, estimator=name, **settings) for name in ("path", "surface")
    )
    linear = path.values[0, 0]
    assert np.argmax(linear[..., 0].mean(1)) == 0  # row 7 of the image is at v = 0
    assert np.argmax(linear[..., 1].mean(0)) == 7
    assert np.abs(surface.values - path.values).mean() / path.values.mean() <= tolerance(
        "mesostructure.textured"
    )
