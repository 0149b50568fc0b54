"""Dr.Jit port of :mod:`btfref.representations.neural`: the network unrolled, one lookup of interpolated numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
from drjit import nn

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
        self.packed = []
        if dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
            tensors = [
                mi.TensorXf(dr.detach(a), maps.tensors[n].shape)
                for n, a in zip(LAYERS, self.layers, strict=True)
            ]
            self.packed = list(nn.pack(*tensors))

    @property
    def differentiated(self) -> bool:
        """Whether gradients by a map are being recorded."""
        return any(map(dr.grad_enabled, (self.latent, self.scale, *self.layers)))

    def evaluate(self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray) -> JitArray:
        """B in 1/sr for valid directions; never negative."""
        light, _ = held(w_light, self.constants["light_edge"])
        view, _ = held(w_view, self.constants["view_edge"])
        half, difference = half_difference(light, view)
        x = [*light, *view, *half, *difference]
        numbers = self._numbers(uv, active)
        # All lookups share the matrices: cooperative vectors read a weight once for all lanes, and compile five times
        # as fast. On CUDA they depend on the driver; the code for gradients is straight-line.
        together = self.packed and not self.differentiated and not dr.grad_enabled(x, numbers)
        layers = self.packed if together else self.layers
        for layer in layers[:2]:
            gains, biases = numbers[: self.hidden], numbers[self.hidden : 2 * self.hidden]
            numbers = numbers[2 * self.hidden :]
            sums = self._product(x, layer, self.hidden, active)
            x = [dr.fma(g, s, b) for g, s, b in zip(gains, sums, biases, strict=True)]
            x = [dr.maximum(one, one * SLOPE) for one in x]
        exponents = self._product(x, layers[2], 4, active)
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
    def _product(
        x: list[JitArray], layer: JitArray | nn.MatrixView, width: int, active: JitArray
    ) -> list[JitArray]:
        """A row of numbers times a matrix whose rows have ``width`` numbers."""
        if isinstance(layer, nn.MatrixView):
            return list(nn.matvec(layer, nn.CoopVec(*map(mi.Float, x)), transpose=True))
        result = [mi.Float(0)] * width
        for row, value in enumerate(x):
            weights = read_packets(layer, mi.UInt32(row), width, active)
            result = [dr.fma(mi.Float(w), value, r) for w, r in zip(weights, result, strict=True)]
        return result
