"""Fill views of a store, within a budget of memory: what a single process does, alone or as one of many.

What is made together, in which order and by which process has no influence on any byte.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from btfref.sampling.memory import blocks
from btfref.sampling.paths import adaptive
from btfref.sampling.store.selection import Selection
from btfref.sampling.store.writing import Writer
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from btfref.sampling.job import Job
    from btfref.sampling.memory import Blocks
    from btfref.sampling.paths.adaptive import Plan
    from btfref.sampling.paths.texels import Request
    from btfref.sampling.store.store import BTFStore
    from btfref.sampling.surface.budget import Shares

_Indices = TypeVar("_Indices", list[int], np.ndarray)

#: Streams of random numbers of a synthesis to a target error.
_PILOT, _ESTIMATE = 1, 2


def fill_views(
    job: Job,
    store: BTFStore,
    views: Iterable[int],
    *,
    stage: str,
    only: Selection | None = None,
    plan: Plan | None = None,
    memory: int,
    done: Callable[[int], object] | None = None,
) -> None:
    """Make what is missing of some views.

    Parameters
    ----------
    job : Job
    store : BTFStore
    views : sequence of int
    stage : {"pilot", "synthesis"}
        What is made: the pilot of a synthesis to a target error, or values.
    only : Selection, optional
        Lights and tiles that are wanted; all when not given. Pilots are made of everything.
    plan : Plan, optional
        Of a synthesis to a target error.
    memory : int
        Budget of this process, bytes.
    done : callable, optional
        Called as ``done(view)`` when a view is made; it may still be on its way to its files.

    Raises
    ------
    InputError
        A budget that is too small, or a value that cannot be stored.
    """
    views = [int(view) for view in views]
    if not views:
        return
    shard = tuple(a * b for a, b in zip(store.shard, store.tile, strict=True))
    surface = job.settings.estimator == "surface"
    size = blocks(
        memory,
        estimator=job.settings.estimator,
        triangles=sum(len(part.faces) for part in job.mesostructure.parts),
        n_views=len(views),
        n_lights=len(job.lights),
        n_directions=len(np.unique(np.round([*job.views.vectors[views], *job.lights.vectors], 6), axis=0)),
        texels=job.texels,
        shard=shard,
        spp=job.settings.samples if job.settings.target_error is None else adaptive.SURFACE_POINTS,
        # Means over all lights decide how many passes there are: they are made at once.
        split_lights=job.settings.target_error is None,
        shares=partial(_shares, job) if surface else None,
    )
    work = {
        ("path", "pilot"): _pilot_by_texels,
        ("path", "synthesis"): _fill_by_texels,
        ("surface", "pilot"): _pilot_by_views,
        ("surface", "synthesis"): _fill_by_views if plan is None else _fill_by_passes,
    }[job.settings.estimator, stage]
    with mitsuba_variant(job.settings.variant), Writer(store, size.queue) as writer:
        for view in work(job, writer, views, only or Selection(), plan, size):
            if done is not None:
                done(view)


#: Shares of the last job, by its attributes: a worker is given the same job with each of its tasks.
_FOUND: dict[str, Shares] = {}


def _shares(job: Job) -> Shares:
    """What a small copy of a synthesis by surface points meets; made once a job and process."""
    from btfref.sampling.surface.budget import shares

    key = json.dumps(job.attributes, sort_keys=True, default=str)
    if key not in _FOUND:
        _FOUND.clear()
        with mitsuba_variant(job.settings.variant):
            _FOUND[key] = shares(
                job.mesostructure,
                job.views.vectors,
                job.lights.vectors,
                spp=job.settings.samples if job.settings.target_error is None else adaptive.SURFACE_POINTS,
                max_depth=job.settings.max_depth,
            )
            _give_back()
    return _FOUND[key]


def _regions(store: BTFStore) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Texels of one file each: rows and columns of texels, and its tiles."""
    rows, columns = store.coverage_shape
    for first_row in range(0, rows, store.shard[0]):
        for first_column in range(0, columns, store.shard[1]):
            last = min(first_row + store.shard[0], rows), min(first_column + store.shard[1], columns)
            tiles = np.mgrid[first_row : last[0], first_column : last[1]].reshape(2, -1)
            row, column = (
                slice(a * t, min(b * t, n))
                for a, b, t, n in zip((first_row, first_column), last, store.tile, store.texels, strict=True)
            )
            yield row, column, tiles


# --- paths: texel by texel


def _fill_by_texels(
    job: Job, writer: Writer, views: list[int], only: Selection, plan: Plan | None, size: Blocks
) -> Iterator[int]:
    store = writer.store
    *_, tiles = only.indices(store)
    pairs = only.wanted(store)
    wanted = np.zeros(store.coverage_shape, bool)
    wanted[tiles] = True
    estimator = job.make_estimator(views, buffer=size.buffer)
    requests = _requests(store, views, pairs, wanted, plan)
    for request, mean, variance in estimator.estimate_all(requests):
        row, column, chosen, inside, last = request.tag
        if len(request.texel):
            shape = (len(request.lights), *inside.shape, 3)
            result = []
            for values in (mean, variance)[: 1 + store.has_variance]:
                if not inside.all():
                    whole = np.zeros(shape, np.float32)
                    whole[:, inside] = values
                    values = whole
                result.append(values.reshape(shape))
            if plan is not None:
                _record_part(store, request.view, row, column, inside, adaptive.texel_means(*result))
            origin = (row.start, column.start)
            writer.write_part(request.view, request.lights, tuple(chosen), *result, origin=origin)
        if last:
            yield request.view


def _requests(
    store: BTFStore, views: list[int], pairs: np.ndarray, wanted: np.ndarray, plan: Plan | None
) -> Iterator[Request]:
    """What is missing of some views, file by file; with where it goes, and whether it is the last of its view."""
    from btfref.sampling.paths.texels import Request

    regions = list(_regions(store))
    for view in views:
        absent = pairs[view][:, None, None] & wanted & ~store.covered(view)
        lights, missing = np.flatnonzero(absent.any((1, 2))), absent.any(0)
        counts: np.ndarray | None = None
        stream: tuple[int, ...] = ()
        if plan is not None:
            counts, stream = plan.counts(store.read_map("pilot", view)), (_ESTIMATE,)
            store.write_map("samples", view, counts)
        for number, (row, column, region) in enumerate(regions, 1):
            inside = missing[np.ix_(_tile_of(row, store.tile[0]), _tile_of(column, store.tile[1]))]
            rows, columns = np.nonzero(inside)
            texel = (row.start + rows) * store.texels[1] + column.start + columns
            yield Request(
                view,
                texel,
                lights,
                None if counts is None else counts.ravel()[texel],
                stream,
                (row, column, region[:, missing[region[0], region[1]]], inside, number == len(regions)),
            )


def _tile_of(part: slice, side: int) -> np.ndarray:
    return np.arange(part.start, part.stop) // side


def _pilot_by_texels(
    job: Job, writer: Writer, views: list[int], only: Selection, plan: Plan | None, size: Blocks
) -> Iterator[int]:
    store = writer.store
    estimator = job.make_estimator(views, buffer=size.buffer)
    columns = store.texels[1]
    for view in views:
        pilot = np.zeros((*store.texels, 3), np.float32)
        for row, column, _ in _regions(store):
            texel = (np.arange(row.start, row.stop)[:, None] * columns + np.arange(columns)[column]).ravel()
            counts = np.full(len(texel), adaptive.PILOT)
            one, two = (estimator.estimate(view, texel, counts, (_PILOT, k)) for k in (0, 1))
            found = adaptive.pilot_map(one, two, adaptive.PILOT)
            pilot[row, column] = found.reshape(row.stop - row.start, column.stop - column.start, 3)
        store.write_map("pilot", view, pilot)
        yield view


# --- surface points: whole views


def _fill_by_views(
    job: Job, writer: Writer, views: list[int], only: Selection, plan: Plan | None, size: Blocks
) -> Iterator[int]:
    store = writer.store
    *_, tiles = only.indices(store)
    pairs = only.wanted(store)
    mask = None if len(tiles[0]) == np.prod(store.coverage_shape) else only.mask(store)
    for group in _groups(views, size.views):
        lights = np.flatnonzero(pairs[group].any(0))
        for chosen in _groups(lights, size.lights):
            estimator = job.make_estimator(group, lights=chosen, mask=mask, buffer=size.buffer)
            for view, mean, variance in estimator.all_views(group):
                mine = pairs[view, chosen]
                # A slice copies nothing; these arrays are large.
                some = slice(None) if mine.all() else mine
                if mine.any():
                    spread = variance[some] if store.has_variance else None
                    writer.write_part(view, chosen[mine], tiles, mean[some], spread)
                if len(chosen) == len(lights):
                    yield view
            del estimator
            _give_back()
        if size.lights < len(lights):
            yield from group


def _give_back() -> None:
    """Memory that Dr.Jit keeps for arrays of the sizes of an estimator that is gone: the next one's differ."""
    import drjit as dr

    dr.flush_malloc_cache()


def _groups(items: _Indices, size: int) -> list[_Indices]:
    return [items[first : first + size] for first in range(0, len(items), size)]


def _passes(
    job: Job, group: list[int], passes: dict[int, int], buffer: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Sums over passes of independent points: (view, mean, variance of the mean) of each view."""
    sums: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for number in range(max(passes.values())):
        still = [view for view in group if passes[view] > number]
        estimator = job.make_estimator(
            still, spp=adaptive.SURFACE_POINTS, stream=(_ESTIMATE, number), buffer=buffer
        )
        for view, mean, variance in estimator.all_views(still):
            if view not in sums:
                sums[view] = mean.copy(), variance.copy()
            else:
                for total, term in zip(sums[view], (mean, variance), strict=True):
                    total += term
        del estimator
        _give_back()
        for view in group:
            if passes[view] == number + 1:
                mean, variance = sums.pop(view)
                yield view, mean / np.float32(passes[view]), variance / np.float32(passes[view] ** 2)


def _fill_by_passes(
    job: Job, writer: Writer, views: list[int], only: Selection, plan: Plan | None, size: Blocks
) -> Iterator[int]:
    store = writer.store
    assert plan is not None, "passes are counted by a plan"
    _, lights, tiles = only.indices(store)
    counts = {view: plan.counts(store.read_map("pilot", view)) for view in views}
    passes = {view: int(counts[view].max()) for view in views}
    # Views of alike numbers of passes go together, so that most passes are of all views of their group.
    order = sorted(views, key=lambda view: (passes[view], view))
    for group in _groups(order, size.views):
        for view in group:
            store.write_map("samples", view, counts[view] * adaptive.SURFACE_POINTS)
        for view, mean, variance in _passes(job, group, passes, size.buffer):
            store.write_map("reached", view, adaptive.texel_means(mean, variance))
            writer.write_part(view, lights, tiles, mean, variance)
            yield view


def _pilot_by_views(
    job: Job, writer: Writer, views: list[int], only: Selection, plan: Plan | None, size: Blocks
) -> Iterator[int]:
    store = writer.store
    for group in _groups(views, size.views):
        estimator = job.make_estimator(
            group, spp=adaptive.SURFACE_POINTS, stream=(_PILOT, 0), buffer=size.buffer
        )
        for view, mean, variance in estimator.all_views(group):
            # Sums over a view are what matters here: one pilot will do for both.
            store.write_map("pilot", view, adaptive.pilot_map((mean, variance), (mean, variance), 1))
            yield view
        del estimator
        _give_back()


def _record_part(
    store: BTFStore, view: int, row: slice, column: slice, inside: np.ndarray, means: np.ndarray
) -> None:
    """Note what was reached in some texels of a view; the others keep what is known of them."""
    whole = store.read_map("reached", view)
    part = whole[row, column]
    whole[row, column] = np.where(inside[..., None], means, part)
    store.write_map("reached", view, whole)
