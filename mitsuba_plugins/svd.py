"""Dr.Jit port of :mod:`btfref.representations.tabulated.svd`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.tables import PairTable, as_float32, read_packets


class Evaluator:
    """Combines the interpolated basis with the texels' weights."""

    def __init__(self, maps):
        self.views, self.lights = maps.views, maps.lights
        self.shape, self.filter_type = maps.shape, maps.filter_type
        self.n_components = maps.meta["constants"]["n_components"]
        self.update(maps)

    def update(self, maps):
        """Take over changed maps."""
        basis, weights = maps.tensors["basis"], maps.tensors["weights"]
        self.basis = PairTable(type(basis)(basis.array, (1, *basis.shape)), self.lights.following())
        self.weights, self.width = as_float32(weights), weights.shape[-1]

    def evaluate(self, uv, w_light, w_view, active):
        """B in 1/sr for valid directions; may be slightly negative."""
        coefficient = [mi.Float(0)] * self.width
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            for k, value in enumerate(read_packets(self.weights, texel, self.width, active)):
                coefficient[k] = dr.fma(mi.Float(value), share, coefficient[k])
        return self.basis.combine(
            mi.UInt32(0),
            self.views.stencil(w_view),
            self.lights.stencil(w_light, hold=False),
            coefficient[: self.n_components],
            active,
        )
