"""Dr.Jit port of :mod:`btfref.representations.analytic.rf_poly`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.analytic import held, packet
from mitsuba_plugins.lib.lookup import single, texel_stencil
from mitsuba_plugins.lib.port import Port

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


class Evaluator(Port):
    """Evaluates the polynomials of the neighbouring texels and views."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        self.n_views = maps.tensors["polynomial"].shape[2]
        self.polynomial = mi.Float(maps.tensors["polynomial"].array)
        self.chroma = mi.Float(maps.tensors["chroma"].array)
        dr.eval(self.polynomial, self.chroma)

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions; may be negative."""
        light, fade = held(w_light, self.constants["light_edge"])
        terms = [light.x * light.x, light.y * light.y, light.x * light.y, light.x, light.y, light.z * light.z]
        views = single(self.views.stencil(w_view, draw=draw))
        total = mi.Color3f(0)
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            value = mi.Float(0)
            for view, weight in views:
                a = packet(self.polynomial, texel * self.n_views + view, 8, active)
                one = mi.Float(0)
                for coefficient, term in zip(a, terms, strict=False):
                    one = dr.fma(coefficient, term, one)
                value = dr.fma(one, weight, value)
            colour = packet(self.chroma, texel, 4, active)
            total += (value * share) * mi.Color3f(*colour[:3])
        return total * fade
