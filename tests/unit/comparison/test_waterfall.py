"""The error waterfall on pictures whose stages are known."""

import numpy as np
import pytest

from btfref.comparison.parts import part
from btfref.comparison.waterfall import Picture, waterfall
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.images.display import Display

SHAPE = (40, 50, 3)
MASK = np.ones(SHAPE[:2], bool)


def chain(rng, errors, noise=0.05, correlated=0.0):
    """A noisy truth and pictures whose stages have the given RMS, the second one partly along the first."""
    truth = rng.uniform(0.2, 0.8, SHAPE)
    parts = [error * rng.normal(size=SHAPE) for error in errors]
    if correlated:
        parts[1] = parts[1] * np.sqrt(1 - correlated**2) + correlated * errors[1] / errors[0] * parts[0]
    pictures = [Picture("truth", truth + noise * rng.normal(size=(4, *SHAPE)))]
    for k, total in enumerate(np.cumsum(parts, 0)):
        pictures.append(Picture(f"stage {k}", (truth + total)[None]))
    return pictures, parts


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_independent_stages_come_out_and_add_up(rng):
    pictures, parts = chain(rng, (0.03, 0.02, 0.005))
    found = waterfall(pictures, MASK, Display())
    rounding = tolerance("metric.closed_form.rtol")
    for stage, error in zip(found.stages, parts, strict=True):
        assert stage.rmse.low * (1 - rounding) <= rms(error) <= stage.rmse.high * (1 + rounding)
    total = rms(sum(parts)) ** 2
    assert found.total.low <= total <= found.total.high
    assert found.stages[0].rmse.low < found.stages[0].rmse.high  # the truth is noisy
    assert found.stages[1].rmse.low == found.stages[1].rmse.high  # these two pictures are not
    assert found.additive
    assert "add up" in found.explanation
    assert all(gate.passed for gate in found.gates)


@pytest.mark.parametrize("correlation", [-0.6, 0.6])
def test_stages_that_do_not_add_up_say_which(rng, correlation):
    pictures, _ = chain(rng, (0.03, 0.02, 0.005), noise=0.01, correlated=correlation)
    found = waterfall(pictures, MASK, Display())
    assert not found.additive
    largest = found.products[0]
    assert largest.stages == ("stage 0", "stage 1")
    assert largest.correlation == pytest.approx(
        correlation, abs=tolerance("waterfall.correlated.correlation")
    )
    # The products explain what the stages do not, with the right sign and size.
    assert found.covariance.estimate == pytest.approx(
        2 * correlation * 0.03 * 0.02, rel=tolerance("waterfall.correlated.covariance")
    )
    assert sum(p.mse.estimate for p in found.products) == pytest.approx(
        found.covariance.estimate, rel=tolerance("metric.closed_form.rtol")
    )
    assert f"correlation {largest.correlation:.2f}" in found.explanation
    assert found.explained
    assert ("undo" if correlation < 0 else "add to") in found.explanation
    assert found.closure.low <= 0 <= found.closure.high
    assert all(gate.passed for gate in found.gates)


def test_batches_that_share_noise_are_caught(rng):
    """Two batches of one pair are the same: its noise would count as error of the first stage."""
    pictures, _ = chain(rng, (0.03, 0.02))
    batches = pictures[0].batches.copy()
    batches[1] = batches[0]
    found = waterfall([Picture("truth", batches), *pictures[1:]], MASK, Display())
    assert not all(gate.passed for gate in found.gates)
    assert not found.explained


@pytest.mark.parametrize("channels", [3, 1])
def test_intervals_hold_what_they_promise(rng, channels):
    """99 % intervals of a stage's mean square miss the truth about once in a hundred runs, of 200 at most six times.

    Noise of one channel is the same in all three: what a path brings home has nearly one colour.
    """
    missed = 0
    for _ in range(200):
        truth, part = rng.uniform(0.2, 0.8, (8, 9, 3)), 0.03 * rng.normal(size=(8, 9, 3))
        noisy = Picture("truth", truth + 0.03 * rng.normal(size=(4, 8, 9, channels)))
        found = waterfall([noisy, Picture("stage", (truth + part)[None])], np.ones((8, 9), bool), Display())
        missed += not found.stages[0].mse.low <= rms(part) ** 2 <= found.stages[0].mse.high
    assert missed <= 6


def test_batches_that_agree_by_chance_are_no_certainty(rng):
    """One pixel with nearly all of the noise, alike in two batches: the other two say how much it varies."""
    truth = 0.5 + 1e-4 * rng.normal(size=(4, 12, 12, 3))
    truth[:2, 5, 5] += 0.4
    found = waterfall(
        [Picture("truth", truth), Picture("stage", np.full((1, 12, 12, 3), 0.51))], MASK[:12, :12], Display()
    )
    assert found.explained


def test_covariances_hold_what_they_promise(rng):
    """Their 99 % interval too, for stages that share a noisy picture."""
    missed = 0
    for _ in range(200):
        truth, a, b = rng.uniform(0.2, 0.8, (8, 9, 3)), *0.03 * rng.normal(size=(2, 8, 9, 3))
        noise = 0.03 * rng.normal(size=(2, 4, 8, 9, 1))
        chain = [truth + noise[0], truth + a + noise[1], (truth + 1.5 * a + b)[None]]
        named = [Picture(str(k), picture) for k, picture in enumerate(chain)]
        found = waterfall(named, np.ones((8, 9), bool), Display())
        missed += not found.covariance.low <= 2 * np.mean(a * (0.5 * a + b)) <= found.covariance.high
    assert missed <= 6


def test_a_part_of_a_stage_holds_the_choice_of_pixels(rng):
    """The mean square of a few pixels stands for that of all."""
    error, missed = rng.normal(size=(2000, 3)) * rng.uniform(0, 1e-3, (2000, 1)), 0
    for _ in range(100):
        some = rng.choice(2000, 100, replace=False)
        found = part("port", "real time", 0.5 + error[some], np.full((100, 3), 0.5), Display())
        missed += not found.rmse.low <= rms(error) <= found.rmse.high
    assert (found.name, found.of, found.pixels) == ("port", "real time", 100)
    assert missed <= 5


def test_colour_difference_without_the_bias_of_noise(rng):
    """The jackknife comes closer to the noise-free ΔE00 than the plain mean, which noise raises."""
    pictures, parts = chain(rng, (0.05,), noise=0.05)
    exact, _ = chain(np.random.default_rng(20040601), (0.05,), noise=0.0)
    wanted = waterfall(exact, MASK, Display()).stages[0].delta_e00.estimate
    plain = [Picture("truth", pictures[0].mean[None]), pictures[1]]
    raised = waterfall(plain, MASK, Display()).stages[0].delta_e00.estimate
    found = waterfall(pictures, MASK, Display()).stages[0].delta_e00
    assert len(parts) == 1
    left = abs(found.estimate - wanted) / abs(raised - wanted)
    assert left < tolerance("waterfall.jackknife.share")
    assert found.low < wanted < found.high


def test_bad_chains_are_refused(rng):
    pictures, _ = chain(rng, (0.03,))
    with pytest.raises(InputError, match="four"):
        waterfall([Picture("truth", pictures[0].batches[:2]), pictures[1]], MASK, Display())
    with pytest.raises(InputError, match="pixel"):
        waterfall(pictures, ~MASK, Display())
    with pytest.raises(InputError, match="shape"):
        waterfall([pictures[0], Picture("x", pictures[1].batches[:, 1:])], MASK, Display())
    broken = pictures[1].batches.copy()
    broken[0, 3, 4] = np.nan
    with pytest.raises(InputError, match="finite"):
        waterfall([pictures[0], Picture("x", broken)], MASK, Display())
