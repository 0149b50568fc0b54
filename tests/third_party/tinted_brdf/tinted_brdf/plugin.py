"""Dr.Jit port."""

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.tables import PairTable, as_float32, read_packets


class Evaluator:
    """One table over direction pairs, and a colour a texel."""

    def __init__(self, maps):
        self.views, self.lights = maps.views, maps.lights
        self.shape, self.filter_type = maps.shape, maps.filter_type
        self.update(maps)

    def update(self, maps):
        """Take over changed maps."""
        brdf, tint = maps.tensors["brdf"], maps.tensors["tint"]
        self.brdf = PairTable(type(brdf)(brdf.array, (1, *brdf.shape)), self.lights.following())
        self.tint = as_float32(tint)

    def evaluate(self, uv, w_light, w_view, active):
        """B in 1/sr for valid directions."""
        colour = mi.Color3f(0)
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            value = read_packets(self.tint, texel, 4, active)
            colour = mi.Color3f(*(dr.fma(mi.Float(value[k]), share, colour[k]) for k in range(3)))
        views, lights = self.views.stencil(w_view), self.lights.stencil(w_light, hold=False)
        return colour * self.brdf.combine(mi.UInt32(0), views, lights, [mi.Float(1)], active)
