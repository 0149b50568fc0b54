"""The path estimator for any list of texels, each with its own number of samples."""

from __future__ import annotations

import numpy as np

from btfref.sampling import path_estimator
from btfref.sampling.path_estimator import PathEstimator, strata
from btfref.sampling.tiled_scene import START, stream_keys, uniforms

#: Random streams of a texel with a number of samples of its own: more than anybody asks of one texel.
STREAMS = 1 << 16


class TexelPaths(PathEstimator):
    """`PathEstimator` that is asked for texels instead of whole views; parameters as there.

    Parameters
    ----------
    buffer : int, optional
        Memory (bytes) of the sample buffer of one pass.
    """

    def __init__(self, *args, buffer=None, **settings):
        super().__init__(*args, **settings)
        self.buffer = buffer

    @property
    def lanes_per_pass(self):
        """Samples traced together; a bound on memory, without influence on the result."""
        buffer = min(self.buffer or path_estimator.SAMPLE_BUFFER, path_estimator.SAMPLE_BUFFER)
        return max(buffer // (12 * max(len(self.lit), 1)), 1)

    def estimate(self, view, texel, counts=None, stream=()):
        """Mean and variance of the mean of some texels of one view.

        Parameters
        ----------
        view : int
            Number of the view in the full set.
        texel : ndarray (K,) of int
            Numbers of texels, row by row.
        counts : ndarray (K,) of int, optional
            Samples of each texel, even; `spp` for all when not given.
        stream : tuple of int
            Selects other random numbers.

        Returns
        -------
        mean, variance : ndarray (n_lights, K, 3), float32
            B in 1/sr.
        """
        mean = np.zeros((self.n_lights, len(texel), 3), np.float32)
        variance = np.zeros_like(mean)
        w_view = np.asarray(self.views[view], np.float64)
        if w_view[2] <= 0 or not len(self.lit) or not len(texel):
            return mean, variance
        keys = stream_keys(self.seed, int(view), *stream)
        own = counts is not None
        counts = np.full(len(texel), self.spp) if counts is None else np.asarray(counts)
        # Texels of equal counts lie side by side, so that their sums are sums of blocks.
        order = np.argsort(counts, kind="stable")
        ends = np.cumsum(counts[order])
        first = 0
        while first < len(order):
            start = ends[first - 1] if first else 0
            last = max(np.searchsorted(ends, start + self.lanes_per_pass, side="right"), first + 1)
            chosen = order[first:last]
            part = self._pass(texel[chosen], counts[chosen], w_view, keys, own)
            mean[np.ix_(self.lit, chosen)], variance[np.ix_(self.lit, chosen)] = part
            first = last
        return mean, variance

    def view(self, index, w_view=None):
        """Mean and variance of the mean of one view's texels; see `PathEstimator.view`."""
        n_texels = self.texels[0] * self.texels[1]
        texel = np.arange(n_texels) if self.mask is None else np.flatnonzero(self.mask)
        full = []
        for part in self.estimate(index, texel):
            whole = np.zeros((self.n_lights, n_texels, 3), np.float32)
            whole[:, texel] = part
            full.append(whole.reshape(self.n_lights, *self.texels, 3))
        return tuple(full)

    def _pass(self, texel, counts, w_view, keys, own):
        """Trace all samples of some texels; two (n_lit, texels, 3) arrays."""
        import mitsuba as mi

        sample = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        different, which = np.unique(counts, return_inverse=True)
        split = np.array([strata(int(n)) for n in different], np.uint32)[which]
        self._place = [
            mi.UInt32(np.repeat(values, counts).astype(np.uint32))
            for values in (texel, split[:, 0], split[:, 1], split[:, 2])
        ]
        self._sample = mi.UInt32(sample.astype(np.uint32))
        stride = np.uint64(STREAMS if own else self.spp)
        lane = np.repeat(texel, counts).astype(np.uint64) * stride + sample.astype(np.uint64)
        self._lane = mi.UInt32((lane % np.uint64(2**32)).astype(np.uint32))
        self._paths(len(sample), 0, w_view, keys)
        return self._sums(counts) if own else self._statistics(len(self.lit), len(counts))

    def _stream(self, lane, first):
        import drjit as dr

        return dr.gather(type(lane), self._lane, lane)

    def _footprint(self, lane, keys, w_view):
        """Start of the view rays: a stratified point of the lane's texel square, moved up along w_view."""
        import drjit as dr
        import mitsuba as mi

        texel, *split = (dr.gather(mi.UInt32, a, lane) for a in self._place)
        # Idle lanes of a SIMD packet gather 0, and whole numbers divided by 0 end the process.
        columns, rows, per_stratum = (dr.maximum(value, 1) for value in split)
        stratum = dr.gather(mi.UInt32, self._sample, lane) // per_stratum
        u, v, _, _ = uniforms(self._stream(lane, None), keys, mi.UInt32(0))
        u = (mi.Float(stratum % columns) + u) / mi.Float(columns)
        v = (mi.Float(stratum // columns) + v) / mi.Float(rows)
        x = (mi.Float(texel % self.texels[1]) + u) / self.texels[1]
        y = (mi.Float(texel // self.texels[1]) + v) / self.texels[0]
        return dr.fma(mi.Vector3f(w_view), START, mi.Point3f(x, y, 0))

    def _sums(self, counts):
        """Mean and variance of the mean of blocks of samples; `counts` ascends."""
        import drjit as dr

        # Every count is even, so a stratum holds two samples: their sum, and half their difference squared.
        samples = self._buffer
        pairs = dr.block_sum(samples, 2)
        spread = 2 * dr.block_sum(dr.square(samples - dr.repeat(pairs / 2, 2)), 2)
        pairs, spread = (a.numpy().reshape(len(self.lit), 3, -1) for a in (pairs, spread))
        mean = np.zeros((len(self.lit), 3, len(counts)), np.float32)
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
