"""Meshes of glTF files: textures, opacity and colours where the standard puts them; the rest is named or refused."""

import json

import numpy as np
import pytest
from gltf_files import FACES, SQUARE, UV, gltf

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.mesostructure.tiling import tiled_shapes

NEAREST = {"magFilter": 9728}
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648

#: Places on the square, off all borders of texels.
XY = np.random.default_rng(1).integers(0, 64, (200, 2)) / 64 + 1 / 128 + 1e-3


def _image(n=8, channels=3):
    """Codes without any symmetry."""
    row, column = np.mgrid[0:n, 0:n]
    planes = [30 + 25 * row, 30 + 25 * column, 60 + 0 * row, (37 * row + 91 * column) % 256]
    return np.stack(planes[:channels], -1).astype(np.uint8)


def _linear(codes):
    c = codes / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _hits(mi, parts, xy=XY):
    """Surface interactions on the tile from above."""
    tile = type("Tile", (), {"parts": parts, "name": "t"})
    scene = mi.load_dict({"type": "scene", **tiled_shapes(tile, [0], [0])})
    xy = np.asarray(xy, np.float32)
    return scene, scene.ray_intersect(
        mi.Ray3f(mi.Point3f(xy[:, 0], xy[:, 1], np.ones(len(xy), np.float32)), mi.Vector3f(0, 0, -1))
    )


def _colours(mi, file, **settings):
    _, si = _hits(mi, build(file, **settings).parts)
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).T


def _base(**info):
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **info}, "metallicFactor": 0}}


def _transformed(offset=(0, 0), rotation=0, scale=(1, 1), **more):
    return {
        "extensions": {
            "KHR_texture_transform": {"offset": offset, "rotation": rotation, "scale": scale, **more}
        }
    }


def _wrapped(index, n, mode):
    if mode == CLAMP:
        return np.clip(index, 0, n - 1)
    index = index % (2 * n) if mode == MIRROR else index % n
    return np.where(index < n, index, 2 * n - 1 - index)


def _expected(uv, wraps=(REPEAT, REPEAT), image=None):
    """Nearest texels of the image, linear."""
    image = _image() if image is None else image
    column, row = (_wrapped(np.floor(uv[:, k] * 8).astype(int), 8, wraps[k]) for k in (0, 1))
    return _linear(image[row, column])


PLACES = np.stack([XY[:, 0], 1 - XY[:, 1]], 1)


@pytest.mark.parametrize(
    ("info", "matrix", "offset"),
    [
        (_transformed(offset=(0.5, 0)), np.eye(2), (0.5, 0)),
        # The extension's own example: the lower left quarter of the image.
        (_transformed((0, 1), np.pi / 2, (0.5, 0.5)), [[0, 0.5], [-0.5, 0]], (0, 1)),
        (_transformed((0.125, 0.25), 0, (2, -1)), [[2, 0], [0, -1]], (0.125, 0.25)),
    ],
)
def test_texture_transforms(tmp_path, llvm, info, matrix, offset):
    file = gltf(tmp_path / "m.gltf", _base(**info), [_image()], samplers=[NEAREST])
    uv = PLACES @ np.array(matrix).T + offset
    assert np.abs(_colours(llvm, file) - _expected(uv)).max() <= tolerance("mesostructure.texture")


def test_a_second_set_of_coordinates_and_one_that_a_transform_names(tmp_path, llvm):
    other = UV[:, ::-1] * [1, -1]
    uv = PLACES[:, ::-1] * [1, -1]
    for info in ({"texCoord": 1}, _transformed(texCoord=1)):
        file = gltf(tmp_path / "m.glb", _base(**info), [_image()], sets=(UV, other), samplers=[NEAREST])
        assert np.abs(_colours(llvm, file) - _expected(uv)).max() <= tolerance("mesostructure.texture")
    with pytest.raises(InputError, match=r"texture without coordinates.*baseColorTexture.*TEXCOORD_1"):
        build(gltf(tmp_path / "m.glb", _base(texCoord=1), [_image()]))


def test_textures_of_one_material_on_two_sets(tmp_path, llvm):
    """The normal map on one, colours on the other, moved: what a BSDF of Mitsuba cannot do by itself."""
    other = UV[:, ::-1] * [1, -1]
    material = _base(texCoord=1, **_transformed((0.125, 0), 0, (3, 1)))
    material["normalTexture"] = {"index": 1}
    up = np.full((2, 2, 3), (128, 128, 255), np.uint8)
    file = gltf(tmp_path / "m.glb", material, [_image(), up], sets=(UV, other), samplers=[NEAREST])
    uv = PLACES[:, ::-1] * [1, -1] * [3, 1] + [0.125, 0]
    assert np.abs(_colours(llvm, file) - _expected(uv)).max() <= tolerance("mesostructure.texture")


@pytest.mark.parametrize("wraps", [(CLAMP, CLAMP), (MIRROR, MIRROR), (REPEAT, CLAMP), (MIRROR, REPEAT)])
def test_wrap_modes(tmp_path, llvm, wraps):
    sampler = NEAREST | {"wrapS": wraps[0], "wrapT": wraps[1]}
    file = gltf(
        tmp_path / "m.gltf", _base(**_transformed((-1.25, -0.5), 0, (4, 2))), [_image()], samplers=[sampler]
    )
    uv = PLACES * [4, 2] + [-1.25, -0.5]
    assert np.abs(_colours(llvm, file) - _expected(uv, wraps)).max() <= tolerance("mesostructure.texture")


def test_colours_of_vertices_multiply(tmp_path, llvm):
    colours = np.array([[1, 0, 0.5, 1], [0, 1, 0.5, 1], [1, 0.5, 0, 1], [0.25, 1, 1, 1]])
    u, v = XY.T  # the square is cut along its diagonal
    low = (1 - u)[:, None] * colours[0] + (u - v)[:, None] * colours[1] + v[:, None] * colours[2]
    high = (1 - v)[:, None] * colours[0] + u[:, None] * colours[2] + (v - u)[:, None] * colours[3]
    vertex = np.where((u >= v)[:, None], low, high)[:, :3]
    textured = gltf(tmp_path / "m.glb", _base(), [_image()], samplers=[NEAREST], COLOR_0=colours)
    assert np.abs(_colours(llvm, textured) - vertex * _expected(PLACES)).max() <= tolerance(
        "mesostructure.texture"
    )
    plain = {"pbrMetallicRoughness": {"metallicFactor": 0, "baseColorFactor": [0.5, 1, 0.25, 1]}}
    file = gltf(tmp_path / "m.gltf", plain, COLOR_0=colours[:, :3])
    assert np.abs(_colours(llvm, file) - vertex * [0.5, 1, 0.25]).max() <= tolerance("mesostructure.texture")


def test_alpha_modes(tmp_path, llvm):
    image = _image(channels=4)
    alpha = image[np.floor(PLACES[:, 1] * 8).astype(int), np.floor(PLACES[:, 0] * 8).astype(int), 3] / 255
    expected = {"OPAQUE": 1 + 0 * alpha, "MASK": (alpha * 0.9 >= 0.3) * 1.0, "BLEND": alpha * 0.9}
    for mode, opacity in expected.items():
        material = _base() | {"alphaMode": mode, "alphaCutoff": 0.3}
        material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.9]
        file = gltf(tmp_path / f"{mode}.gltf", material, [image], samplers=[NEAREST])
        _, si = _hits(llvm, build(file).parts)
        through = np.array(si.bsdf().eval_null_transmission(si)).T
        assert np.abs(1 - opacity[:, None] - through).max() <= tolerance("mesostructure.texture")


def test_a_mask_lets_light_through_to_what_lies_below(tmp_path, llvm):
    """Half a sheet of holes over a white floor: the light falls through, straight."""
    import btfref

    sheet = np.full((2, 2, 4), 255, np.uint8)
    sheet[:, 0, 3] = 0
    material = _base() | {"alphaMode": "MASK"}
    low = SQUARE - [0, 0, 0.25]
    file = gltf(
        tmp_path / "m.glb", material, [sheet], samplers=[NEAREST],
        vertices=np.concatenate([SQUARE, low]), faces=np.concatenate([FACES, FACES + 4]),
        sets=(np.concatenate([UV, 0 * UV + [0.75, 0.5]]),),
    )  # fmt: skip
    lights = np.array([[np.sin(0.7), 0, np.cos(0.7)], [0, 0, 1], [0, 0.6, 0.8]])
    settings = {"views": lights[1:2], "lights": lights, "spp": 4, "dtype": "float32", "texels": (1, 32)}
    values = btfref.synthesize(file, max_depth=3, estimator="surface", **settings)
    assert "mask" in values.attributes["fallback"]
    seen = values.values[0, 0, 0, :16, 0]  # the floor, through the holes
    # The light's way from x goes through the sheet at x + tan θ / 4.
    x = (np.arange(16) + 0.5) / 32 + 0.25 * np.tan(0.7)
    lit, dark = x < 0.5 - 1 / 64, x > 0.5 + 1 / 64
    assert (seen[lit] > 0).all()
    assert (seen[dark] == 0).all()
    assert min(lit.sum(), dark.sum()) > 3


def test_a_normal_map_turns_x_right_and_y_up_in_the_picture(tmp_path, llvm):
    normal = np.array([0.4, 0.2, 0.8])
    normal /= np.linalg.norm(normal)
    codes = np.round((normal + 1) / 2 * 255)
    image = np.full((2, 2, 3), codes, np.uint8)
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        "normalTexture": {"index": 0, "scale": 0.5},
    }
    turned = (codes / 255 * 2 - 1) * [0.5, 0.5, 1]
    turned /= np.linalg.norm(turned)
    light = np.array([0.5, -0.3, 0.8]) / np.linalg.norm([0.5, -0.3, 0.8])
    mirrored = UV * [-1, 1]
    for uv, sign in ((UV, 1), (mirrored, -1)):
        _, si = _hits(llvm, build(gltf(tmp_path / "m.glb", material, [image], sets=(uv,))).parts)
        value = np.array(si.bsdf().eval(llvm.BSDFContext(), si, si.to_local(llvm.Vector3f(*light.tolist()))))
        flat = llvm.load_dict({"type": "principled", "base_color": 1.0, "roughness": 1.0})
        other = llvm.SurfaceInteraction3f()
        n = turned * [sign, 1, 1]
        frame = llvm.Frame3f(llvm.Normal3f(*n.tolist()))
        other.wi = frame.to_local(llvm.Vector3f(0, 0, 1))
        expected = np.array(
            flat.eval(llvm.BSDFContext(), other, frame.to_local(llvm.Vector3f(*light.tolist())))
        )
        assert np.abs(value - expected).max() <= tolerance("mesostructure.texture")
        assert expected.min() > 0


def test_nodes_turn_move_and_mirror(tmp_path):
    """A mirrored node keeps the outside of its mesh outside."""
    up = np.tile([0, 0, 1.0], (4, 1))
    node = {"scale": [-2, 2, 2], "translation": [2, 5, 0]}
    (part,) = build(gltf(tmp_path / "m.glb", {}, node=node, NORMAL=up), tile=(0, 0, 2, 2)).parts
    corners = part.vertices[part.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()
    assert np.abs(part.normals - up).max() <= tolerance("mesostructure.units")
    assert np.abs(part.vertices - SQUARE[[1, 0, 3, 2]]).max() <= tolerance("mesostructure.units")


def test_several_materials_and_what_is_packed_in_their_textures(tmp_path, llvm):
    """Two halves: the second node stands in the first, whose scale it shares."""
    packed = {
        "roughnessFactor": 0.5,
        "metallicFactor": 0.25,
        "metallicRoughnessTexture": {"index": 0},
        "baseColorFactor": [1, 0, 0, 1],
    }
    plain = {"baseColorFactor": [0, 0, 1, 1], "metallicFactor": 0}
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    primitives = [{"attributes": attributes, "indices": 2, "material": k} for k in (0, 1)]
    top = {
        "materials": [{"pbrMetallicRoughness": facts} for facts in (packed, plain)],
        "meshes": [{"primitives": [one]} for one in primitives],
        "nodes": [
            {"mesh": 0, "scale": [0.5, 1, 1], "children": [1]},
            {"mesh": 1, "translation": [1, 0, 0]},
        ],
    }
    parts = build(gltf(tmp_path / "m.glb", {}, [_image()], top=top)).parts
    for name, channel, factor in (("roughness", 1, 0.5), ("metallic", 2, 0.25)):
        expected = _image()[..., channel : channel + 1] / 255 * factor
        assert np.abs(parts[0].textures[name] - expected).max() <= tolerance("mesostructure.texture")
    assert parts[1].bsdf["bsdf"]["roughness"] == 1
    _, si = _hits(llvm, parts)
    blue = np.array(si.bsdf().eval_diffuse_reflectance(si)).T[:, 2]
    right = XY[:, 0] > 0.5
    assert np.array_equal(blue, right.astype(float))


def test_colours_are_no_normal_map(tmp_path):
    material = _base() | {"normalTexture": {"index": 0}, "name": "stone"}
    with pytest.raises(InputError, match=r"no normal map.*'stone: normalTexture'.*1 of the texels"):
        build(gltf(tmp_path / "m.gltf", material, [_image()]))


@pytest.mark.parametrize(
    ("material", "top", "message"),
    [
        ({"emissiveFactor": [0, 1, 0], "name": "lamp"}, {}, "emits light.*'lamp'.*emissiveFactor"),
        ({}, {"extensionsRequired": ["KHR_draco_mesh_compression"]}, "needs an extension.*draco"),
        ({"pbrMetallicRoughness": {"roughnessFactor": 3}}, {}, "roughnessFactor.*got 3"),
        (
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 7}}},
            {},
            r"index out of range.*textures\[7\]",
        ),
        ({"alphaMode": "CUT"}, {}, "alpha mode.*got CUT"),
        ({}, {"accessors": []}, "index out of range.*accessors"),
        ({}, {"nodes": [{"children": [0]}]}, "nodes inside themselves"),
        ({}, {"asset": {"version": "1.0"}}, "version of glTF"),
    ],
)
def test_what_cannot_be_is_one_line_with_its_name(tmp_path, material, top, message):
    with pytest.raises(InputError, match=message) as error:
        build(gltf(tmp_path / "m.gltf", material, top=top))
    assert "\n" not in str(error.value)


def test_what_is_ignored_is_named_once_and_stands_in_the_store(tmp_path, llvm, capsys):
    from btfref.sampling import open_store

    material = _base() | {"occlusionTexture": {"index": 0}, "name": "stone"}
    material["normalTexture"] = {"index": 1}
    top = {"extensionsUsed": ["KHR_materials_clearcoat"], "animations": [{}]}
    tangents = np.tile([1, 0, 0, 1], (4, 1))
    up = np.full((2, 2, 3), (128, 128, 255), np.uint8)
    file = gltf(tmp_path / "m.glb", material, [_image(), up], top=top, TANGENT=tangents)
    out = tmp_path / "m.btf.zarr"
    small = ["--texels", "2", "--views", "1x3", "--lights", "1x3", "--spp", "2"]
    assert main(["synth", str(file), "-o", str(out), *small]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"estimator: {open_store(out).attributes['estimator']}\n")
    lines = said.err.splitlines()
    warnings = [line for line in lines if "ignored" in line]
    words = ["clearcoat", "animations", "tangents", "occlusion"]
    assert [word for line in warnings for word in words if word in line] == words
    assert len(warnings) == 4
    assert "(stone)" in warnings[-1]
    assert [f"btfref: warning: ignored: {line}" for line in open_store(out).attributes["ignored"]] == warnings
    assert main(["synth", str(file), "-o", str(out), "--json", *small]) == 0
    assert json.loads(capsys.readouterr().out)["attributes"]["ignored"]
