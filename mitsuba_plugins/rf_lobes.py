"""Dr.Jit port of :mod:`btfref.representations.analytic.rf_lobes`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.analytic import held, packet, parabolic_axis, unit_lobe
from mitsuba_plugins.lib.lookup import single, texel_stencil
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.proposals import CosineLobes

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


class Evaluator(Port):
    """Evaluates the lobes of the neighbouring texels and views."""

    #: What samples light directions unless told otherwise; measured by ``btfref bench proposals``.
    sampling = "both"

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        self.n_lobes, self.n_views = self.constants["n_lobes"], maps.tensors["lobes"].shape[2]
        self.lobes = mi.Float(maps.tensors["lobes"].array)
        self.colour = mi.Float(maps.tensors["colour"].array)
        dr.eval(self.lobes, self.colour)

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions; never negative."""
        light, fade = held(w_light, self.constants["light_edge"])
        views = single(self.views.stencil(w_view, draw=draw))
        total = mi.Color3f(0)
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            red, green, blue, diffuse = packet(self.colour, texel, 4, active)
            value = diffuse * light.z
            for view, weight in views:
                lobes = packet(self.lobes, texel * self.n_views + view, 4 * self.n_lobes, active)
                for j in range(self.n_lobes):
                    s, t, exponent, peak = lobes[4 * j : 4 * j + 4]
                    value = dr.fma(peak * weight, unit_lobe(parabolic_axis(s, t), light, exponent), value)
            total += (value * share) * mi.Color3f(red, green, blue)
        return total * fade

    def proposal(
        self, uv: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> CosineLobes:
        """The lobes of the neighbouring views and the diffuse part, of the nearest texel: all four texels halve the
        variance once more on glossy rings, and cost what that gains elsewhere.
        """  # noqa: D205
        (texel,), _ = texel_stencil(uv, self.shape, "nearest")
        *_, diffuse = packet(dr.detach(self.colour), texel, 4, active)
        lobes = []
        for view, weight in single(self.views.stencil(w_view, draw=draw)):
            values = packet(dr.detach(self.lobes), texel * self.n_views + view, 4 * self.n_lobes, active)
            for j in range(self.n_lobes):
                s, t, exponent, peak = values[4 * j : 4 * j + 4]
                lobes.append((parabolic_axis(s, t), exponent, peak * weight))
        return CosineLobes(diffuse * dr.pi, lobes)
