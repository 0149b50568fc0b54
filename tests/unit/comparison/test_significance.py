"""Statistics against simulated noise."""

import numpy as np
import pytest

from btfref.comparison import significance
from btfref.errors import InputError
from btfref.gates import tolerance


def exact(expected):
    return pytest.approx(
        expected, rel=tolerance("metric.closed_form.rtol"), abs=tolerance("metric.closed_form.atol")
    )


def close(expected):
    return pytest.approx(expected, rel=tolerance("metric.library.rtol"), abs=tolerance("metric.library.atol"))


def test_sidak():
    assert significance.sidak(0.05, 1) == exact(0.05)
    assert 1 - (1 - significance.sidak(0.05, 1000)) ** 1000 == close(0.05)
    with pytest.raises(InputError):
        significance.sidak(0.0, 3)


def test_welch_equals_scipy(rng):
    from scipy import stats

    a, b = rng.normal(0, 1, (9, 200)), rng.normal(0.3, 2, (14, 200))
    expected = stats.ttest_ind(a, b, equal_var=False)
    statistic, p = significance.welch_test(
        a.mean(0), a.var(0, ddof=1) / 9, b.mean(0), b.var(0, ddof=1) / 14, n_a=9, n_b=14
    )
    np.testing.assert_allclose(statistic, expected.statistic, rtol=tolerance("metric.library.rtol"))
    np.testing.assert_allclose(p, expected.pvalue, rtol=tolerance("metric.library.rtol"))


def test_exact_values_are_equal_or_not():
    statistic, p = significance.welch_test([1.0, 1.0], 0.0, [1.0, 1.5], 0.0)
    assert p.tolist() == [1.0, 0.0]
    assert statistic.tolist() == [0.0, -np.inf]
    with pytest.raises(InputError, match="variance"):
        significance.welch_test([1.0], -1.0, [1.0], 0.0)


def test_p_values_of_equal_means_are_uniform_and_a_bias_is_found(rng):
    level, slack = (
        tolerance("significance.calibration.significance_parameter"),
        tolerance("significance.calibration.max_deviation"),
    )
    truth = rng.uniform(1, 2, 2000)
    t, r = truth + 0.1 * rng.standard_normal(2000), truth + 0.2 * rng.standard_normal(2000)
    _, p = significance.welch_test(t, 0.01, r, 0.04)
    assert abs(np.mean(p < level) - level) <= slack
    assert abs(np.mean(2 * p < 1) - 0.5) <= tolerance("significance.calibration.max_deviation_at_half")
    assert significance.difference_test(p, significance=level).rejected == 0
    t[7] += 2.0
    found = significance.difference_test(significance.welch_test(t, 0.01, r, 0.04)[1], significance=level)
    assert found.rejected == 1
    assert found.rejected_fraction == exact(1 / 2000)


def test_families_err_as_often_as_they_say(rng):
    level, slack = (
        tolerance("significance.calibration.significance_parameter"),
        tolerance("significance.calibration.max_deviation"),
    )
    noise = rng.standard_normal((2000, 64))
    rejected = [
        significance.difference_test(
            significance.welch_test(row, 1.0, 0 * row, 0.0)[1], significance=level
        ).rejected
        for row in noise
    ]
    assert abs(np.mean(np.array(rejected) > 0) - level) <= slack


@pytest.mark.parametrize("bias", [0.0, 0.02, 0.2])
def test_intervals_hold_the_truth_as_often_as_they_say(rng, bias):
    level, slack = (
        tolerance("significance.calibration.significance_parameter"),
        tolerance("significance.calibration.max_deviation"),
    )
    truth = bias * np.where(np.arange(400) % 2, 1.0, -0.5)
    sigma, hits, estimates = 0.07, {"mean": 0, "known": 0, "halves": 0}, []
    for _ in range(2000):
        halves = truth + sigma * np.sqrt(2) * rng.standard_normal((2, 400))
        found = {
            "mean": (
                significance.bias_interval(halves.mean(0), sigma**2, confidence=1 - level),
                truth.mean(),
            ),
            "known": (
                significance.mse_interval(halves.mean(0), sigma**2, confidence=1 - level),
                np.mean(truth**2),
            ),
            "halves": (
                significance.mse_interval_from_halves(*halves, confidence=1 - level),
                np.mean(truth**2),
            ),
        }
        estimates.append([found["known"][0].estimate, found["halves"][0].estimate])
        for name, (interval, expected) in found.items():
            hits[name] += interval.low <= expected <= interval.high
    for name, count in hits.items():
        assert abs(count / 2000 - (1 - level)) <= slack, name
    standard_error = np.std(estimates, axis=0) / np.sqrt(2000)
    assert (
        np.abs(np.mean(estimates, axis=0) - np.mean(truth**2))
        <= tolerance("significance.calibration.z") * standard_error
    ).all()


def test_intervals_hold_for_channels_that_share_their_noise(rng):
    """Grey noise: the bound is exact there, and intervals that took channels for independent would be too narrow."""
    level, slack = (
        tolerance("significance.calibration.significance_parameter"),
        tolerance("significance.calibration.max_deviation"),
    )
    truth = np.repeat(np.linspace(-0.1, 0.2, 200)[:, None], 3, 1)
    settings, hits = {"confidence": 1 - level}, np.zeros((2, 2))
    for _ in range(2000):
        seen = truth + 0.07 * rng.standard_normal((200, 1))
        for i, correlated in enumerate((3, 1)):
            mean = significance.bias_interval(seen, 0.07**2, correlated=correlated, **settings)
            square = significance.mse_interval(seen, 0.07**2, correlated=correlated, **settings)
            hits[i] += [
                mean.low <= truth.mean() <= mean.high,
                square.low <= np.mean(truth**2) <= square.high,
            ]
    share = hits / 2000
    assert (np.abs(share[0] - (1 - level)) <= slack).all()
    assert (share[1] < 1 - level - slack).all()


def test_rmse_interval_is_never_negative():
    found = significance.rmse_interval(significance.interval(-0.01, 0.02))
    assert found.low == found.estimate == 0
    assert found.high > 0
    assert found.standard_error > 0


@pytest.mark.parametrize(
    ("estimate", "error", "outcome"),
    [
        (0.0, 0.1, "pass"),
        (0.5, 0.1, "pass"),
        (0.9, 0.1, "inconclusive"),
        (0.0, 10.0, "inconclusive"),
        (2.0, 0.1, "fail"),
        (-2.0, 0.1, "fail"),
    ],
)
def test_equivalence_has_three_outcomes(estimate, error, outcome):
    found = significance.equivalence_test(significance.interval(estimate, error), tolerance=1.0)
    assert found.outcome == outcome
    assert found.passed == (outcome == "pass")


def test_equivalence_refuses_nonsense():
    with pytest.raises(InputError):
        significance.equivalence_test(significance.interval(0.0, 1.0), tolerance=0.0)
    with pytest.raises(InputError):
        significance.equivalence_test(significance.interval(0.0, np.inf), tolerance=1.0)


def test_tiles_average_what_counts(rng):
    picture = rng.random((11, 17, 3))
    mask = np.ones((11, 17), bool)
    mask[:8, 8:16] = False
    mask[0, 0] = False
    means, variances = significance.tile_means(picture, np.full(picture.shape, 0.5), mask, size=8)
    assert means.shape == (5, 3)  # six tiles, one of them masked
    block = picture[:8, :8][mask[:8, :8]]
    np.testing.assert_allclose(means[0], block.mean(0), rtol=tolerance("metric.library.rtol"))
    np.testing.assert_allclose(variances[0], 0.5 / 63, rtol=tolerance("metric.library.rtol"))
