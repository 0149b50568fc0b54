"""The comparison, its gates shown to fail, the limits themselves, and what all tests share."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from btfref.comparison import Comparison, Display, agreement, compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates import gate_table, judge, missing_reference, reason, tolerance
from btfref.gates.tolerances import gate_keys, limits, parse

ROOT = Path(__file__).parents[3]


@pytest.fixture
def scene(rng):
    """A disc on a black background: reference and class map."""
    y, x = np.mgrid[0:64, 0:64] - 31.5
    radius = np.hypot(x, y)
    classes = np.full(radius.shape, PixelClass.BACKGROUND, np.uint8)
    classes[radius < 25.5] = PixelClass.SILHOUETTE
    classes[radius < 24] = PixelClass.INTERIOR
    texture = 0.2 + 0.15 * np.sin(x / 3)[..., None] * np.cos(y[..., None] / [2, 3, 5])
    return np.where((classes != PixelClass.BACKGROUND)[..., None], texture, 0.0).astype(np.float32), classes


def names(results, outcome="fail"):
    return {result.name for result in results if result.outcome == outcome}


def test_equal_pictures_pass_every_class(scene):
    reference, classes = scene
    found = compare(
        reference,
        reference,
        classes=classes,
        gate=["image.noise_free", "image.silhouette", "image.background"],
    )
    assert found.passed
    assert set(found.metrics) == {"interior", "silhouette", "background", "all"}
    assert found.metrics["interior"]["rmse"] == 0
    assert found.metrics["interior"]["psnr"] == np.inf
    assert found.counts["all"] == 64 * 64
    assert {gate.outcome for gate in found.gates} == {"pass"}


def test_each_class_has_its_own_errors(scene):
    reference, classes = scene
    test = reference.copy()
    test[classes == PixelClass.SILHOUETTE] += 0.1
    found = compare(test, reference, classes=classes, gate=["image.noise_free", "image.silhouette"])
    assert found.metrics["interior"]["max_abs"] == 0
    assert found.metrics["silhouette"]["bias"] == pytest.approx(0.1, rel=tolerance("metric.float32.rtol"))
    assert names(found.gates) == {"image.silhouette.failing_fraction", "image.silhouette.relative_l2"}
    assert not found.passed


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_an_error_around_the_limit_decides(scene, factor):
    reference, classes = scene
    test = reference * (1 + factor * tolerance("image.noise_free.p999"))
    found = compare(test, reference, classes=classes, gate="image.noise_free")
    assert found.passed == (factor < 1)
    assert names(found.gates) == (set() if factor < 1 else {"image.noise_free.p999"})


def test_one_bad_pixel_fails_the_hard_maximum_alone(scene):
    reference, classes = scene
    test = reference.copy()
    test[32, 32] *= 1 + 3 * tolerance("image.noise_free.max")
    found = compare(test, reference, classes=classes, gate="image.noise_free")
    assert names(found.gates) == {"image.noise_free.max"}
    gate = found.gates[-1]
    assert gate.value > gate.limit
    assert gate.reason == reason("image.noise_free")
    share = (classes == PixelClass.INTERIOR).sum() / (classes != PixelClass.BACKGROUND).sum()
    where = f"[interior+edge, {100 * share:.1f} %]"
    assert gate.line.startswith(f"fail: image.noise_free.max {where} 0.03, wanted ≤ 0.01")


def test_edge_pixels_are_judged_as_strictly_as_interior_ones_and_the_share_has_a_gate(scene):
    reference, classes = scene
    outer = classes == PixelClass.SILHOUETTE
    test = reference.copy()
    test[outer] *= 1 + 3 * tolerance("image.noise_free.max")
    gates = ["image.noise_free", "image.judged"]
    assert names(compare(test, reference, classes=classes, gate=gates).gates) == {
        "image.judged.min_judged_share"
    }
    as_edge = np.where(outer, PixelClass.EDGE, classes)
    found = compare(test, reference, classes=as_edge, gate=gates)
    assert names(found.gates) == {"image.noise_free.p999", "image.noise_free.max"}
    assert {gate.judged for gate in found.gates if gate.gate == "image.noise_free"} == {1.0}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("side", ["test", "reference"])
def test_values_that_are_not_finite_fail_and_are_counted(scene, value, side):
    reference, classes = scene
    broken = reference.copy()
    broken[30, 30, 1] = value
    pair = (broken, reference) if side == "test" else (reference, broken)
    found = compare(*pair, classes=classes, gate="image.noise_free")
    assert names(found.gates) == {"image.finite.nonfinite"}
    assert found.counts[f"nonfinite_{side}"] == 1
    assert f"1 in the {side}" in found.gates[0].detail
    assert found.metrics["interior"]["rmse"] == 0
    assert np.isnan(found.maps["relative"][30, 30])
    json.dumps(found.to_dict(), allow_nan=False)


def test_a_picture_of_nan_fails_with_a_number_for_nothing(scene):
    reference, classes = scene
    found = compare(np.full_like(reference, np.nan), reference, classes=classes, gate="image.noise_free")
    assert not found.passed
    assert all(gate.value is None for gate in found.gates if gate.gate == "image.noise_free")


def test_without_classes_nothing_is_excused(scene):
    reference, _ = scene
    test = reference.copy()
    test[0, 0] += 0.1
    assert compare(test, reference, gate="image.noise_free").passed is False


def test_a_class_without_pixels_fails_unless_it_may_be_empty(scene):
    reference, classes = scene
    found = compare(
        reference, reference, classes=np.zeros_like(classes), gate=["image.noise_free", "image.silhouette"]
    )
    assert names(found.gates) == {"image.noise_free.p999", "image.noise_free.max"}
    assert names(found.gates, "empty") == {
        "image.silhouette.failing_fraction",
        "image.silhouette.relative_l2",
    }


def test_negative_values_are_counted_and_not_clamped(scene):
    reference, classes = scene
    test = reference.copy()
    test[32, 32, 0] = -0.5
    found = compare(test, reference, classes=classes)
    assert found.counts["negative_test"] == 1
    assert found.maps["difference"][32, 32, 0] == pytest.approx(-0.5 - reference[32, 32, 0])


def test_settings_name_every_constant(scene):
    reference, classes = scene
    found = compare(reference, reference, classes=classes).settings
    assert {"relmse_epsilon", "smape_epsilon", "relative_floor", "psnr_peak", "display", "flip"} <= set(found)
    assert {"startExposure", "stopExposure", "tonemapper", "ppd"} <= set(found["flip"])
    assert compare(reference, reference, display=Display(1.0), flip=False).settings["display"]["stops"] == 1.0


def test_noise_alone_passes_the_difference_test_and_a_bias_does_not(scene, rng):
    reference, classes = scene
    sigma = 0.01
    test = reference + sigma * rng.standard_normal(reference.shape)
    variance = np.full(reference.shape, sigma**2)
    found = compare(
        test, reference, classes=classes, gate="image.difference", variance=(variance, 0 * variance)
    )
    assert found.passed
    statistics = found.statistics["interior"]
    assert statistics["bias"]["low"] < 0 < statistics["bias"]["high"]
    assert statistics["rmse_without_noise"]["low"] == 0
    assert statistics["rmse_without_noise"]["high"] < sigma
    biased = compare(test + 8 * sigma, reference, classes=classes, gate="image.difference", variance=variance)
    assert names(biased.gates) == {"image.difference.rejected_fraction"}


@pytest.mark.parametrize(
    ("noise", "error", "outcome"), [(1e-4, 0, "pass"), (0.5, 0, "inconclusive"), (1e-3, 0.2, "fail")]
)
def test_equivalence_gate(scene, rng, noise, error, outcome):
    reference, classes = scene
    test = reference * (1 + error) + noise * rng.standard_normal(reference.shape)
    carried = SimpleNamespace(image=test, variance=np.full(reference.shape, noise**2))
    found = compare(carried, reference, classes=classes, gate="image.equivalence")
    assert found.gates[-1].outcome == outcome
    assert found.passed == (outcome == "pass")
    assert "interval" in found.gates[-1].detail


@pytest.mark.parametrize("gate", ["image.difference", "image.equivalence"])
def test_statistical_gates_fail_without_variances(scene, gate):
    reference, classes = scene
    found = compare(reference, reference, classes=classes, gate=gate)
    assert not found.passed
    assert "variance" in found.gates[-1].detail
    nan = np.full(reference.shape, np.nan)
    assert not compare(reference, reference, classes=classes, gate=gate, variance=nan).passed


def test_dictionary_is_strict_json(scene):
    reference, classes = scene
    text = json.dumps(compare(reference, reference, classes=classes).to_dict(), allow_nan=False)
    assert json.loads(text)["metrics"]["interior"]["psnr"] == "inf"


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"test": np.zeros((3, 4, 3))}, "shape"),
        ({"test": np.zeros((64, 64))}, "picture"),
        ({"classes": np.zeros((3, 3), int)}, "class"),
        ({"classes": np.full((64, 64), 7)}, "class"),
        ({"gate": "image.nonsense"}, "gate"),
        ({"variance": np.zeros((2, 2, 3))}, "variance"),
        ({"test": "nowhere.exr"}, "nowhere.exr"),
    ],
)
def test_bad_input_is_one_clear_line(scene, change, word):
    reference, classes = scene
    arguments = {"test": reference, "reference": reference, "classes": classes} | change
    with pytest.raises(InputError, match=word) as error:
        compare(**arguments)
    assert "\n" not in str(error.value)


# --- lists of values -------------------------------------------------------------------------------------


def test_agreement_of_probes(rng):
    reference = rng.random((5000, 3))
    assert agreement(reference, reference).passed
    limit = tolerance("probe.agreement.max")
    test = reference.copy()
    test[123, 1] += 2 * limit * reference[123, 1]
    found = agreement(test, reference)
    assert found.settings["worst"] == 123
    assert names(found.gates) == {"probe.agreement.max"}
    test[7] = np.nan
    found = agreement(test, reference)
    assert names(found.gates) == {"probe.agreement.max", "probe.agreement.p999"}
    assert "1 of 5000" in found.gates[0].detail
    assert not agreement(reference * np.nan, reference).passed


# --- gates on their own ----------------------------------------------------------------------------------


def test_gate_without_a_measurement_fails():
    found = judge("probe.agreement", {"p999": 0.0, "max": np.nan})
    assert [gate.passed for gate in found] == [True, False]
    assert judge("probe.agreement", {})[0].detail == "not measured"


def test_gate_refuses_what_it_does_not_limit():
    with pytest.raises(InputError, match="p42"):
        judge("probe.agreement", {"p42": 0.0})
    with pytest.raises(InputError, match="no limit"):
        judge("chi2", {})


def test_lower_limits():
    limit = tolerance("metric.flip_opposites.min_mean")
    assert judge("metric.flip_opposites", {"mean": limit})[0].passed
    assert not judge("metric.flip_opposites", {"mean": limit - 1e-3})[0].passed


def test_missing_reference_is_a_failure():
    found = missing_reference("image.noise_free", "sphere.exr")
    assert found
    assert all(not gate.passed and "sphere.exr" in gate.detail for gate in found)
    assert not Comparison({}, tuple(found)).passed
    assert not Comparison({}).passed


def test_every_gate_has_a_reason_and_finite_limits():
    for key in gate_keys():
        assert reason(key)
        assert all(np.isfinite(limit) for limit in limits(gate_table(key)).values())


def test_every_key_in_code_and_tests_exists():
    """A mistyped key would fail only when its line runs."""
    pattern = re.compile(r"\b(?:tolerance|reason)\(\s*[\"']([\w.]+)[\"']")
    used = {
        key
        for folder in ("btfref", "tests", "mitsuba_plugins")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path != Path(__file__)
        for key in pattern.findall(path.read_text("utf-8"))
    }
    assert used
    for key in used:
        assert reason(key)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[a]\nmax = 1.0", "reason"),
        ('[a]\nreason = " "\nmax = 1.0', "reason"),
        ("[a", "tolerances.toml"),
        ('[a]\nreason = "x"\nmax = [1.0]', "a.max"),
    ],
)
def test_broken_limits_are_refused(text, word):
    with pytest.raises(InputError, match=re.escape(word)):
        parse(text)


@pytest.mark.parametrize(
    "key", ["image", "image.noise_free", "image.noise_free.nothing", "image.noise_free.reason", "x"]
)
def test_unknown_tolerances_raise(key):
    with pytest.raises(InputError):
        tolerance(key)


# --- what all tests share ---------------------------------------------------------------------------------


@pytest.mark.parametrize("operation", [lambda x: 1 / x, lambda x: x / x, lambda x: np.exp(x + 1e4)])
def test_floating_point_errors_raise(operation):
    with pytest.raises(FloatingPointError):
        operation(np.zeros(2))
    assert np.float64(1e-300) ** 2 == 0  # underflow is let through


def test_a_missing_reference_fails_the_test(reference_file):
    with pytest.raises(pytest.fail.Exception, match=r"nothing\.exr is missing"):
        reference_file("nothing.exr")


@pytest.mark.parametrize(
    ("wanted", "outcome"), [("", pytest.skip.Exception), ("a, flux", pytest.fail.Exception)]
)
def test_requirements_are_skipped_or_demanded(need, capabilities, monkeypatch, wanted, outcome):
    monkeypatch.setenv("BTFREF_REQUIRE", wanted)
    monkeypatch.setitem(capabilities, "flux", lambda: None)
    with pytest.raises(outcome, match="flux is not on this machine"):
        need("flux")
    monkeypatch.setitem(capabilities, "flux", lambda: "capacitor")
    assert need("flux") == "capacitor"


def test_import_is_light():
    code = "import sys, btfref.comparison, btfref.report; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    heavy = {
        "mitsuba",
        "drjit",
        "moderngl",
        "matplotlib",
        "scipy",
        "skimage",
        "flip_evaluator",
        "PIL",
        "OpenEXR",
    }
    assert not set(found.stdout.split()) & heavy
