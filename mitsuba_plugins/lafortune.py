"""Dr.Jit port of :mod:`btfref.representations.analytic.lafortune`, and of `lafortune_lut`, which has a factor too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.numerics.powers import FLOOR
from mitsuba_plugins.lib.analytic import held, packet, safe_power
from mitsuba_plugins.lib.lookup import single, texel_stencil
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.proposals import CosineLobes

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps
    from mitsuba_plugins.lib.lookup import Neighbour


class Evaluator(Port):
    """Evaluates the lobes of the neighbouring texels, times the interpolated factor of the view where there is one."""

    #: What samples light directions unless told otherwise; measured by ``btfref bench proposals``.
    sampling = "data"

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        self.n_lobes = self.constants["n_lobes"]
        self.width = maps.tensors["peaks"].shape[-1]
        self.lobes, self.peaks, self.colour = (
            mi.Float(maps.tensors[name].array) for name in ("lobes", "peaks", "colour")
        )
        dr.eval(self.lobes, self.peaks, self.colour)
        self.factors: JitArray = None
        if "factor" in maps.tensors:
            self.factors, self.stride = (
                mi.Float(maps.tensors["factor"].array),
                maps.tensors["factor"].shape[-1],
            )
            dr.eval(self.factors)

    def factor(self, texel: JitArray, views: list[Neighbour], active: JitArray) -> JitArray:
        """View-dependent factor of a texel; 1 where the method has none."""
        if self.factors is None:
            return mi.Float(1)
        total = mi.Float(0)
        for view, weight in single(views):
            total = dr.fma(
                dr.gather(mi.Float, self.factors, texel * self.stride + view, active), weight, total
            )
        return total

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions; never negative."""
        light, fade = held(w_light, self.constants["light_edge"])
        v, _ = held(w_view, self.constants["view_edge"])
        product = light * v
        views = self.views.stencil(w_view, draw=draw)
        total = mi.Color3f(0)
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            red, green, blue, value = packet(self.colour, texel, 4, active)
            peaks = packet(self.peaks, texel, self.width, active)
            lobes = packet(self.lobes, texel, 4 * self.n_lobes, active)
            for j in range(self.n_lobes):
                base = dr.dot(mi.Vector3f(*lobes[4 * j : 4 * j + 3]), product)
                value = dr.fma(peaks[j], safe_power(base, lobes[4 * j + 3]), value)
            value *= share * self.factor(texel, views, active)
            total += value * mi.Color3f(red, green, blue)
        return total * (fade * light.z)

    def proposal(
        self, uv: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> CosineLobes:
        """The lobes of the nearest texel for the view, and its diffuse part; a common factor does not matter."""
        v, _ = held(w_view, self.constants["view_edge"])
        (texel,), _ = texel_stencil(uv, self.shape, "nearest")
        *_, diffuse = packet(dr.detach(self.colour), texel, 4, active)
        peaks = packet(dr.detach(self.peaks), texel, self.width, active)
        values = packet(dr.detach(self.lobes), texel, 4 * self.n_lobes, active)
        lobes = []
        for j in range(self.n_lobes):
            x, y, z, exponent = values[4 * j : 4 * j + 4]
            t = mi.Vector3f(x, y, z) * v
            size = dr.norm(t)
            axis = dr.select(size > FLOOR, t / dr.maximum(size, FLOOR), mi.Vector3f(0, 0, 1))
            # The light's cosine, which the lobe multiplies, is about that of its axis.
            cosine = dr.maximum(axis.z, 1 / (exponent + 2))
            lobes.append((axis, exponent, peaks[j] * safe_power(size, exponent) * cosine))
        return CosineLobes(diffuse * dr.pi, lobes)
