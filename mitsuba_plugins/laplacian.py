"""Dr.Jit port of :mod:`btfref.representations.laplacian.definition`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.numerics.footprint import ANISOTROPY
from btfref.numerics.ycbcr import TO_RGB
from mitsuba_plugins.lib.analytic import held, safe_power
from mitsuba_plugins.lib.footprint import probes
from mitsuba_plugins.lib.lookup import Neighbour, texel_stencil
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import PairTable, as_float32, read_packets

if TYPE_CHECKING:
    from collections.abc import Sequence

    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps


#: Sums are split at multiples of this: their upper parts add up without rounding. The channels and levels of a dark
#: value cancel, and the rounding of a plain sum would then show; see shaders/lib/numbers/split_sum.glsl.
QUANTUM = 2.0**-14


class SplitSum:
    """A sum of colours in two parts."""

    DRJIT_STRUCT = {"high": mi.Color3f, "rest": mi.Color3f}  # noqa: RUF012 - read by Dr.Jit

    def __init__(self, high: JitArray = None, rest: JitArray = None) -> None:
        self.high = mi.Color3f(0) if high is None else high
        self.rest = mi.Color3f(0) if rest is None else rest

    def plus(self, term: JitArray) -> SplitSum:
        """The sum with a further colour."""
        high = dr.floor(dr.fma(term, 1 / QUANTUM, 0.5)) * QUANTUM
        return SplitSum(self.high + high, self.rest + (term - high))

    def value(self) -> JitArray:
        """The colour."""
        return self.high + self.rest


class Bands(PairTable):
    """Table whose entries hold components of Y, Cb and Cr in turn, each with its own coefficient."""

    def __init__(self, values: JitArray, following: np.ndarray | None, counts: Sequence[int]) -> None:
        self.ends = np.cumsum([0, *counts]).tolist()
        super().__init__(values, following)

    def _needed(self, coefficients: list[JitArray]) -> int:
        return self.ends[-1]

    def _blend(
        self, total: SplitSum, values: list[JitArray], coefficients: list[JitArray], weight: JitArray
    ) -> SplitSum:
        colour = []
        for start, end in zip(self.ends, self.ends[1:], strict=False):
            part = mi.Float(0)
            for i in range(start, end):
                part = dr.fma(values[i], coefficients[i], part)
            colour.append(part)
        return total.plus(mi.Color3f(*colour) * weight)


class Evaluator(Port):
    """Sums the levels from ⌊λ⌋ on; finer ones are neither looked up nor computed."""

    def __init__(self, maps: Maps) -> None:
        constants = maps.meta["constants"]
        self.nearest = bool(constants["nearest_directions"])
        self.counts = [int(constants[f"n_{name}"]) for name in ("y", "cb", "cr")]
        self.edges = constants["light_edge"], constants["view_edge"]
        self.n_levels, self.max_lod = int(constants["n_levels"]), float(constants["max_lod"])
        levels = maps.meta["levels"][: self.n_levels]
        # Tables begin with the finest level that is kept.
        self.first_level = int(constants.get("first_level", 0))
        self.base = min(self.first_level, self.n_levels - 1)
        self.shapes = [(level["rows"], level["columns"]) for level in levels]
        first = np.cumsum([0, *(r * c for r, c in self.shapes)])[:-1]
        first = np.maximum(first - first[self.base], 0)
        self.sizes = to_device(
            mi.UInt32, [[r, c, f, 0] for (r, c), f in zip(self.shapes, first, strict=True)]
        )
        dr.eval(self.sizes)
        super().__init__(maps)

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        tensors = maps.tensors
        self.basis = Bands(tensors["basis"], self.lights.following(), self.counts)
        self.weights, self.width = as_float32(tensors["weights"]), tensors["weights"].shape[-1]
        self.mean, self.phong = None, None
        if "mean" in tensors:
            mean = tensors["mean"]
            self.mean = Bands(type(mean)(mean.array, (1, *mean.shape)), self.lights.following(), (1, 1, 1))
        else:
            self.phong = as_float32(tensors["phong"])

    def evaluate(
        self,
        uv: JitArray,
        w_light: JitArray,
        w_view: JitArray,
        active: JitArray,
        lod: JitArray = 0.0,
        step: JitArray = None,
        ratio: JitArray = None,
        draw: JitArray = None,
    ) -> JitArray:
        """B in 1/sr for valid directions, or its mean along a footprint; may be slightly negative.

        See :class:`mitsuba_plugins.lib.footprint.LevelOfDetail` for ``lod``, ``step`` and ``ratio``.
        """
        views = self.views.stencil(w_view, draw=None if self.nearest else draw)
        lights = self.lights.stencil(w_light, hold=False)
        if self.nearest:
            views, lights = _heaviest(views), _heaviest(lights)
        # A value that is no number fails the comparison.
        lod = dr.minimum(dr.select(mi.Float(lod) > 0, lod, 0), self.max_lod)
        total = self._mean(w_light, w_view, views, lights, active)
        along = uv, step, ratio
        finest = 1.0
        if self.first_level:
            # A level that is not kept gives no number, and is not fetched.
            finest = dr.select(lod < self.first_level, dr.nan, 1)
            lod = dr.maximum(lod, self.first_level)
        if self._differentiated(total, uv, views, lights, lod):
            # Gradients do not reach variables that a loop captures.
            for k in range(self.base, self.n_levels):
                here = active & (lod < k + 1)
                total = self._with_level(total, mi.UInt32(k), along, views, lights, lod, here, unrolled=True)
            return _rgb(total.value()) * finest

        def body(level: JitArray, total: SplitSum) -> tuple[JitArray, SplitSum]:
            here = active & (level < self.n_levels)
            return level + 1, self._with_level(total, level, along, views, lights, lod, here)

        _, total = dr.while_loop(
            (mi.UInt32(lod), total),
            lambda level, total: active & (level < self.n_levels),
            body,
            label="levels",
        )
        return _rgb(total.value()) * finest

    def _differentiated(
        self,
        total: SplitSum,
        uv: JitArray,
        views: list[Neighbour],
        lights: list[Neighbour],
        lod: JitArray,
    ) -> bool:
        """Whether gradients by anything that the levels read are being recorded."""
        weights = [neighbour.single() for neighbour in (*views, *lights)]
        read = total.high, total.rest, uv, weights, lod, self.weights
        return self.basis.differentiated or dr.grad_enabled(read)

    def _with_level(
        self,
        total: SplitSum,
        level: JitArray,
        along: tuple[JitArray, JitArray, JitArray],
        views: list[Neighbour],
        lights: list[Neighbour],
        lod: JitArray,
        active: JitArray,
        *,
        unrolled: bool = False,
    ) -> SplitSum:
        """The sum in Y, Cb, Cr with a level; ``unrolled`` without loops."""
        share = dr.clip(1 - lod + mi.Float(level), 0, 1)
        rows, columns, first, _ = dr.gather(mi.Array4u, self.sizes, level, active)
        shape = dr.maximum(rows, 1), dr.maximum(columns, 1)

        def lookup(
            coefficient: list[JitArray], uv: JitArray, share: JitArray, active: JitArray
        ) -> list[JitArray]:
            coefficient = list(coefficient)
            for texel, weight in zip(*texel_stencil(uv, shape, self.filter_type), strict=True):
                weight = weight * share
                values = read_packets(self.weights, first + texel, self.width, active)
                for i in range(len(coefficient)):
                    coefficient[i] = dr.fma(mi.Float(values[i]), weight, coefficient[i])
            return coefficient

        uv, step, ratio = along
        coefficient = [mi.Float(0) for _ in range(self.basis.ends[-1])]
        if step is None:
            coefficient = lookup(coefficient, uv, share, active)
        elif unrolled:
            _, weight = probes(ratio)
            reach = int(ANISOTROPY) // 2
            for j in range(-reach, reach + 1):
                coefficient = lookup(coefficient, uv + j * step, share * weight(j), active & (weight(j) > 0))
        else:
            reach, weight = probes(ratio)

            def body(j: JitArray, coefficient: list[JitArray]) -> tuple[JitArray, list[JitArray]]:
                here = active & (j <= reach)
                return j + 1, lookup(coefficient, uv + mi.Float(j) * step, share * weight(j), here)

            _, coefficient = dr.while_loop(
                (-reach, coefficient), lambda j, coefficient: active & (j <= reach), body, label="probes"
            )
        return self.basis.combine(level - self.base, views, lights, coefficient, active, total)

    def _mean(
        self,
        w_light: JitArray,
        w_view: JitArray,
        views: list[Neighbour],
        lights: list[Neighbour],
        active: JitArray,
    ) -> SplitSum:
        """The mean of the coarsest level in Y, Cb, Cr."""
        if self.mean is not None:
            return self.mean.combine(mi.UInt32(0), views, lights, [mi.Float(1)] * 3, active, SplitSum())
        p = read_packets(self.phong, mi.UInt32(0), 8, active)
        light, fade = held(w_light, self.edges[0])
        view, _ = held(w_view, self.edges[1])
        half = light + view
        cosine = half.z * dr.rsqrt(dr.squared_norm(half))
        luminance = dr.fma(p[2], safe_power(cosine, p[3]), dr.fma(p[1], light.z, p[0]))
        return SplitSum().plus(mi.Color3f(luminance, p[4], p[5]) * fade)


def _heaviest(neighbours: list[Neighbour]) -> list[Neighbour]:
    """The sample with the largest weight, with the weight of all."""
    (index, best), *rest = (pair for neighbour in neighbours for pair in neighbour.single())
    total = best
    for other, weight in rest:
        index, best = dr.select(weight > best, other, index), dr.maximum(weight, best)
        total = total + weight
    if neighbours[0].following is None:
        return [Neighbour(index, total)]
    return [Neighbour(index, total, index, mi.Float(0))]


def _rgb(ycc: JitArray) -> JitArray:
    rows = TO_RGB.tolist()
    return mi.Color3f(*(dr.fma(r[1], ycc[1], dr.fma(r[2], ycc[2], r[0] * ycc[0])) for r in rows))
