"""Dr.Jit port of `btfref.representations.factored`: products of parabolic maps, for ``cmf`` and ``hf``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.representations.factored.definition import FACTORS, index_slots, raised
from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.parabolic import ParabolicMaps, bilinear_stencil, half_difference, unpacked
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import as_float32, read_packets

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


class Evaluator(Port):
    """Multiplies the maps that each texel's index names, and blends texels."""

    def __init__(self, maps: Maps) -> None:
        self.slots = index_slots(maps.meta["constants"])
        super().__init__(maps)

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        tensors = maps.tensors
        self.factors = {
            name: ParabolicMaps(tensors[f"factor_{name}"], self.constants["map_power"])
            for name in FACTORS
            if f"factor_{name}" in tensors
        }
        self.index, self.index_stride = mi.UInt32(tensors["index"].array), tensors["index"].shape[-1]
        self.scale = self._readable(tensors["scale_map"])
        self.half_scale = self._readable(tensors["half_scale"]) if "half_scale" in tensors else None
        self.peak = tensors["scale_peak"].array

    @staticmethod
    def _readable(tensor: JitArray) -> JitArray:
        """Values of a map of scales: floats, or words of four codes."""
        return mi.UInt32(tensor.array) if dr.is_integral_v(tensor.array) else as_float32(tensor)

    @staticmethod
    def _colour(values: JitArray, at: JitArray, power: int, active: JitArray) -> JitArray:
        """Colour ``at`` of a map of scales."""
        if dr.is_integral_v(values):
            colour, factor = unpacked(dr.gather(mi.UInt32, values, at, active))
            colour = mi.Color3f(*colour) * factor
        else:
            colour = mi.Color3f(*(mi.Float(c) for c in read_packets(values, at, 4, active)[:3]))
        return raised(colour, power)

    def _value(
        self, texel: JitArray, stencils: dict[str, tuple[list[JitArray], list[JitArray]]], active: JitArray
    ) -> JitArray:
        """B of one texel but for the fall to the horizon."""

        def read(name: str, term: int) -> JitArray:
            slot = texel * self.index_stride + self.slots[name].start + term
            prototype = dr.gather(mi.UInt32, self.index, slot, active)
            return self.factors[name].lookup(prototype, stencils[name], active)

        n_terms, n_half_terms = self.constants["n_terms"], self.constants["n_half_terms"]
        in_out = mi.Color3f(0)
        for k in range(n_terms):
            peak = dr.gather(mi.Vector4f, self.peak, mi.UInt32(k))
            scale = self._colour(
                self.scale, texel * n_terms + k, self.constants["scale_power"], active
            ) * mi.Color3f(peak.x, peak.y, peak.z)
            in_out += scale * read("p", k) * read("r", k)
        half = mi.Color3f(0)
        for j in range(n_half_terms):
            term = read("q", j)
            if "d" in self.factors:
                term *= read("d", j)
            if self.half_scale is not None:
                term *= self._colour(
                    self.half_scale, texel * n_half_terms + j, self.constants["map_power"], active
                )
            half += term
        return in_out * half

    def evaluate(self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray) -> JitArray:
        """B in 1/sr for valid directions; never negative."""
        h, d = half_difference(w_light, w_view)
        stencils = {
            name: bilinear_stencil(w, self.factors[name].n)
            for name, w in zip(FACTORS, (w_light, h, w_view, d), strict=True)
            if name in self.factors
        }
        total = mi.Color3f(0)
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            total += self._value(texel, stencils, active) * share
        cos_last = self.constants["light_cos_last"]
        return total * dr.minimum(w_light.z / cos_last, 1) if cos_last > 1e-6 else total
