"""How wrong a fit is between its samples: what is measured, stated, warned of and gated."""

import dataclasses
import json

import numpy as np
import pytest
from oracle import oracle_btf, scattered

from btfref.cli import main
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.registry import methods
from btfref.representations import between, load
from btfref.representations.analytic import lafortune, lafortune_lut
from btfref.sampling import SampledBTF
from btfref.stress.between_samples import between_gates

EXACT = tolerance("interpolation.exact.max")


def lambert(albedo, views="10x5", lights="16x8"):
    """A white wall of a given albedo."""
    btf = oracle_btf((3, 2), views, lights)
    cosine = btf.lights.vectors[:, 2, None, None, None] * (albedo / np.pi)
    return dataclasses.replace(btf, values=np.broadcast_to(cosine, btf.values.shape).astype(np.float32))


class Changed:
    """A representation whose values go through a function."""

    def __init__(self, inner, change):
        self._inner, self._change = inner, change

    def evaluate(self, uv, w_light, w_view, *, lod=0.0):
        return self._change(self._inner.evaluate(uv, w_light, w_view, lod=lod))


def test_the_interpolation_differs_from_itself_by_nothing():
    """On rings with a pole, on rings without and on triangles: raw is the yardstick."""
    for views, lights in (("ubo81", "10x5"), ("16x8", scattered(12))):
        btf = oracle_btf((3, 2), views, lights)
        facts = between.measure(methods()["raw"].fit(btf), btf)
        # Tables of directions are stored as float32.
        assert facts["rms_to_data"] <= tolerance("interpolation.float32.max")
        assert abs(facts["mean_ratio"] - 1) <= tolerance("interpolation.float32.max")
        assert 0 < facts["peak_p999"] < facts["peak"] <= 1 + EXACT
        assert facts["albedo_excess"] == facts["albedo"] / max(facts["data_albedo"], 1)
        assert facts["negative_fraction"] == 0
        assert all(gate.passed for gate in between_gates("raw", facts))


def test_a_wall_has_its_albedo():
    """Interpolation over rings 5 degrees apart loses little of a cosine, and its fall to the horizon is the cosine."""
    btf = lambert(0.7)
    facts = between.measure(methods()["raw"].fit(btf), btf)
    assert abs(facts["albedo"] / 0.7 - 1) <= tolerance("between.albedo.relative")
    assert abs(facts["albedo"] - facts["data_albedo"]) <= tolerance("interpolation.float32.max")


@pytest.mark.parametrize(
    ("change", "measured", "entry"),
    [
        (lambda b: 9 * b, ("peak", 9.0), "peak"),
        (lambda b: 9 * b, ("albedo_excess", 6.3), "albedo_excess"),
        (lambda b: b / 9, ("mean_ratio", 1 / 9), "min_mean_ratio"),
        (lambda b: -b, ("negative_fraction", 1.0), "negative_fraction"),
    ],
)
def test_what_is_wrong_is_measured_and_fails_its_limit(change, measured, entry):
    btf = lambert(0.7)
    raw = methods()["raw"].fit(btf)
    right, wrong = (between.measure(Changed(raw, f), btf) for f in (lambda b: b, change))
    name, value = measured
    scale = right["peak"] if name == "peak" else 1
    assert abs(wrong[name] / (scale * value) - 1) <= tolerance("between.albedo.relative")
    assert [gate.entry for gate in between_gates("raw", right) if not gate.passed] == []
    assert entry in [gate.entry for gate in between_gates("raw", wrong) if not gate.passed]


def test_a_fit_states_it_and_is_otherwise_as_it_was():
    btf, row = oracle_btf((4, 3), "10x5", "10x5"), methods()["svd"]
    alone, stated = row.fit(btf, components=2), between.fit(row, btf, components=2)
    for name, array in alone.arrays().items():
        np.testing.assert_array_equal(stated.arrays()[name], array)
    assert stated.meta["fit"] == alone.meta["fit"] | {"between_samples": between.measure(alone, btf)}
    again = between.measure(alone, btf)
    assert again == stated.meta["fit"]["between_samples"]
    assert between.measure(alone, btf, seed=1) != again


def test_commands_state_it_and_warn_in_one_line(tmp_path, capsys, rng):
    btf = oracle_btf((2, 2), "10x5", "10x5")
    rough = np.exp(2 * rng.normal(size=btf.values.shape)).astype(np.float32)
    SampledBTF(rough, btf.views, btf.lights).save(tmp_path / "rough.btf.zarr")
    words = ["fit", "cmf", str(tmp_path / "rough.btf.zarr"), "-o", str(tmp_path / "rough.cmf.exr")]
    assert main([*words, "--set", "sweeps=60", "between=0", "--json"]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)["fit"]["between_samples"]
    assert facts["peak"] > tolerance("factored.between.max_peak")
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("btfref: warning: wrong between the samples: peak ")
    assert load(tmp_path / "rough.cmf.exr").meta["fit"]["between_samples"] == facts
    assert main(["info", str(tmp_path / "rough.cmf.exr")]) == 0
    assert "albedo_excess" in capsys.readouterr().out

    words[1], words[-1] = "raw", str(tmp_path / "rough.raw.exr")
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "between the samples: peak " in printed.out
    assert printed.err == ""


def test_the_factor_of_lafortune_lut_makes_no_light():
    """A mirror's lobe, which no light of 5 azimuths meets: least squares at the lights leave its brightness open."""
    btf = oracle_btf((1, 1), "10x5", "10x5")
    parameters = np.array([[0.01, -1, -1, 1, np.log(60), 5.0]], np.float32)
    lobes, peaks, diffuse = lafortune.lobe_maps(parameters)
    maps = {"lobes": lobes, "peaks": peaks, "colour": np.pad(diffuse[:, None], ((0, 0), (3, 0)))}
    maps |= {"view_directions": btf.views.vectors, "light_directions": btf.lights.vectors}
    views, texels = np.arange(len(btf.views)), np.array([0])
    luminance = 6 * np.moveaxis(lafortune.luminance_tables(maps, texels, views), 0, 2)
    lights, weight = gauss_hemisphere(24, 96)
    albedo = lafortune.luminance_tables(maps | {"light_directions": lights}, texels, views)[0] @ weight
    most = np.maximum(1, np.einsum("l,vln->v", btf.lights.quadrature_weights, luminance))
    free, bounded = (
        lafortune_lut.view_factor(luminance, parameters, btf, bounded=bound)[:, 0] for bound in (False, True)
    )
    limit = most * (1 + tolerance("between.bounded.relative"))
    assert (free * albedo > limit).any()
    assert (bounded * albedo <= limit).all()
    within = free * albedo <= most / (1 + tolerance("between.bounded.relative"))
    np.testing.assert_array_equal(bounded[within], free[within])
