"""Dr.Jit port of :mod:`btfref.representations.tabulated.raw`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi

from mitsuba_plugins.lib.lookup import texel_stencil
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import PairTable

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


class Evaluator(Port):
    """Interpolates the table of a ``raw`` BTF."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        values = maps.tensors["values"]
        rows, columns, n_views, n_lights, width = values.shape
        table = type(values)(values.array, (rows * columns, n_views, n_lights, width))
        self.values = PairTable(table, self.lights.following())

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, draw: JitArray = None
    ) -> JitArray:
        """B in 1/sr for valid directions."""
        views, lights = self.views.stencil(w_view, draw=draw), self.lights.stencil(w_light, hold=False)
        total = mi.Color3f(0)
        for texel, weight in zip(*texel_stencil(uv, self.shape, self.filter_type), strict=True):
            # Texels without weight are not fetched: they may not be there.
            total += self.values.combine(texel, views, lights, [weight], active & (weight > 0))
        return total
