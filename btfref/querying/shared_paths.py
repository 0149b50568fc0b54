"""Paths that serve several rows: the lights of some rows in turn are connected to the same paths.

Rows of a group share place, footprint, view and every vertex of their paths; each has a light of its own. A row's mean
is as unbiased, and its variance as true, as without sharing, but the errors of the rows of a group are correlated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from btfref.querying.paths import LANES, RowPaths

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.querying.settings import QuerySettings
    from btfref.types import JitArray


class SharedPaths(RowPaths):
    """Samples of rows in groups of ``settings.lights_per_path``, by their numbers.

    Parameters
    ----------
    mesostructure, settings, stream
        As of `btfref.querying.paths.RowPaths`.
    """

    def __init__(self, mesostructure: Mesostructure, settings: QuerySettings, stream: int = 0) -> None:
        super().__init__(mesostructure, settings, stream)
        self.group = settings.lights_per_path

    def samples(
        self, rows: Mapping[str, np.ndarray], number: np.ndarray, count: int, first: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `btfref.querying.paths.RowPaths.samples`; a group is traced for any of its rows that are asked for."""
        mean, variance = (np.zeros((len(number), 3), np.float32) for _ in range(2))
        groups, of = np.unique(number // self.group, return_inverse=True)
        step = max(1, LANES // (count * self.group))
        for start in range(0, len(groups), step):
            some = np.flatnonzero((of >= start) & (of < start + step))
            part = {name: values[some] for name, values in rows.items()}
            slot = (of[some] - start) * self.group + number[some] % self.group
            found = self._groups(part, groups[start : start + step], slot, count, first)
            mean[some], variance[some] = found
        return mean, variance

    def _groups(
        self, rows: Mapping[str, np.ndarray], groups: np.ndarray, slot: np.ndarray, count: int, first: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of rows by their slots: group after group, ``self.group`` slots each."""
        n = len(groups)
        lights = np.zeros((n * self.group, 3), np.float32)  # 0 where nobody asks
        lights[slot] = rows["w_light"]
        # Any row of a group has its place, footprint and view.
        member = np.zeros(n, int)
        member[slot // self.group] = np.arange(len(slot))
        shared = {name: rows[name][member] for name in ("uv", "radius", "w_view")} | {"w_light": lights}
        mean, variance = self._pass(shared, groups, count, first)
        return mean[slot], variance[slot]

    def _answers(self, n: int) -> int:
        return n * self.group

    def _connect(
        self,
        interaction: JitArray,
        bsdf: JitArray,
        context: JitArray,
        throughput: JitArray,
        lane: JitArray,
        active: JitArray,
        *,
        first_vertex: bool,
    ) -> None:
        """Add throughput · f cos · visibility of each of the group's lights to that row's samples."""
        import drjit as dr
        import mitsuba as mi

        group, lights, channels = self._row_of(lane), self._lights, self._channels
        number, spp = (dr.opaque(mi.UInt32, n) for n in (self.group, self._layout[1]))
        sample = dr.gather(mi.UInt32, self._sample, lane)

        def connect(i: JitArray) -> tuple[JitArray]:
            slot = dr.fma(group, number, i)
            w_light = dr.gather(mi.Vector3f, lights, slot)
            asked = active & (w_light.z > 0)
            value, lit = self._light(interaction, bsdf, context, throughput, w_light, asked)
            index = dr.fma(slot, spp, sample)
            for channel, buffer in enumerate(channels):
                # Each lane owns its entries: no atomics.
                if first_vertex:
                    dr.scatter(buffer, dr.select(lit, value[channel], 0), index)
                else:
                    dr.scatter_add(buffer, value[channel], index, lit, mode=dr.ReduceMode.NoConflicts)
            return (i + 1,)

        begin = mi.UInt32(0) + dr.zeros(mi.UInt32, dr.width(lane))
        dr.while_loop((begin,), lambda i: i < number, connect)
