"""The path estimator for any list of texels, each with its own number of samples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.sampling.paths import estimator
from btfref.sampling.paths.estimator import PathEstimator, Piece, strata
from btfref.sampling.tiled_scene import START, stream_words, uniforms

if TYPE_CHECKING:
    from btfref.types import JitArray

#: Random streams of a texel with a number of samples of its own: more than anybody asks of one texel.
STREAMS = 1 << 16

#: Lights that a lane counts for at least: the state of a path needs memory too, whatever it is connected to.
LEAST_LIGHTS = 16


@dataclass
class Request:
    """Texels of one view.

    Attributes
    ----------
    view : int
        Number of the view in the full set.
    texel : ndarray (K,) of int
        Numbers of texels, row by row.
    lights : ndarray of int, or None
        Indices of the lights that results are of; None for all. Those of a light do not depend on the others.
    counts : ndarray (K,) of int, or None
        Samples of each texel, even; the settings' for all when not given.
    stream : tuple of int
        Selects other random numbers.
    tag : Any
        What the caller wants to remember.
    """

    view: int
    texel: np.ndarray
    lights: np.ndarray | None = None
    counts: np.ndarray | None = None
    stream: tuple[int, ...] = ()
    tag: Any = None


#: A request, its mean and the variance of its mean.
_Answer: TypeAlias = tuple[Request, np.ndarray, np.ndarray]

#: Texels of a request that share a pass: the request, its results, and which of its texels.
_Share: TypeAlias = tuple[Request, tuple[np.ndarray, ...], np.ndarray]


class TexelPaths(PathEstimator):
    """Radiance of texels of views, by path tracing with light connections; parameters as of `PathEstimator`.

    Parameters
    ----------
    buffer : int, optional
        Memory (bytes) of the sample buffer of one pass.
    """

    def __init__(self, *args: Any, buffer: int | None = None, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.buffer = buffer

    @property
    def samples_per_pass(self) -> int:
        """Pairs of lane and light traced together; a bound on memory, without influence on the result."""
        buffer = min(self.buffer or estimator.SAMPLE_BUFFER, estimator.SAMPLE_BUFFER)
        return max(buffer // 12, 1)

    def estimate(
        self, view: int, texel: np.ndarray, counts: np.ndarray | None = None, stream: tuple[int, ...] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of the mean of some texels of one view for all lights; see `Request`.

        Returns
        -------
        mean, variance : ndarray (n_lights, K, 3), float32
            B in 1/sr.
        """
        ((_, mean, variance),) = self.estimate_all([Request(view, texel, None, counts, stream)])
        return mean, variance

    def estimate_all(self, requests: Iterable[Request]) -> Iterator[_Answer]:
        """Results of requests in their order; those of few lights share passes.

        Parameters
        ----------
        requests : iterable of Request
            Read as far ahead as one pass reaches.

        Yields
        ------
        request, mean, variance : Request, ndarray, ndarray
            As of `estimate`, of the request's lights.
        """
        held: list[_Answer] = []
        parts: list[_Share] = []
        free = self.samples_per_pass
        for request in requests:
            n_lights = len(self.lights) if request.lights is None else len(request.lights)
            # Mean and variance, to which passes add what they find.
            results = tuple(np.zeros((n_lights, len(request.texel), 3), np.float32) for _ in range(2))
            held.append((request, results[0], results[1]))
            for texels, cost in self._pieces(request):
                if parts and (cost > free or request.counts is not None):
                    self._pass(parts)
                    parts, free = [], self.samples_per_pass
                    yield from held[:-1]
                    del held[:-1]
                parts.append((request, results, texels))
                free -= cost
                if request.counts is not None:
                    # Sums of as many samples as each texel has: a pass of its own.
                    self._pass(parts)
                    parts, free = [], self.samples_per_pass
            if not parts:
                yield from held
                held = []
        if parts:
            self._pass(parts)
        yield from held

    def _lit(self, request: Request) -> np.ndarray:
        """Which of the request's lights are above the horizon."""
        vectors = self.lights if request.lights is None else self.lights[request.lights]
        return np.flatnonzero(vectors[:, 2] > 0)

    def _pieces(self, request: Request) -> Iterator[tuple[np.ndarray, int]]:
        """Places of a request's texels that go together, and what they take of a pass."""
        n_lit = len(self._lit(request))
        if self.views[request.view][2] <= 0 or not n_lit or not len(request.texel):
            return
        counts = request.counts
        counts = np.full(len(request.texel), self.spp) if counts is None else np.asarray(counts)
        # Texels of equal counts lie side by side, so that their sums are sums of blocks.
        order = np.argsort(counts, kind="stable")
        ends = np.cumsum(counts[order])
        each = max(n_lit, LEAST_LIGHTS)
        lanes = max(self.samples_per_pass // each, 1)
        first = 0
        while first < len(order):
            start = int(ends[first - 1]) if first else 0
            last = max(int(np.searchsorted(ends, start + lanes, side="right")), first + 1)
            yield order[first:last], (int(ends[last - 1]) - start) * each
            first = last

    def all_views(self, views: Iterable[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield (view, mean, variance) of views: (n_lights, rows, columns, 3) float32, B in 1/sr."""
        n_texels = self.texels[0] * self.texels[1]
        texel = np.arange(n_texels) if self.mask is None else np.flatnonzero(self.mask)

        def full(part: np.ndarray) -> np.ndarray:
            whole = np.zeros((len(self.lights), n_texels, 3), np.float32)
            whole[:, texel] = part
            return whole.reshape(len(self.lights), *self.texels, 3)

        for request, mean, variance in self.estimate_all(Request(int(view), texel) for view in views):
            yield request.view, full(mean), full(variance)

    def _pass(self, parts: Sequence[_Share]) -> None:
        """Trace all samples of some requests' texels and write them to their results."""
        import mitsuba as mi

        pieces, each = [], []
        for request, _, place in parts:
            own = request.counts is not None
            n = np.asarray(request.counts)[place] if own else np.full(len(place), self.spp)
            lights = self.lights if request.lights is None else self.lights[request.lights]
            pieces.append(
                Piece(
                    np.asarray(self.views[request.view], np.float64),
                    stream_words(self.seed, int(request.view), *request.stream),
                    lights[self._lit(request)],
                    int(n.sum()),
                )
            )
            stride = np.full(len(place), STREAMS if own else self.spp, np.uint64)
            each.append((np.asarray(request.texel)[place], n, stride))
        texel, counts, stride = (np.concatenate(a) for a in zip(*each, strict=True))
        sample = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        different, which = np.unique(counts, return_inverse=True)
        split = np.array([strata(int(n)) for n in different], np.uint32)[which]
        self._place = [
            to_device(mi.UInt32, np.repeat(values, counts))
            for values in (texel, split[:, 0], split[:, 1], split[:, 2])
        ]
        self._sample = to_device(mi.UInt32, sample)
        lane = np.repeat(texel.astype(np.uint64) * stride, counts) + sample.astype(np.uint64)
        self._lane = to_device(mi.UInt32, lane % np.uint64(2**32))
        self._paths(pieces)
        own = parts[0][0].counts is not None
        found = [self._sums(pieces[0], counts)] if own else self._statistics(pieces)
        for (request, results, place), some in zip(parts, found, strict=True):
            for result, values in zip(results, some, strict=True):
                result[np.ix_(self._lit(request), place)] = values

    def _stream(self, lane: JitArray) -> JitArray:
        import drjit as dr

        return dr.gather(type(lane), self._lane, lane)

    def _footprint(self, lane: JitArray, keys: Sequence[JitArray], w_view: JitArray) -> JitArray:
        """Start of the view rays: a stratified point of the lane's texel square, moved up along w_view."""
        import drjit as dr
        import mitsuba as mi

        texel, *split = (dr.gather(mi.UInt32, a, lane) for a in self._place)
        # Idle lanes of a SIMD packet gather 0, and whole numbers divided by 0 end the process.
        columns, rows, per_stratum = (dr.maximum(value, 1) for value in split)
        stratum = dr.gather(mi.UInt32, self._sample, lane) // per_stratum
        u, v, _, _ = uniforms(self._stream(lane), keys, mi.UInt32(0))
        u = (mi.Float(stratum % columns) + u) / mi.Float(columns)
        v = (mi.Float(stratum // columns) + v) / mi.Float(rows)
        x = (mi.Float(texel % self.texels[1]) + u) / self.texels[1]
        y = (mi.Float(texel // self.texels[1]) + v) / self.texels[0]
        return dr.fma(mi.Vector3f(w_view), START, mi.Point3f(x, y, 0))

    def _sums(self, piece: Piece, counts: np.ndarray) -> tuple[np.ndarray, ...]:
        """Mean and variance of the mean of blocks of samples; `counts` ascends."""
        import drjit as dr

        # Every count is even, so a stratum holds two samples: their sum, and half their difference squared.
        samples, n_lit = self._buffer, len(piece.lights)
        pairs = dr.block_sum(samples, 2)
        spread = 2 * dr.block_sum(dr.square(samples - dr.repeat(pairs / 2, 2)), 2)
        pairs, spread = (a.numpy().reshape(n_lit, 3, -1) for a in (pairs, spread))
        mean = np.zeros((n_lit, 3, len(counts)), np.float32)
        variance = np.zeros_like(mean)
        begin = 0
        for n in np.unique(counts):
            here = np.flatnonzero(counts == n)
            end = begin + len(here) * n // 2
            for target, values, scale in ((mean, pairs, 1 / n), (variance, spread, 1 / n**2)):
                blocks = values[..., begin:end].reshape(*values.shape[:2], len(here), n // 2)
                target[..., here] = blocks.sum(-1) * np.float32(scale)
            begin = end
        return mean.transpose(0, 2, 1), variance.transpose(0, 2, 1)
