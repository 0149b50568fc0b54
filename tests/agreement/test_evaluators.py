"""One truth: every port of the table of evaluators against the float64 definition, for every registered method."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from probes import probe_points

from btfref.comparison.comparison import agreement
from btfref.conventions import FILTER_TYPES
from btfref.registry import methods
from btfref.stress.evaluators import EVALUATORS, PORTS
from btfref.stress.judging import port_agreement

N_PROBES = 12_000
SETS = ("ubo81", "scattered")


def with_filter(representation, filter_type):
    return dataclasses.replace(representation, meta=representation.meta | {"filter_type": filter_type})


def off_texel_edges(uv, shape):
    """Nearest lookups exactly on an edge may round to either texel: keep away from edges by 1e-4 of a texel."""
    size = np.array(shape[::-1], np.float32)
    position = uv.astype(float) * size
    fraction = position - np.floor(position)
    return np.where((fraction < 1e-3) | (fraction > 1 - 1e-3), uv + 0.01 / size, uv).astype(np.float32)


#: Both filters on rings; the filter of texels knows nothing of directions.
CASES = [(s, f) for s in SETS for f in FILTER_TYPES if s == "ubo81" or f == "bilinear"]


@pytest.fixture(scope="module", params=[(k, *case) for k in methods() for case in CASES], ids="-".join)
def case(request, fits):
    """A representation, its file and filter, lookups, and ``definition()`` of them, found once for all ports."""
    key, kind, filter_type = request.param
    path = fits.path(key, kind)
    representation = with_filter(fits(key, kind), filter_type)
    uv, w_light, w_view = probe_points(np.random.default_rng(7), N_PROBES, representation)
    if filter_type == "nearest":
        uv = off_texel_edges(uv, representation.meta["texels"])
    points = uv, w_light, w_view
    return representation, path, filter_type, points, cache(lambda: representation.evaluate(*points))


def assert_agrees(value, representation, points, reference=None):
    for gate in port_agreement(value, representation, points, reference=reference).gates:
        assert gate.passed, gate.line


@pytest.mark.parametrize("port", PORTS)
def test_every_port_agrees(case, port, evaluator):
    representation, path, filter_type, points, definition = case
    value = evaluator(port, representation, path, filter_type=filter_type).evaluate(*points)
    assert_agrees(value, representation, points, definition())


@pytest.mark.parametrize("key", methods())
def test_swapped_directions_are_caught(key, fits):
    """A BTF is not reciprocal: an evaluator that swaps light and view must not pass."""
    representation = fits(key)
    uv, w_light, w_view = probe_points(np.random.default_rng(7), 2000, representation)
    swapped = representation.evaluate(uv, w_view, w_light)
    assert not agreement(swapped, representation.evaluate(uv, w_light, w_view)).passed


@pytest.mark.parametrize("key", methods())
def test_invalid_lookups_are_zero_everywhere(key, fits, evaluator):
    """Below the horizon, NaN, infinite: exactly 0 in all evaluators; non-finite uv count as 0."""
    representation = fits(key)
    subjects = [evaluator(name, representation, fits.path(key)) for name in EVALUATORS]
    up, nan, inf = [0, 0, 1], [np.nan, 0, 1], [0, 0, np.inf]
    down, flat = [0.6, 0, -0.8], [1, 0, 0]
    pairs = [(down, up), (up, down), (flat, up), (up, flat), (nan, up), (up, nan), (inf, up), (up, inf)]
    w_light, w_view = (np.array([p[i] for p in pairs], np.float32) for i in (0, 1))
    uv = np.full((len(pairs), 2), 0.3, np.float32)
    for subject in subjects:
        np.testing.assert_array_equal(subject.evaluate(uv, w_light, w_view), 0)

    uv = np.array([[np.nan, 0.2], [np.inf, 0.2], [-np.inf, np.nan], [1e6, -1e6], [3e38, 0]], np.float32)
    up = np.broadcast_to(np.float32(up), (len(uv), 3))
    for subject in subjects:
        assert_agrees(subject.evaluate(uv, up, up), representation, (uv, up, up))
