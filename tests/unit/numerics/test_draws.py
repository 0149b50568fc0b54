"""Drawn interpolation: the neighbour that a number draws, and the numbers."""

import numpy as np
import pytest
from oracle import KINDS
from probes import hemisphere
from scipy import stats

from btfref.gates import tolerance
from btfref.numerics import draws
from btfref.numerics.sphere.directions import directions

#: Stratified numbers: each neighbour gets its weight up to one of them.
N = 1 << 10


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hold", [True, False])
def test_each_neighbour_is_drawn_as_often_as_its_weight_says(kind, hold, rng):
    """Beyond the last ring and inside of the first as well; the weight is that of all."""
    chosen = directions(KINDS[kind][1])
    w = np.concatenate([hemisphere(rng, 60, float), [[0, 0, 1], [0.8, -0.6, 1e-4]]])
    index, weight = chosen.interpolation.stencil(w, hold=hold)
    numbers = np.broadcast_to((np.arange(N) + 0.5) / N, (len(w), N))
    drawn, total = chosen.interpolation.stencil(np.repeat(w[:, None], N, 1), hold=hold, draw=numbers)
    np.testing.assert_allclose(total[..., 0], np.broadcast_to(weight.sum(-1)[:, None], (len(w), N)))
    for row in range(len(w)):
        expected, found = np.zeros(len(chosen)), np.zeros(len(chosen))
        np.add.at(expected, index[row], weight[row])
        np.add.at(found, drawn[row, :, 0], total[row, :, 0] / N)
        # Four neighbours, whose ends fall between two numbers each.
        assert N * np.abs(found - expected).max() <= 4


def test_one_without_weight_is_never_drawn():
    index, weight = np.array([[5, 6, 7, 8]] * 3), np.array([[0.0, 0.5, 0.0, 0.5]] * 3)
    found, total = draws.chosen(index, weight, [0.0, 0.5, 1 - 2**-24])
    assert found[:, 0].tolist() == [6, 8, 8]
    assert total[:, 0].tolist() == [1, 1, 1]


def test_numbers_are_uniform_and_independent():
    """In a picture, between neighbours and between frames; another seed is another picture."""
    numbers = np.stack([draws.of_pixels(64, 64, frame) for frame in range(16)])
    assert numbers.min() >= 0
    assert numbers.max() < 1
    significance = tolerance("drawn.law.significance")
    assert stats.kstest(numbers.ravel(), "uniform").pvalue > significance
    for a, b in (
        (numbers[1:], numbers[:-1]),
        (numbers[:, 1:], numbers[:, :-1]),
        (numbers[..., 1:], numbers[..., :-1]),
    ):
        assert stats.pearsonr(a.ravel(), b.ravel()).pvalue > significance
    assert np.count_nonzero(draws.of_pixels(64, 64, 0, seed=1) == numbers[0]) <= 64


def test_a_lookup_has_one_number():
    """The sign of zero does not count, nor what some ports flush to it; the next number has another draw."""
    w = np.float32([0.6, 0.0, 0.8])
    same = [draws.of_lookups([0.5, y], w * [1, sign, 1]) for y, sign in ((0.0, 1), (-0.0, -1), (1e-40, 1))]
    assert same == [same[0]] * 3
    assert draws.of_lookups([np.nextafter(np.float32(0.5), 1), 0], w) != same[0]
