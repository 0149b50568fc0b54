"""Dr.Jit ports of parabolic maps (:mod:`btfref.numerics.sphere.parabolic`) and of half and difference vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere.halfway import LENGTHEN, SHORT
from btfref.representations.factored.definition import raised
from mitsuba_plugins.lib.tables import HALF_LIMIT, HALF_SCALE, HALF_SHIFT, as_float32, read_packets, widened

if TYPE_CHECKING:
    from btfref.types import JitArray


def half_sum(w_light: JitArray, w_view: JitArray) -> JitArray:
    """A vector along the half vector, whose square does not underflow."""
    h = w_light + w_view
    return h * dr.select(dr.max(dr.abs(h)) < SHORT, LENGTHEN, 1)


def half_difference(w_light: JitArray, w_view: JitArray) -> tuple[JitArray, JitArray]:
    """As :func:`btfref.numerics.sphere.halfway.half_difference`."""
    h = half_sum(w_light, w_view)
    length = dr.norm(h)
    h = dr.select(length > 0, h / length, mi.Vector3f(0, 0, 1))
    a = 1 / (1 + h.z)
    tangent = mi.Vector3f(1 - h.x * h.x * a, -h.x * h.y * a, -h.x)
    bitangent = mi.Vector3f(-h.x * h.y * a, 1 - h.y * h.y * a, -h.y)
    return h, mi.Vector3f(dr.dot(w_light, tangent), dr.dot(w_light, bitangent), dr.dot(w_light, h))


def bilinear_stencil(w: JitArray, n: int) -> tuple[list[JitArray], list[JitArray]]:
    """As :func:`btfref.numerics.sphere.parabolic.bilinear_stencil`: lists of four indices and weights."""
    scale = dr.norm(w) + w.z
    scale = dr.select(scale > 0, 1 / scale, 0)
    index, fraction = [], []
    for x in (w.x * scale, w.y * scale):
        # The whole part is found first and cancels inside the fused operation, which rounds a number in [0, 1).
        low = dr.clip(dr.floor(dr.fma(x, 0.5 * n, 0.5 * (n - 1))), 0, n - 1)
        fraction.append(dr.clip(dr.fma(x, 0.5 * n, 0.5 * (n - 1) - low), 0, 1))
        first = mi.UInt32(low)
        index.append((first, dr.minimum(first + 1, n - 1)))
    (c0, c1), (r0, r1) = index
    fx, fy = fraction
    return (
        [r0 * n + c0, r0 * n + c1, r1 * n + c0, r1 * n + c1],
        [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy],
    )


def unpacked(word: JitArray) -> tuple[list[JitArray], float]:
    """Three channels of a word of 8-bit codes, and the factor that makes numbers in [0, 1] of them."""
    return [mi.Float((word >> shift) & 255) for shift in (0, 8, 16)], 1 / 255


class ParabolicMaps:
    """A stack of parabolic maps of RGB values.

    A lookup's cost is the number of words that it gathers: one a texel for 8-bit codes, two for halves, four for
    floats. Slices are addressed as integers, so that none leaks into another.

    Parameters
    ----------
    values : TensorXf, TensorXf16, shape (slices, n, n, 4), or TensorXu of packed codes, shape (slices, n, n, 1)
    power : int
        1 or 4: what the numbers in the maps are raised to.
    """

    def __init__(self, values: JitArray, power: int) -> None:
        self.n, self.power = values.shape[1], power
        self.texels = self.n * self.n
        self.kind, self.values = dr.type_v(values.array), values.array
        if self.kind == dr.VarType.UInt32:
            self.values = mi.UInt32(self.values)
        elif self.kind == dr.VarType.Float16:
            self.kind = "halves"
        if self.kind == "halves" and np.abs(halves := values.numpy()).max(initial=0) <= HALF_LIMIT:
            # The shift keeps subnormal halves from being flushed (see HALF_SHIFT).
            words = (halves * np.float16(HALF_SHIFT)).view(np.uint32)
            self.values = dr.reinterpret_array(mi.Float, to_device(mi.UInt32, words))
            dr.eval(self.values)
            self.kind = "words"
        elif self.kind != dr.VarType.UInt32:
            self.values = as_float32(values)

    def lookup(
        self, slice_index: JitArray, stencil: tuple[list[JitArray], list[JitArray]], active: JitArray = True
    ) -> JitArray:
        """Bilinear lookup in a slice; a Color3f.

        Parameters
        ----------
        slice_index : UInt32
        stencil : (list of UInt32, list of Float)
            From :func:`bilinear_stencil`.
        active : Bool
        """
        first = slice_index * self.texels
        total = [mi.Float(0)] * 3
        for index, weight in zip(*stencil, strict=True):
            colour, factor = self._texel(first + index, active)
            colour = [raised(c, self.power) for c in colour]
            # The weight takes the factor: halves widened without it are so small that their products would be flushed.
            weight = weight * factor**self.power
            total = [dr.fma(c, weight, t) for c, t in zip(colour, total, strict=True)]
        return mi.Color3f(*total)

    def _texel(self, texel: JitArray, active: JitArray) -> tuple[list[JitArray], float]:
        """Three channels, and the factor that makes values of them."""
        if self.kind == dr.VarType.UInt32:
            return unpacked(dr.gather(mi.UInt32, self.values, texel, active))
        if self.kind == "words":
            low, high = read_packets(self.values, texel, 2, active)
            (r, g), (b, _) = widened(low), widened(high)
            return [r, g, b], HALF_SCALE
        return [mi.Float(c) for c in read_packets(self.values, texel, 4, active)[:3]], 1.0
