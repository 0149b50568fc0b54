"""Ports against the definition: what rounded arguments explain is no error, and nothing else is let through."""

import numpy as np
import pytest

from btfref.gates.tolerances import tolerance
from btfref.stress.judging import FEW, port_agreement

N, STEEPNESS = 2000, 600.0

#: A roundoff of 1 in float32.
ROUNDOFF = float(np.finfo(np.float32).eps) / 2


class Steep:
    """Large everywhere but beside x = 0.6, where what is left moves fast."""

    def evaluate(self, uv, w_light, w_view, lod=0.0):
        value = 1 + STEEPNESS * np.abs(np.asarray(w_light, float)[..., :1] - 0.6)
        up = (np.asarray(w_light)[..., 2:] > 0) & (np.asarray(w_view)[..., 2:] > 0)
        return np.where(up, value * np.array([1.0, 0.7, 0.4]), 0.0)


def points(share):
    """Lookups of which ``share`` lie where the value is steep and small."""
    rng = np.random.default_rng(0)
    x = np.where(np.arange(N) < share * N, 0.601, rng.uniform(-0.5, 0.3, N))
    w_light = np.stack([x, np.zeros(N), np.sqrt(1 - x * x)], -1)
    return rng.random((N, 2)), w_light, np.broadcast_to([0.0, 0.0, 1.0], (N, 3)).copy()


def answers(at, moved=0.0, factor=1.0):
    """What a port says that takes the first tenth of its lookups at lights that are off, and is off itself there."""
    uv, w_light, w_view = at
    value = Steep().evaluate(*at)
    n = int(FEW * N)
    off = w_light[:n] + np.array([moved, 0.0, 0.0])
    value[:n] = factor * Steep().evaluate(uv[:n], off, w_view[:n])
    return value


def off_by(ulps):
    return ulps * ROUNDOFF


def test_what_rounding_explains_is_no_error():
    at, allowed = points(FEW / 2), tolerance("probe.agreement.argument_ulps")
    value = answers(at, off_by(allowed / 2))
    error = np.abs(value / Steep().evaluate(*at) - 1).max()
    assert error > tolerance("probe.agreement.max")
    assert port_agreement(value, Steep(), at).passed


@pytest.mark.parametrize(
    ("moved", "factor"),
    [
        (100, 1.0),
        (0, 1 + 2 * tolerance("probe.agreement.max")),
        (3, 1 + 10 * tolerance("probe.agreement.max")),
    ],
)
def test_what_it_does_not_explain_fails(moved, factor):
    at = points(FEW / 2)
    assert not port_agreement(answers(at, off_by(moved), factor), Steep(), at).passed


def test_many_are_a_fault():
    at = points(2 * FEW)
    value = Steep().evaluate(at[0], at[1] + off_by(5) * np.array([1.0, 0.0, 0.0]), at[2])
    assert not port_agreement(value, Steep(), at).passed


def test_below_the_horizon_nothing_is_explained():
    at = points(0.0)
    at[1][0] = (0.6, 0.0, -1e-9)
    at[1][0] /= np.linalg.norm(at[1][0])
    value = Steep().evaluate(*at)
    assert (value[0] == 0).all()
    value[0] = 1.0
    assert not port_agreement(value, Steep(), at).passed


def test_what_is_not_a_number_fails():
    at = points(FEW / 2)
    value = answers(at)
    value[3, 1] = np.nan
    assert not port_agreement(value, Steep(), at).passed
