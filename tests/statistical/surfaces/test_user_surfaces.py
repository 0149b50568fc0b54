"""Surfaces of users' files, synthesized, against plain Mitsuba renders whose materials are written out by hand."""

import numpy as np
import pytest
from gltf_files import FACES, SQUARE, UV, gltf
from PIL import Image
from plain_renders import PlainRenders

from btfref.comparison.significance import difference_test, welch_test
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import Mesostructure, Part, build
from btfref.sampling.synthesis import synthesize

pytestmark = pytest.mark.usefixtures("llvm")

#: Views and lights; polar angles to 60 degrees.
VECTORS = np.array([[0, 0, 1], [0.5, -0.3, 0.8124], [-0.6, 0.62, 0.5059]])
PAIRS = [(0, 1), (1, 2), (2, 1)]


def _waves(n, k=1, shift=0.0):
    x = (np.arange(n) + 0.5) / n
    return 0.5 + 0.2 * (np.sin(2 * np.pi * (k * x + shift))[None] + np.cos(2 * np.pi * k * x)[:, None])


def _save(path, values):
    Image.fromarray(np.round(values * 255).astype(np.uint8)).save(path)
    return str(path)


def _bitmap(mi, path, uv, **more):
    return {"type": "bitmap", "filename": str(path), "to_uv": mi.ScalarTransform4f(uv), **more}


def _equal(mi, file, plain, *, estimator, spp, rounds=8, texels=8, depth=4, integrator="path", **settings):
    """p of every texel, channel and pair; and with the lights exchanged."""
    btf = synthesize(
        file, texels=texels, views=VECTORS, lights=VECTORS, spp=spp, dtype="float32", max_depth=depth,
        estimator=estimator, seed=5, **settings,
    )  # fmt: skip
    assert btf.attributes["estimator"] == estimator
    renders = PlainRenders(mi, plain, texels=texels, reach=3, max_depth=depth)
    renders.integrator = mi.load_dict({"type": integrator, "max_depth": depth})
    images = [renders.pair(VECTORS[v], VECTORS[k], spp=spp, rounds=rounds, seed=31 * v + k) for v, k in PAIRS]
    mean, variance = (np.stack(part) for part in zip(*images, strict=True))
    floor = (tolerance("synthesis.flat_eval") * mean.max()) ** 2

    def p(pairs):
        own = [np.stack([array[v, k] for v, k in pairs]) for array in (btf.values, btf.variance)]
        return welch_test(own[0], own[1] + floor, mean, variance, n_b=rounds)[1]

    return p(PAIRS), p([(v, 3 - k if k else 1) for v, k in PAIRS])


def _assert_equal(found):
    p, other = found
    level = tolerance("synthesis.z.significance")
    assert difference_test(p, significance=level).rejected == 0, f"least p {p.min():.3g} of {p.size}"
    seen = difference_test(other, significance=level).rejected_fraction
    assert seen > tolerance("synthesis.seen.min_rejected")


@pytest.mark.parametrize("estimator", ["path", pytest.param("surface", marks=pytest.mark.long)])
@pytest.mark.parametrize("spp", [128, pytest.param(1024, marks=pytest.mark.long)])
def test_a_folder_of_maps(tmp_path, llvm, estimator, spp):
    folder = tmp_path / "Rock"
    folder.mkdir()
    colour = _save(folder / "Rock_Color.png", np.stack([_waves(16, 1, s) for s in (0, 0.3, 0.7)], -1))
    rough = _save(folder / "Rock_Roughness.png", _waves(16, 2))
    metal = _save(folder / "Rock_Metalness.png", 0.5 * _waves(16, 1, 0.5))
    _save(folder / "Rock_Displacement.png", _waves(16, 2))
    (part,) = build(folder, amplitude=0.15).parts
    up = np.diag([1.0, -1, 1, 1])  # the picture's first row is at v = 1
    raw = {"raw": True, "format": "variant"}
    material = {
        "type": "principled",
        "base_color": _bitmap(llvm, colour, up, format="variant"),
        "roughness": _bitmap(llvm, rough, up, **raw),
        "metallic": _bitmap(llvm, metal, up, **raw),
        "specular": 0.5,
    }
    plain = Mesostructure("plain", {}, (Part(part.vertices, part.faces, material, normals=part.normals),))
    _assert_equal(_equal(llvm, folder, plain, estimator=estimator, spp=spp, amplitude=0.15))


@pytest.mark.parametrize("estimator", ["path", "surface"])
@pytest.mark.parametrize("spp", [128, pytest.param(1024, marks=pytest.mark.long)])
def test_a_glb_with_a_transform_a_second_set_and_a_normal_map(tmp_path, llvm, estimator, spp):
    """All textures on the second set, two of them moved: one BSDF of Mitsuba can show it, written by hand."""
    colour = np.stack([_waves(16, 1, s) for s in (0, 0.3, 0.7)], -1)
    normal = np.stack(
        [0.5 + 0.6 * (_waves(16, 1) - 0.5), 0.5 + 0.6 * (_waves(16, 1, 0.25) - 0.5), 0 * _waves(16) + 0.9], -1
    )
    second = UV * [1, 1] + [0.25, 0.125]
    move = {"offset": [0.5, 0], "rotation": np.pi / 2, "scale": [2, 1]}
    material = {
        "pbrMetallicRoughness": {
            "metallicFactor": 0.25,
            "roughnessFactor": 0.5,
            "baseColorTexture": {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": move}},
        },
        "normalTexture": {"index": 1, "texCoord": 1},
    }
    codes = [np.round(image * 255) for image in (colour, normal)]
    file = gltf(tmp_path / "m.glb", material, codes, sets=(0 * UV, second))
    _save(tmp_path / "c.png", colour)
    _save(tmp_path / "n.png", normal)
    # From x and y of the tile: v of glTF is 1 − y; then the second set, then the transform.
    base = np.array([[1, 0, 0, 0.25], [0, -1, 0, 1.125], [0, 0, 1, 0], [0, 0, 0, 1]], float)
    turned = np.array([[0, 1, 0, 0.5], [-2, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], float) @ base
    bsdf = {
        "type": "normalmap",
        "use_shadowing_function": False,
        "normalmap": _bitmap(llvm, tmp_path / "n.png", base, raw=True, format="variant"),
        "b": {
            "type": "principled",
            "base_color": _bitmap(llvm, tmp_path / "c.png", turned, format="variant"),
            "roughness": 0.5,
            "metallic": 0.25,
            "specular": 0.5,
        },
    }
    part = build("flat").parts[0]
    plain = Mesostructure("plain", {}, (Part(part.vertices, part.faces, bsdf, normals=part.normals),))
    _assert_equal(_equal(llvm, file, plain, estimator=estimator, spp=spp))


@pytest.mark.long
@pytest.mark.parametrize("spp", [128, 1024])
def test_a_sheet_that_blends_over_a_floor(tmp_path, llvm, spp):
    """Shadows of what is half there: Mitsuba's volpath, whose shadow rays pass masks as well."""
    colour = np.stack([_waves(16, 1, s) for s in (0, 0.3, 0.7)], -1)
    alpha = _waves(16, 2, 0.1)
    alpha[0, 0] = 1  # the floor is there
    material = {
        "pbrMetallicRoughness": {
            "metallicFactor": 0,
            "roughnessFactor": 0.6,
            "baseColorTexture": {"index": 0},
        },
        "alphaMode": "BLEND",
    }
    vertices = np.concatenate([SQUARE, SQUARE - [0, 0, 0.2]])
    faces, uv = np.concatenate([FACES, FACES + 4]), np.concatenate([UV, 0 * UV + 1 / 32])
    codes = np.round(np.concatenate([colour, alpha[..., None]], -1) * 255)
    file = gltf(tmp_path / "m.glb", material, [codes], vertices=vertices, faces=faces, sets=(uv,))
    _save(tmp_path / "c.png", colour)
    _save(tmp_path / "a.png", alpha)
    inner = {
        "type": "principled",
        "base_color": {"type": "bitmap", "filename": str(tmp_path / "c.png"), "format": "variant"},
        "roughness": 0.6,
        "specular": 0.5,
    }
    bsdf = {
        "type": "mask",
        "opacity": {"type": "bitmap", "filename": str(tmp_path / "a.png"), "raw": True, "format": "variant"},
        "b": {"type": "twosided", "b": inner},
    }
    plain = Mesostructure("plain", {}, (Part(vertices, faces, bsdf, uv=uv),))
    _assert_equal(_equal(llvm, file, plain, estimator="path", spp=spp, depth=-1, integrator="volpath"))
