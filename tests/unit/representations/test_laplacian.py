"""Laplacian pyramids of BTFs: bytes, errors, levels, settings."""

import dataclasses
import json

import numpy as np
import pytest
from oracle import SHAPE, oracle_btf

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics import pyramid
from btfref.representations import read_info, save
from btfref.representations.laplacian import definition as laplacian
from btfref.representations.laplacian.fit import packed_layout

EXACT = tolerance("interpolation.exact.max")


@pytest.fixture(scope="module")
def btf():
    return oracle_btf(SHAPE)


def at_level(representation, btf, k, *, filter_type=None):
    """The definition at the texel centres of level k, every view and some lights."""
    level = representation.meta["levels"][k]
    rows, columns = level["rows"], level["columns"]
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    uv = np.stack([u, v], -1)[None, None]
    views, lights = btf.views.vectors[:, None, None, None], btf.lights.vectors[None, ::7, None, None]
    return representation.evaluate(uv, lights, views, lod=k)


def images(btf, k, reduction="binomial"):
    """Level k of the BTF's Gaussian pyramid at the same lights, [view, light, row, column, channel]."""
    data = np.moveaxis(btf.values[:, ::7].astype(float), (2, 3), (0, 1))
    return np.moveaxis(pyramid.gaussian_pyramid(data, k + 1, reduction)[k], (0, 1), (2, 3))


def relative(test, reference):
    return np.sqrt(((test - reference) ** 2).sum() / (reference**2).sum())


def test_bytes_are_those_of_the_paper():
    """r = 64, 81 × 81 directions, λ_max = 4 (section 3.3)."""
    layout = packed_layout(5, (64, 64), 81, 81)
    assert layout["eigen_bytes"] == 1_574_640
    assert layout["weight_bytes"] == 262_144
    assert layout["payload_bytes"] == 1_836_784
    assert layout["raw_bytes"] == 80_621_568
    assert round(layout["ratio"], 1) == 43.9


def test_the_paper_preset_has_the_papers_components(btf, tmp_path):
    """The maps of the file are the paper's: 12 components a level, and the Phong model's six numbers."""
    representation = laplacian.fit(btf, **laplacian.PRESETS["paper"] | {"levels": 2})
    save(representation, tmp_path / "x.exr")
    info = read_info(tmp_path / "x.exr")
    pairs, texels = 81 * 81, 16 * 12 + 8 * 6
    assert info["payload_bytes"] == 4 * (12 * pairs * 2 + 12 * texels + 6)
    assert info["published_layout"] == json.loads(json.dumps(packed_layout(2, (16, 12), 81, 81)))
    assert set(representation.maps) >= {"phong", "basis_0", "weights_1"}
    assert "published_layout" not in laplacian.fit(btf, components=(4, 1, 1)).meta


@pytest.mark.parametrize("prediction", ["closed", "open"])
@pytest.mark.parametrize("reduction", pyramid.REDUCTIONS)
def test_untruncated_levels_are_the_images(btf, reduction, prediction):
    """At λ = k the definition is level k of the pyramid."""
    small = dataclasses.replace(btf, values=btf.values[:, :, :7, :6])
    representation = laplacian.fit(
        small, components=42, reduction=reduction, prediction=prediction, storage="float"
    )
    for k in range(len(representation.meta["levels"])):
        expected = images(small, k, reduction)
        assert relative(at_level(representation, small, k), expected) <= tolerance("laplacian.exact.max")


def test_stated_errors_are_those_of_the_definition():
    btf = oracle_btf((8, 6), "ubo81", "10x5")
    representation = laplacian.fit(btf, components=(3, 1, 1))
    data = np.moveaxis(btf.values.astype(float), (2, 3), (0, 1))
    for k, stated in enumerate(representation.meta["fit"]["levels"][:3]):
        level = representation.meta["levels"][k]
        rows, columns = level["rows"], level["columns"]
        v, u = np.meshgrid(
            (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
        )
        value = representation.evaluate(
            np.stack([u, v], -1)[None, None],
            btf.lights.vectors[None, :, None, None],
            btf.views.vectors[:, None, None, None],
            lod=k,
        )
        expected = np.moveaxis(pyramid.gaussian_pyramid(data, k + 1, "binomial")[k], (0, 1), (2, 3))
        assert abs(relative(value, expected) - stated) <= tolerance("fit.stated.max")
    assert representation.meta["fit"]["error"] == pytest.approx(representation.meta["fit"]["levels"][0] ** 2)


def test_closed_prediction_is_never_worse(btf):
    for components in ((2, 1, 1), (8, 2, 2)):
        closed, opened = (
            laplacian.fit(btf, components=components, prediction=p, storage="float").meta["fit"]["levels"]
            for p in ("closed", "open")
        )
        assert all(
            a <= b * (1 + tolerance("laplacian.closed.excess")) for a, b in zip(closed, opened, strict=True)
        )
        assert closed[0] < tolerance("laplacian.closed.gain") * opened[0]


def test_a_target_is_reached_with_few_components(btf):
    target = 0.05
    representation = laplacian.fit(btf, target_error=target)
    assert max(representation.meta["fit"]["levels"]) <= target
    own = representation.meta["levels"][0]["components"]
    fewer = [max(0, n - 2) for n in own]
    assert laplacian.fit(btf, components=fewer).meta["fit"]["levels"][0] > target
    assert (
        relative(at_level(representation, btf, 0), images(btf, 0))
        <= tolerance("laplacian.target.stored") * target
    )


def test_levels_below_the_coarsest_have_no_mean(btf):
    """What the paper takes for granted: exact for the binomial reduction and even sizes, not for the box."""
    data = np.moveaxis(btf.values[:3, ::9].astype(float), (2, 3), (0, 1))
    for kind, filter_type, exact in (("binomial", "bilinear", True), ("box", "nearest", False)):
        levels = pyramid.laplacian_pyramid(data, 2, kind, filter_type)
        share = np.abs(levels[0].mean((0, 1))).max() / np.abs(data).max()
        assert (share <= tolerance("pyramid.reconstruction.max")) == exact


def test_the_mean_follows_its_rule(need):
    """A Lambertian BTF has a Phong mean, the oracle a stored one; either can be asked for."""
    need("llvm")
    btf = oracle_btf((4, 4))
    flat = np.broadcast_to(
        btf.lights.vectors[None, :, None, None, 2:] * [0.2, 0.15, 0.1], btf.values.shape
    ).astype(np.float32)
    grey = dataclasses.replace(btf, values=flat.mean(-1, keepdims=True).repeat(3, -1))
    plain = laplacian.fit(grey)
    assert plain.meta["fit"]["mean"] == "phong"
    assert relative(at_level(plain, grey, 0), images(grey, 0)) < tolerance("laplacian.phong.share")
    assert laplacian.fit(btf).meta["fit"]["mean"] == "stored"
    assert laplacian.fit(btf).meta["fit"]["phong_misfit"] > tolerance("laplacian.phong.share")
    assert "phong" in laplacian.fit(btf, mean="phong").maps
    assert "mean" in laplacian.fit(grey, mean="stored").maps


def test_values_are_continuous_in_the_level_and_clamped(fits, rng):
    representation = fits("laplacian")
    uv, w = rng.random((40, 2)), fits.btf().views.vectors[rng.integers(0, 81, (2, 40))]
    lod = np.linspace(0, representation.max_lod, 801)
    values = representation.evaluate(uv[:, None], w[0][:, None], w[1][:, None], lod=lod)
    jump = np.abs(np.diff(values, axis=1)).max()
    assert jump <= tolerance("laplacian.continuity.jump") * np.abs(values).max()
    for beyond, inside in ((-3, 0), (np.nan, 0), (99, representation.max_lod)):
        np.testing.assert_array_equal(
            representation.evaluate(uv, *w, lod=beyond), representation.evaluate(uv, *w, lod=inside)
        )
    halfway = 0.5 * (representation.evaluate(uv, *w, lod=1) + representation.evaluate(uv, *w, lod=2))
    np.testing.assert_allclose(representation.evaluate(uv, *w, lod=1.5), halfway, atol=EXACT)
    # The coarsest level is one BRDF.
    np.testing.assert_allclose(*(representation.evaluate(uv[i], *w, lod=99) for i in (0, 1)), atol=EXACT)


def test_nearest_directions_are_the_nearest_samples(btf, rng):
    representation = laplacian.fit(btf, directions="nearest")
    pick = rng.integers(0, 81, (2, 200))
    uv = rng.random((200, 2))
    exact = btf.lights.vectors[pick[0]], btf.views.vectors[pick[1]]
    # Well inside the cell of a sample: the value is the sample's.
    moved = [w + 0.04 * rng.normal(size=w.shape) * [1, 1, 0] for w in exact]
    moved = [w / np.linalg.norm(w, axis=1, keepdims=True) for w in moved]
    inside = (moved[0][:, 2] >= btf.lights.vectors[:, 2].min()) & (exact[0][:, 2] > 0.3)
    np.testing.assert_allclose(
        representation.evaluate(uv, *moved)[inside], representation.evaluate(uv, *exact)[inside], atol=EXACT
    )


@pytest.mark.parametrize(
    "parameters",
    [
        {"components": (8, 2)},
        {"components": (0, 0, 0)},
        {"components": "8,2,x"},
        {"components": 2.5},
        {"target_error": 1.5},
        {"target_error": 0.1, "prediction": "open"},
        {"mean": "median"},
        {"prediction": "half"},
        {"directions": "best"},
        {"reduction": "gauss"},
        {"levels": 9},
        {"storage": "int"},
        {"filter_type": "cubic"},
    ],
)
def test_bad_parameters(btf, parameters):
    with pytest.raises(InputError):
        laplacian.fit(btf, **parameters)


def test_components_as_the_command_line_gives_them(btf):
    representation = laplacian.fit(btf, components="3,2,1")
    assert representation.meta["levels"][0]["components"] == [3, 2, 1]


def test_target_error_on_the_command_line(tmp_path, capsys):
    """An option of its own, which methods that cannot aim refuse in one line."""
    store = tmp_path / "x.btf.zarr"
    directions = ["--views", "10x5", "--lights", "10x5"]
    assert main(["synth", "checker", "-o", str(store), "--texels", "4", "--spp", "2", *directions]) == 0
    out = tmp_path / "x.laplacian.exr"
    assert main(["fit", "laplacian", str(store), "-o", str(out), "--target-error", "0.1"]) == 0
    assert read_info(out)["parameters"]["target_error"] == 0.1
    capsys.readouterr()
    assert main(["fit", "lpca", str(store), "-o", str(tmp_path / "y.exr"), "--target-error", "0.1"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
