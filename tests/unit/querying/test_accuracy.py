"""Errors of answers to noisy rows: the noise is taken out, and the intervals hold the true errors."""

import numpy as np
import pytest

from btfref.comparison.colour import ciede2000, lab
from btfref.gates.tolerances import tolerance
from btfref.querying.accuracy import accuracy


@pytest.fixture(scope="module")
def material():
    """True values, answers that are off by known amounts, and the truth with its noise in two halves."""
    rng = np.random.default_rng(8)
    n = 10_000
    true = rng.uniform(0.05, 0.3, (n, 3))
    value = true + rng.normal(0, 0.02, (n, 3)) + 0.005
    sigma = 0.005
    halves = [true + rng.normal(0, sigma * np.sqrt(2), (n, 3)) for _ in range(2)]
    return true, value, 0.5 * (halves[0] + halves[1]), np.full((n, 3), sigma**2), halves


def test_the_noise_is_taken_out(material):
    true, value, truth, variance, halves = material
    found = accuracy(value, truth, variance, halves)
    exact = {
        "rmse": np.sqrt(np.mean((value - true) ** 2)),
        "mae": np.abs(value - true).mean(),
        "bias": (value - true).mean() / true.mean(),
        "psnr_log": 20 * np.log10(np.quantile(np.log1p(truth), 0.999))
        - 10 * np.log10(np.mean((np.log1p(value) - np.log1p(true)) ** 2)),
        "delta_e00": np.sqrt(
            np.mean(ciede2000(lab(np.clip(np.pi * value, 0, 1)), lab(np.clip(np.pi * true, 0, 1))) ** 2)
        ),
    }
    for name, error in exact.items():
        estimate, low, high = found[name]
        assert low <= error <= high, name
        assert low <= estimate <= high, name
    # The noise makes the plain figure larger than the interval's end.
    plain = np.sqrt(np.mean((value - halves[0]) ** 2))
    assert plain > found["rmse"][2]


def test_rows_that_share_their_errors_say_no_more_than_one(material):
    _, value, truth, variance, halves = material
    once = accuracy(value, truth, variance, halves)
    four = (np.repeat(a, 4, 0) for a in (value, truth, variance, *halves))
    v, q, s, *both = four
    shared = accuracy(v, q, s, both, shared=4)
    for name in ("rmse", "mae", "bias", "psnr_log", "delta_e00"):
        assert shared[name] == pytest.approx(once[name]), name
    low, high = accuracy(v, q, s, both)["rmse"][1:]
    assert high - low < once["rmse"][2] - once["rmse"][1]


def test_absolute_errors_without_halves_are_bounded(material):
    true, value, truth, variance, halves = material
    error = np.abs(value - true).mean()
    wide, narrow = (accuracy(value, truth, variance, some)["mae"] for some in (None, halves))
    assert wide[1] <= error <= wide[2]
    assert narrow[2] - narrow[1] < wide[2] - wide[1]
    assert abs(wide[0] / error - 1) < tolerance("queries.noise.relative")


def test_what_is_right_has_no_error_but_noise(material):
    true, _, truth, variance, halves = material
    found = accuracy(true, truth, variance, halves)
    assert found["rmse"][1] == 0
    assert found["bias"][1] < 0 < found["bias"][2]
    assert found["rmse"][2] < np.sqrt(variance[0, 0])
