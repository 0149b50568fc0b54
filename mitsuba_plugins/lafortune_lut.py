"""Dr.Jit port of :mod:`btfref.representations.analytic.lafortune_lut`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_plugins import lafortune
from mitsuba_plugins.lib.analytic import single

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps
    from mitsuba_plugins.lib.lookup import Neighbour


class Evaluator(lafortune.Evaluator):
    """Lobes times the interpolated factor of the view."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        super().update(maps)
        self.factors, self.stride = mi.Float(maps.tensors["factor"].array), maps.tensors["factor"].shape[-1]
        dr.eval(self.factors)

    def factor(self, texel: JitArray, views: list[Neighbour], active: JitArray) -> JitArray:
        """View-dependent factor of a texel."""
        total = mi.Float(0)
        for view, weight in single(views):
            total = dr.fma(
                dr.gather(mi.Float, self.factors, texel * self.stride + view, active), weight, total
            )
        return total
