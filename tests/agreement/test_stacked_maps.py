"""Stacks of maps in all evaluators: no slice leaks into another, and the four texels around a lookup are blended."""

import dataclasses

import numpy as np
import pytest
from oracle import oracle_btf
from probes import hemisphere

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates.tolerances import tolerance
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.representations import save
from btfref.representations.factored import cmf
from btfref.scene.pixel_classes import pixel_classes
from btfref.stress.evaluators import EVALUATORS

GRID, SIZE = 2, (64, 64)

#: An oblique light, above the last ring of measured ones.
LIGHT = np.array([0.3, -0.4, 0.8])


def fit(btf, **parameters):
    return cmf.fit(btf, map_size=16, half_step=10.0, sweeps=0, **parameters)


def alternating(fitted):
    """Slices of 0 and 1 in turn, every texel on a slice of ones: any leak between slices darkens it."""
    maps = dict(fitted.maps)
    for name in ("factor_p", "factor_q", "factor_r"):
        ones = np.ones_like(maps[name]) * (255 if maps[name].dtype == np.uint8 else 1)
        maps[name] = ones * (np.arange(len(ones)) % 2).astype(ones.dtype)[:, None, None, None]
    maps["index"] = np.minimum(maps["index"] | 1, len(maps["factor_p"]) - 1).astype(np.uint32) | 1
    top = 255 if maps["scale_map"].dtype == np.uint8 else 1
    maps["scale_map"] = np.full_like(maps["scale_map"], top)
    maps["scale_peak"] = np.ones_like(maps["scale_peak"])
    return dataclasses.replace(fitted, maps=maps)


@pytest.mark.parametrize("storage", ["half", "byte"])
def test_no_slice_leaks_into_another(storage, evaluator, rng, tmp_path):
    fitted = alternating(fit(oracle_btf((6, 6)), clusters=8, storage=storage))
    assert len(fitted.maps["factor_p"]) == 8
    w, w_view = hemisphere(rng, 4000), hemisphere(rng, 4000)
    uv = rng.random((4000, 2)).astype(np.float32)
    expected = np.minimum(w[:, 2:] / fitted.meta["constants"]["light_cos_last"], 1) * np.ones(3)
    save(fitted, tmp_path / "a.exr")
    for name in EVALUATORS:
        value = evaluator(name, fitted, tmp_path / "a.exr").evaluate(uv, w, w_view)
        np.testing.assert_allclose(value, expected, atol=tolerance("probe.agreement.p999"))


def as_ones(fitted, colours):
    """Every map of every slice 1, so that the scales alone are seen: B = scale, bilinear over texels."""
    maps = dict(fitted.maps)
    for name in ("factor_p", "factor_q", "factor_r"):
        maps[name] = np.ones_like(maps[name])
    maps["scale_map"] = colours[:, :, None].astype(maps["scale_map"].dtype)
    maps["scale_peak"] = np.ones_like(maps["scale_peak"])
    return dataclasses.replace(fitted, maps=maps)


def plane(mi, bsdf):
    """A textured rectangle that fills the picture, under one directional light of irradiance π."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1]}
    look = t.look_at([0.4, -1.2, 2.0], [0, 0, 0], [0, 0, 1])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "perspective", "fov": 24, "to_world": look, "film": film},
        "plane": {"type": "rectangle", "bsdf": bsdf},
        "sun": {
            "type": "directional",
            "direction": (-LIGHT).tolist(),
            "irradiance": {"type": "rgb", "value": [np.pi] * 3},
        },
    }


def both_pictures(mi, fitted, folder, **parameters):
    """The plane with a representation, by the reference and in real time."""
    save(fitted, folder / "a.cmf.exr")
    scene = plane(mi, {"type": "btf", "filename": str(folder / "a.cmf.exr"), **parameters})
    assert (pixel_classes(scene, grid=GRID) == PixelClass.INTERIOR).all()
    return render(scene, grid=GRID, shadows=False), realtime(scene, grid=GRID, shadows=False)


@pytest.mark.parametrize("storage", ["half", "byte"])
def test_a_picture_shows_no_slice_but_its_own(storage, llvm, need, tmp_path):
    need("gl")
    llvm.set_variant("scalar_rgb")
    fitted = alternating(fit(oracle_btf((6, 6)), clusters=8, storage=storage))
    for picture in both_pictures(llvm, fitted, tmp_path):
        np.testing.assert_allclose(picture.image, np.pi, rtol=tolerance("image.lambert.max"))


def test_a_picture_blends_four_texels_like_a_bitmap(llvm, need, rng, tmp_path):
    """Against Mitsuba's own bilinear bitmap as the albedo of a diffuse surface: B = ρ cos θ / π."""
    need("gl")
    llvm.set_variant("scalar_rgb")
    colours = rng.random((6, 5, 3)).astype(np.float32)
    fitted = as_ones(fit(oracle_btf((6, 5)), clusters=None, storage="float"), colours)
    bitmap = {"type": "bitmap", "bitmap": llvm.Bitmap(colours), "raw": True}
    bitmap |= {"format": "variant", "accel": False}
    expected = render(plane(llvm, {"type": "diffuse", "reflectance": bitmap}), grid=GRID, shadows=False)
    cosine = LIGHT[2] / np.linalg.norm(LIGHT)
    expected = dataclasses.replace(expected, image=(expected.image * (np.pi / cosine)).astype(np.float32))
    for picture in both_pictures(llvm, fitted, tmp_path):
        found = compare(picture, expected, gate="image.bitmap", flip=False)
        assert found.passed, [gate.line for gate in found.gates]
    for picture in both_pictures(llvm, fitted, tmp_path, filter_type="nearest"):
        assert not compare(picture, expected, gate="image.bitmap", flip=False).passed
