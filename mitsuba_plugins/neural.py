"""Dr.Jit port of :mod:`btfref.representations.neural`: the network unrolled, one lookup of interpolated numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.representations.neural.network import HIGHEST, LAYERS, LOWEST, SLOPE
from mitsuba_plugins.lib.analytic import held
from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.parabolic import half_difference
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import as_float32, read_packets

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


class Evaluator(Port):
    """Interpolates the numbers of the neighbouring texels, and runs the network once."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        self.latent, self.width = as_float32(maps.tensors["latent"]), maps.tensors["latent"].shape[-1]
        self.hidden = maps.tensors["layer_2"].shape[0]
        self.scale = as_float32(maps.tensors["colour_scale"])
        self.layers = [as_float32(maps.tensors[name]) for name in LAYERS]

    def evaluate(self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray) -> JitArray:
        """B in 1/sr for valid directions; never negative."""
        light, _ = held(w_light, self.constants["light_edge"])
        view, _ = held(w_view, self.constants["view_edge"])
        half, difference = half_difference(light, view)
        x = [*light, *view, *half, *difference]
        numbers = self._numbers(uv, active)
        for layer in self.layers[:2]:
            gains, biases = numbers[: self.hidden], numbers[self.hidden : 2 * self.hidden]
            numbers = numbers[2 * self.hidden :]
            sums = self._product(x, layer, self.hidden, active)
            x = [dr.fma(g, s, b) for g, s, b in zip(gains, sums, biases, strict=True)]
            x = [dr.maximum(one, one * SLOPE) for one in x]
        exponents = self._product(x, self.layers[2], 4, active)
        colour = [
            dr.exp2(dr.clip(e + b, LOWEST, HIGHEST)) for e, b in zip(exponents[:3], numbers, strict=False)
        ]
        scale = read_packets(self.scale, mi.UInt32(0), 4, active)
        return mi.Color3f(*colour) * mi.Color3f(*(mi.Float(s) for s in scale[:3])) * w_light.z

    def _numbers(self, uv: JitArray, active: JitArray) -> list[JitArray]:
        """The numbers of the texels around a lookup, interpolated."""
        result = [mi.Float(0)] * self.width
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            values = read_packets(self.latent, texel, self.width, active)
            result = [dr.fma(mi.Float(v), share, r) for v, r in zip(values, result, strict=True)]
        return result

    @staticmethod
    def _product(x: list[JitArray], layer: JitArray, width: int, active: JitArray) -> list[JitArray]:
        """A row of numbers times a matrix whose rows have ``width`` numbers."""
        result = [mi.Float(0)] * width
        for row, value in enumerate(x):
            weights = read_packets(layer, mi.UInt32(row), width, active)
            result = [dr.fma(mi.Float(w), value, r) for w, r in zip(weights, result, strict=True)]
        return result
