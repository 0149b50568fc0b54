"""Dr.Jit port of :mod:`btfref.representations.tabulated.svd`."""

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


class Evaluator(Port):
    """Combines the interpolated basis with the texels' weights."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        basis, weights = maps.tensors["basis"], maps.tensors["weights"]
        self.basis = PairTable(type(basis)(basis.array, (1, *basis.shape)), self.lights.following())
        self.weights, self.width = as_float32(weights), weights.shape[-1]

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions; may be slightly negative."""
        coefficient = [mi.Float(0)] * self.width
        for texel, share in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            for k, value in enumerate(read_packets(self.weights, texel, self.width, active)):
                coefficient[k] = dr.fma(mi.Float(value), share, coefficient[k])
        return self.basis.combine(
            mi.UInt32(0),
            self.views.stencil(w_view, draw=draw),
            self.lights.stencil(w_light, hold=False),
            coefficient[: self.constants["n_components"]],
            active,
        )
