"""The stress suite: every method keeps its bounds, hard data are fitted or refused, and planted faults are found."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfref import conventions
from btfref.cli import main
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.precision import computing_in
from btfref.registry import method, methods
from btfref.stress import properties, runner
from btfref.stress.data import DATA, make, scattered
from btfref.stress.evaluators import MEASURED, Definition
from btfref.stress.judging import judge_values
from btfref.stress.lookups import COORDINATES, DIRECTIONS, block
from btfref.stress.table import check_table, evaluator_table, failure_lines

#: Methods whose fits take less than half a second, for the default run; the long one takes all.
QUICK = ("raw", "svd", "lpca", "rf_poly")

#: Sets of directions with and without rings, a pole alone among them.
SETS = ("ubo81", "ubo151", "10x5", "scattered", "pole")


def direction_set(name):
    return directions({"scattered": scattered(0), "pole": [[0, 0, 1]]}.get(name, name))


def assert_all_pass(findings):
    findings = list(findings)
    assert findings
    assert not list(failure_lines(findings))


@pytest.mark.parametrize("key", methods())
def test_hard_lookups(key, fits, llvm, need):
    need("gl")
    ports = ("drjit without FastMath", "glsl")
    assert_all_pass(runner.stress_lookups(fits(key), "formula", ports, n=2048))
    assert_all_pass(runner.stress_lookups(fits(key, "scattered"), "formula, scattered", ("glsl",), n=2048))


@pytest.mark.parametrize("key", ["svd", pytest.param("rf_poly", marks=pytest.mark.long)])
def test_hard_data(key, need):
    need("gl")
    need("llvm")
    for name in DATA:
        findings = list(runner.stress_data(key, name, ("glsl",)))
        assert_all_pass(findings)
        if name in ("constant", "black", "one texel", "one direction"):
            assert {f.check for f in findings} >= {"port"}, f"{name} was refused"


@pytest.mark.parametrize("key", ["raw", pytest.param("svd", marks=pytest.mark.long), "rf_poly"])
def test_fits_keep_what_they_must(key, need):
    need("llvm")
    assert_all_pass(runner.stress_fits(key))


@pytest.mark.long
@pytest.mark.parametrize("key", methods())
def test_the_long_run(key, llvm, need):
    need("gl")
    result = runner.run(only=[key], long=True)
    assert result["cases"] > 10**6 / len(methods())
    assert_all_pass(result["findings"])


@pytest.mark.parametrize("key", ["lpca", "laplacian", "cmf"])
def test_values_are_continuous(key, fits):
    assert_all_pass(properties.continuous(method(key), fits(key), "formula"))


@pytest.mark.long
def test_what_the_limits_of_the_g_brdf_are_for(llvm):
    """Converged, it scales as the others do; on data of a height field it keeps the energy that the others keep."""
    bumpy, relief, row = make("bumpy"), make("relief"), method("gbrdf")
    scaled = properties._with(bumpy, bumpy.values.astype(np.float32) * np.float32(0.25))
    bright, dark = (properties.sample_error(row.fit(b, iterations=32), b) for b in (bumpy, scaled))
    assert dark <= tolerance("stress.scaling.ratio") * bright
    (finding,) = properties.energy(row, row.fit(relief), relief, "relief", "stress.energy.relief")
    assert finding.passed
    assert finding.bound == tolerance("stress.energy.relative")


def test_jumps_are_found(fits):
    """Without the wrap of the azimuth a ring's last cell would end at the wrong sample."""

    class Jumping:
        def __init__(self, inner):
            self.inner, self.meta = inner, inner.meta

        def arrays(self):
            return self.inner.arrays()

        def evaluate(self, uv, w_light, w_view, *, lod=0.0):
            w = np.asarray(w_view, float)
            swapped = np.where((w[..., 1] < 0)[..., None], w * [1, -1, 1] + [0.1, 0, 0], w)
            return self.inner.evaluate(uv, w_light, properties.unit(swapped), lod=lod)

    (finding,) = properties.continuous(method("raw"), Jumping(fits("raw")), "formula")
    assert not finding.passed


FAULTS = {
    "a wrong texel beyond 0": lambda r, s: r.evaluate(
        np.where(s.uv < 0, s.uv + 0.1, s.uv), s.w_light, s.w_view
    ),
    "NaN spoils the other coordinate": lambda r, s: r.evaluate(
        np.where(np.isfinite(s.uv).all(1, keepdims=True), s.uv, 0), s.w_light, s.w_view
    ),
    "a value below the horizon": lambda r, s: (
        r.evaluate(*s.points) + np.where(conventions.valid_directions(s.w_light), 0, 1e-30)[:, None]
    ),
    "NaN near the horizon": lambda r, s: np.where(
        (np.abs(s.w_light[:, 2:]) < 1e-7) & (s.w_light[:, 2:] > 0), np.nan, r.evaluate(*s.points)
    ),
    "a relative error of 3e-4": lambda r, s: r.evaluate(*s.points) * (1 + 3e-4),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_fail(fault, fits):
    representation = fits("raw")
    lookups = block(representation, 0, 0, 2048)
    reference = representation.evaluate(*lookups.points)
    good = judge_values(reference.astype(np.float32), reference, representation, lookups, "stress.ports")
    assert not good[0].any()
    assert 2 * good[3].max() <= 1 + tolerance(
        "stress.half.rounding"
    )  # rounding to float32 is half a unit in the last place
    failed, explained, _, _ = judge_values(
        FAULTS[fault](representation, lookups), reference, representation, lookups, "stress.ports"
    )
    assert failed.sum() >= 5
    assert explained.sum() < failed.sum()


def test_what_rounded_arguments_explain(fits):
    """A nearest texel just across an edge is one that the definition takes close by; two texels away is not."""
    nearest = dataclasses.replace(fits("raw"), meta=fits("raw").meta | {"filter_type": "nearest"})
    lookups = block(nearest, 0, 0, 4096)
    lookups = lookups[lookups.coordinate == COORDINATES.index("border")]
    texel = 1 / np.array(nearest.meta["texels"][::-1])
    reference = nearest.evaluate(*lookups.points)
    for share, passes in ((1e-8, True), (1, False)):
        moved = nearest.evaluate(lookups.uv - share * texel, lookups.w_light, lookups.w_view)
        failed, explained, _, _ = judge_values(moved, reference, nearest, lookups, "stress.ports")
        assert failed.any() != passes
        assert passes == (explained.sum() > 10 and not failed.any())


def test_lookups_are_reproducible_and_cover_all_kinds(fits):
    one, two = (block(fits("raw"), 3, 5, 2048) for _ in range(2))
    for name in one.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert set(one.light) == set(one.view) == set(range(len(DIRECTIONS)))
    assert set(one.coordinate) == set(range(len(COORDINATES)))
    valid = conventions.valid_directions(one.w_light).mean()
    assert tolerance("stress.mixture.min_valid") < valid < tolerance("stress.mixture.valid")
    assert np.array_equal(block(fits("raw"), 3, 6, 2048).uv, one.uv, equal_nan=True) is False


def test_malformed_lookups_are_counted(fits):
    up, nan = [0, 0, 1], [np.nan, 0, 1]
    lights, views = np.array([up, nan, up, [0, 0, 3], [0.6, 0, -0.8]]), np.array([up, up, nan, up, up])
    uv = np.array([[0.1, 0.2], [0, 0], [np.inf, 0], [0, np.nan], [0, 0]])
    assert conventions.malformed(uv, lights, views) == {"directions": 3, "coordinates": 2}
    np.testing.assert_array_equal(fits("raw").evaluate(uv, lights, views)[1:], 0)


def test_every_port_counts_malformed_lookups(fits, llvm, need, monkeypatch):
    need("gl")
    need("chromium")
    findings = list(runner.stress_lookups(fits("raw"), "formula", MEASURED, n=1024))
    counted = [f for f in findings if f.check == "malformed counted"]
    assert [f.evaluator for f in counted] == list(MEASURED)
    assert all(f.passed and f.detail["directions"] > 50 and f.detail["coordinates"] > 50 for f in counted)
    wrong = {"directions": 1, "coordinates": 1}
    monkeypatch.setattr(Definition, "malformed", lambda *_: wrong)
    assert not [
        f
        for f in runner.stress_lookups(fits("raw"), "formula", MEASURED[:1], n=1024)
        if f.check == "malformed counted" and f.passed
    ]


@pytest.mark.parametrize("key", methods())
def test_the_definition_in_single_precision(key, fits):
    """It computes in float32 all through, meets its bound, and leaves float64 as it was."""
    representation = fits(key)
    lookups = block(representation, 0, 0, 512)
    before = representation.evaluate(*lookups.points, lod=lookups.lod)
    with computing_in(np.float32):
        single = representation.evaluate(*lookups.points, lod=lookups.lod)
    after = representation.evaluate(*lookups.points, lod=lookups.lod)
    assert single.dtype == np.float32
    assert before.dtype == np.float64
    np.testing.assert_array_equal(before, after)
    assert not np.array_equal(single, before.astype(np.float32))
    assert_all_pass(runner.stress_lookups(representation, "formula", ("numpy float32",), n=2048))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from(SETS))
def test_weights_are_a_partition_of_unity(seed, name):
    assert_all_pass(properties.partition_of_unity(direction_set(name), name, seed=seed, n=500))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 2),
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    st.sampled_from(conventions.FILTER_TYPES),
)
def test_texel_weights(uv, shape, filter_type):
    index, weight = conventions.texel_stencil(np.array(uv), shape, filter_type)
    assert (index >= 0).all()
    assert (index < shape[0] * shape[1]).all()
    assert (weight >= 0).all()
    assert abs(weight.sum() - 1) <= tolerance("stress.unity.deviation")
    # A whole number of tiles changes nothing but rounding, which may decide for the next texel where one alone counts.
    if filter_type == "bilinear" and max(map(abs, uv)) < 1:
        moved, _ = conventions.texel_stencil(np.add(uv, [3, -2]), shape, filter_type)
        assert set(moved.ravel()) & set(index.ravel())


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from(QUICK))
def test_any_seed_gives_finite_values(fits, seed, key):
    lookups = block(fits(key), seed, 0, 256)
    value = fits(key).evaluate(*lookups.points, lod=lookups.lod)
    assert np.isfinite(value).all()
    lost = ~conventions.valid_directions(lookups.w_light) | ~conventions.valid_directions(lookups.w_view)
    assert (value[lost] == 0).all()


def test_half_a_turn_is_a_symmetry_of_rings_only():
    btf = make("bumpy")
    turned = properties.half_turn(btf)
    assert not np.array_equal(turned.values, btf.values)
    np.testing.assert_array_equal(properties.half_turn(turned).values, btf.values)
    assert properties.half_turn(make("scattered")) is None


def test_command(capsys, tmp_path, need):
    need("gl")
    out = tmp_path / "stress.md"
    words = ["stress", "--only", "raw", "--data", "odd"]
    assert main(words) == 2
    assert "unknown data" in capsys.readouterr().err
    words = ["stress", "--only", "raw", "--data", "line", "--evaluator", "glsl"]
    assert main([*words, "--json", "-o", str(out)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["failures"] == 0
    assert result["cases"] > 8000
    (port,) = (f for f in result["findings"] if f["check"] == "port")
    assert "| `raw` |" in out.read_text()
    case = port["reproducer"].split()[-1]
    assert main([*words, "--case", case, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["relative_error"] == pytest.approx(port["worst"])
    assert main([*words, "--case", "0:9:3"]) == 2
    assert "not a case" in capsys.readouterr().err


def test_tables_and_reproducers_of_failures(fits, need):
    need("gl")
    findings = list(runner.stress_lookups(fits("raw"), "formula", ("glsl",), n=512))
    bad = dataclasses.replace(findings[1], failures=3, worst=0.5)
    (line,) = failure_lines([findings[0], bad])
    assert line.endswith(bad.reproducer)
    assert "3 of 512" in line
    assert evaluator_table([bad])[2].split(" | ")[1].startswith("5.0e-01")
    assert "finite, 0 if invalid" in check_table(findings)[2]
