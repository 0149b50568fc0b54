"""Which result says most of a cell, and how results are named."""

import json
import math

import pytest

from btfref.errors import InputError
from btfref.gates import GateResult, Measured, judge, tolerance
from btfref.gates.verdicts import deciding, judged, limit_name, with_class


def result(value, limit, *, entry="p99", outcome="pass"):
    return GateResult(f"image.x.{entry}", outcome in ("pass", "empty"), value, limit, "why", outcome)


@pytest.mark.parametrize(
    ("gate", "share"),
    [
        (result(1.0, 4.0), 0.25),
        (result(8.0, 4.0, outcome="fail"), 2.0),
        (result(8.0, 4.0, entry="min_psnr"), 0.5),
        (result(0.0, 0.0), 0.0),
        (result(1.0, 0.0, outcome="fail"), math.inf),
        (result(None, 4.0, outcome="fail"), math.inf),
        (result(math.nan, 4.0, outcome="fail"), math.inf),
        (result(None, 4.0, outcome="empty"), 0.0),
    ],
)
def test_share_of_a_limit(gate, share):
    assert gate.share == share


def test_failures_decide_before_doubts_and_doubts_before_what_is_near_its_limit():
    near, far = result(3.0, 4.0), result(1.0, 4.0)
    doubt = result(2.0, 4.0, outcome="inconclusive")
    bad = result(5.0, 4.0, outcome="fail")
    assert deciding([far, near]) is near
    assert deciding([near, doubt, far]) is doubt
    assert deciding([near, doubt, bad]) is bad
    assert deciding([]) is None


def test_names():
    assert limit_name("p999") == "99.9 % relative error"
    assert limit_name("min_some_thing", short=True) == "some thing"
    assert with_class("image.noise_free.p999") == "image.noise_free.p999 [interior+edge]"
    assert with_class("probe.agreement.max") == "probe.agreement.max"


@pytest.mark.parametrize(
    "measured",
    [
        Measured(0.01),
        Measured(0.1),
        Measured(float("inf")),
        Measured(float("nan")),
        Measured(None),
        Measured(None, "fail", "no reference"),
        Measured(None, "empty", "no pixels"),
        Measured(0.01, None, "narrow", (0.005, 0.015)),
        Measured(0.01, None, "wide", (-0.1, 0.1)),
        Measured(0.1, None, "beyond", (0.05, 0.15)),
        Measured(-0.1, None, "beyond", (-0.15, -0.05)),
    ],
)
def test_a_stored_measurement_is_judged_as_it_was(measured):
    (gate,) = judge("image.equivalence", {"relative_rmse": measured}, pixel_class="interior")
    stored = json.loads(json.dumps(gate.measurement(), allow_nan=False))
    assert not {"passed", "outcome", "limit"} & stored.keys()
    again = judged(stored)
    assert (again.outcome, again.passed, again.line) == (gate.outcome, gate.passed, gate.line)
    assert again.pixel_class == "interior"


def test_an_interval_decides():
    def outcome(low, high):
        return judge("image.equivalence", {"relative_rmse": Measured(0, None, "", (low, high))})[0].outcome

    limit = tolerance("image.equivalence.relative_rmse")
    assert outcome(-limit / 2, limit / 2) == "pass"
    assert outcome(limit / 2, 2 * limit) == "inconclusive"
    assert outcome(2 * limit, 3 * limit) == "fail"
    assert outcome(float("nan"), float("nan")) == "inconclusive"


def test_a_stored_measurement_of_no_gate_is_refused():
    facts = judge("probe.finite", {"nonfinite": 0})[0].measurement()
    with pytest.raises(InputError):
        judged({**facts, "name": "probe.finite.other"})
