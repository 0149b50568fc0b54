"""Which result says most of a cell, and how results are named."""

import math

import pytest

from btfref.gates import GateResult
from btfref.gates.verdicts import deciding, limit_name, with_class


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
