"""Blocks of views and lights that the shared estimator makes at a time."""

from itertools import pairwise

import numpy as np
import pytest

from btfref.sampling import memory
from btfref.sampling.surface import budget
from btfref.sampling.surface.budget import COUNTABLE, Shares, largest

FACTS = {"n_views": 81, "n_lights": 81, "n_directions": 81, "texels": 256**2, "spp": 10, "split_lights": True}
QUIET = Shares(rays=0.3, hits=0.15)


def parts(size):
    views, lights, _ = size
    return -(-81 // views) * -(-81 // lights)


def test_more_memory_is_never_more_parts():
    sizes = [largest(free << 28, **FACTS, found=QUIET) for free in range(2, 40)]
    sizes = [size for size in sizes if not isinstance(size, int)]
    assert parts(sizes[-1]) == 1
    assert len({parts(size) for size in sizes}) > 3
    assert all(parts(less) >= parts(more) for less, more in pairwise(sizes))


def test_what_is_too_little_says_what_is_enough():
    least = largest(1 << 20, **FACTS, found=QUIET)
    assert isinstance(least, int)
    assert largest(least, **FACTS, found=QUIET)[:2] == (1, 1)
    assert isinstance(largest(least - 1, **FACTS, found=QUIET), int)


def test_results_of_views_are_held_where_lights_are_not_parted():
    free = 8 << 30
    apart, together = (
        largest(free, **FACTS | {"split_lights": split}, found=QUIET) for split in (True, False)
    )
    assert together[1] == 81
    assert together[0] < apart[0]


def test_no_more_than_can_be_counted():
    facts = FACTS | {"n_views": 151, "n_lights": 151, "n_directions": 151, "texels": 400**2}
    views, lights, _ = largest(1 << 50, **facts, found=Shares())
    directions, hits = min(151, views + lights), 2 * 2 * 400**2
    assert hits * directions**2 < COUNTABLE
    assert (views, lights) != (151, 151)


@pytest.mark.parametrize(("texels", "asked"), [((64, 64), False), ((256, 256), True)])
def test_a_small_copy_is_made_only_where_memory_is_scarce(texels, asked):
    calls = []

    def shares():
        calls.append(1)
        return QUIET

    size = memory.blocks(
        8 << 30, estimator="surface", triangles=1000, n_views=81, n_lights=81, n_directions=81, texels=texels,
        shard=texels, spp=10, shares=shares,
    )  # fmt: skip
    assert (size.views, size.lights) == (81, 81)
    assert bool(calls) == asked


def test_a_small_copy_tells_how_a_surface_differs(llvm):
    from btfref.mesostructure import build
    from btfref.numerics.sphere.directions import DirectionSet

    some = DirectionSet.of("3x6").vectors
    flat, rings = (
        budget.shares(surface, some, some, spp=10, max_depth=4) for surface in (build("flat"), build("rings"))
    )
    assert flat.hits == 0.0 < rings.hits < 1
    assert 0 < flat.rays < 4
    assert 0 < rings.rays < 4
    dark = np.array([[0.6, 0.0, -0.8]])
    nothing = budget.shares(build("flat"), some, dark, spp=4, max_depth=4)
    assert nothing == Shares(budget.MORE_RAYS, 0.0)


def test_a_job_is_copied_once_a_process(monkeypatch, llvm):
    from btfref.sampling import fill_views
    from btfref.sampling.synthesis import make_job

    calls = []
    monkeypatch.setattr(budget, "shares", lambda *_, **__: calls.append(1) or QUIET)
    monkeypatch.setattr(fill_views, "_FOUND", {})
    settings = {"texels": 4, "views": "2x4", "lights": "2x4", "spp": 2, "estimator": "surface"}
    # Workers read the job anew for each task.
    found = [fill_views._shares(make_job("flat", None, settings | {"spp": spp})) for spp in (2, 2, 4)]
    assert found == [QUIET] * 3
    assert len(calls) == 2
