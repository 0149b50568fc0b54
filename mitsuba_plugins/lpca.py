"""Dr.Jit port of :mod:`btfref.representations.tabulated.lpca`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import PairTable, as_float32, read_packets

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps
    from mitsuba_plugins.lib.lookup import Neighbour


class Evaluator(Port):
    """Combines the interpolated mean and eigen-BRDFs of each texel's cluster."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        weights = maps.tensors["weights"]
        self.basis = PairTable(maps.tensors["basis"], self.lights.following())
        self.weights, self.width = as_float32(weights), weights.shape[-1]
        # Padding of the index map served the shader's texels only.
        self.cluster = mi.UInt32(maps.tensors["cluster"].array)
        self.cluster_stride = maps.tensors["cluster"].shape[-1]

    def _texel(self, texel: JitArray, share: JitArray, active: JitArray) -> tuple[JitArray, list[JitArray]]:
        """Cluster of a texel and the coefficients of its mean and components, times ``share``."""
        # Not fetched without weight: a texel whose cluster is not kept holds no numbers.
        active = active & (share > 0)
        cluster = dr.gather(mi.UInt32, self.cluster, texel * self.cluster_stride, active)
        weights = read_packets(self.weights, texel, self.width, active)[: self.constants["n_components"]]
        return cluster, [mi.Float(share), *(mi.Float(w) * share for w in weights)]

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions; may be slightly negative."""
        views, lights = self.views.stencil(w_view, draw=draw), self.lights.stencil(w_light, hold=False)
        texels = [
            self._texel(texel, share, active)
            for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True)
        ]
        if len(texels) == 1:
            ((cluster, coefficient),) = texels
            return self.basis.combine(cluster, views, lights, coefficient, active)
        if self.basis.differentiated or dr.grad_enabled([c for _, c in texels]):
            # Gradients do not reach variables that a loop captures.
            parts = [self.basis.combine(cluster, views, lights, c, active) for cluster, c in texels]
            return sum(parts[1:], parts[0])
        return self._combine_distinct(texels, views, lights, active)

    def _combine_distinct(
        self,
        texels: list[tuple[JitArray, list[JitArray]]],
        views: list[Neighbour],
        lights: list[Neighbour],
        active: JitArray,
    ) -> JitArray:
        """Sum over texels, with one table lookup per distinct cluster: neighbours mostly share theirs."""
        clusters = [cluster for cluster, _ in texels]
        # Each texel's coefficients join those of the first texel of the same cluster.
        owners = []
        for i, cluster in enumerate(clusters):
            owner = mi.UInt32(i)
            for j in reversed(range(i)):
                owner = dr.select(cluster == clusters[j], j, owner)
            owners.append(owner)
        merged = [
            [
                sum(dr.select(owners[j] == i, texels[j][1][k], 0) for j in range(i, len(texels)))
                for k in range(len(c))
            ]
            for i, (_, c) in enumerate(texels)
        ]
        # The owners in use move to the front, so that the loop below ends after the last of them.
        rank = [mi.UInt32(0)]
        for i in range(1, len(texels)):
            rank.append(rank[-1] + dr.select(owners[i - 1] == i - 1, mi.UInt32(1), 0))
        n_distinct = rank[-1] + dr.select(owners[-1] == len(texels) - 1, mi.UInt32(1), 0)

        def body(step: JitArray, total: JitArray, *_: JitArray) -> tuple[JitArray, JitArray]:
            cluster, coefficient = clusters[0], merged[0]
            for i in range(1, len(texels)):
                here = (rank[i] == step) & (owners[i] == i)
                cluster = dr.select(here, clusters[i], cluster)
                coefficient = [dr.select(here, a, b) for a, b in zip(merged[i], coefficient, strict=True)]
            here = active & (step < n_distinct)
            total = total + self.basis.combine(cluster, views, lights, coefficient, here)
            return step + 1, total

        _, total = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0)),
            lambda step, total: active & (step < n_distinct),
            body,
            label="lpca",
        )
        return total
