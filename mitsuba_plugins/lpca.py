"""Dr.Jit port of :mod:`btfref.representations.lpca`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lookup import PairTable, read_packets, texel_stencil


class Evaluator:
    """Combines the interpolated mean and eigen-BRDFs of each texel's cluster."""

    def __init__(self, maps):
        self.views, self.lights = maps.views, maps.lights
        self.shape, self.filter_type = maps.shape, maps.filter_type
        self.n_components = maps.meta["constants"]["n_components"]
        self.update(maps)

    def update(self, maps):
        """Take over changed maps."""
        weights = maps.tensors["weights"]
        self.basis = PairTable(maps.tensors["basis"], self.lights.following())
        self.weights, self.width = weights.array, weights.shape[-1]
        # Padding of the index map served the shader's texels only.
        self.cluster = mi.UInt32(maps.tensors["cluster"].array)
        self.cluster_stride = maps.tensors["cluster"].shape[-1]

    def _texel(self, texel, share, active):
        """Cluster of a texel and the coefficients of its mean and components, times ``share``."""
        cluster = dr.gather(mi.UInt32, self.cluster, texel * self.cluster_stride, active)
        weights = read_packets(self.weights, texel, self.width, active)[: self.n_components]
        return cluster, [mi.Float(share), *(mi.Float(w) * share for w in weights)]

    def _combine(self, cluster, coefficient, views, lights, active):
        table = self.basis.blend(cluster, views, lights, active)
        total = mi.Color3f(0)
        for k, c in enumerate(coefficient):
            total = dr.fma(mi.Color3f(table[3 * k : 3 * k + 3]), c, total)
        return total

    def evaluate(self, uv, w_light, w_view, active):
        """B in 1/sr for valid directions; may be slightly negative."""
        views, lights = self.views.stencil(w_view), self.lights.stencil(w_light, hold=False)
        texels = [
            self._texel(texel, share, active)
            for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True)
        ]
        total = mi.Color3f(0)
        for cluster, coefficient in texels:
            total += self._combine(cluster, coefficient, views, lights, active)
        return total
