"""Dr.Jit tables of direction pairs, and packets of values.

Everything here is recorded, never executed per sample: no data-dependent Python control flow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics.device_arrays import to_device
from mitsuba_plugins.lib.lookup import single

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.lib.lookup import Neighbour


#: Half tables are multiplied by this power of two when they are packed: the smallest subnormal half becomes normal.
HALF_SHIFT = 2.0**10

#: Largest value of a half table that survives the shift.
HALF_LIMIT = 65504 / HALF_SHIFT

#: Packed halves are widened by moving their bits into those of a float32; this makes up for the different exponent
#: biases (2^112) and the shift. Exact for normal halves; CPUs in flush-to-zero mode would lose subnormal ones.
HALF_SCALE = 2.0**112 / HALF_SHIFT


#: Entries up to this many values are blended in straight-line code; wider ones loop over views, since the time to
#: compile a kernel grows faster than its length, and the longer code of 16 values is also a fifth slower to run.
UNROLLED_WIDTH = 8


#: Arrays of more bytes share their memory with NumPy: so large a block has pages of its own, which begin alike (see
#: `to_device`), and a copy would cost.
SHARED_ABOVE = 32 << 20


def tensor(array: np.ndarray) -> JitArray:
    """A Dr.Jit tensor of the array's own type (float16, float32 or uint32); uint8 in words of four codes."""
    array = np.ascontiguousarray(array)
    if array.dtype == np.uint8:
        array = array.view("<u4").astype(np.uint32)
    kind = {"float16": mi.TensorXf16, "float32": mi.TensorXf, "uint32": mi.TensorXu}[array.dtype.name]
    if array.nbytes > SHARED_ABOVE:
        return kind(array)
    return kind(to_device(dr.array_t(kind), array), array.shape)


class PairTable:
    """Blend of the entries of a table over direction pairs: the inner loop of every tabulated method.

    Parameters
    ----------
    values : TensorXf or TensorXf16, shape (outer, n_views, n_lights, width)
        ``width`` a multiple of 4.
    following : ndarray of int, shape (n_lights,), or None
        The next light on each light's ring.

    Notes
    -----
    Gathers dominate the cost, and their cost is the number of 32-bit words. Half tables are therefore kept as words
    of two values: on ring grids the same value of a light and of the next light on its ring, so that one entry feeds
    two of the four lights of a lookup; elsewhere two neighbouring values of an entry.

    Gradients do not reach what a loop captures: where anything is differentiated by, the code is straight-line.
    """

    def __init__(self, values: JitArray, following: np.ndarray | None) -> None:
        self.following = following
        self.update(values)

    def update(self, values: JitArray) -> None:
        """Take new values; halves are packed."""
        self.outer, self.n_views, self.n_lights, self.width = values.shape
        self.words, self.values = None, None
        halves = values.numpy() if dr.type_v(values.array) == dr.VarType.Float16 else None
        words = None if halves is None else _words(halves.view(np.uint16), self.following)
        if words is None:
            self.values = as_float32(values)
            return
        shared = words.nbytes > SHARED_ABOVE
        numbers = mi.UInt32(words.ravel()) if shared else to_device(mi.UInt32, words)
        self.words = dr.reinterpret_array(mi.Float, numbers)
        dr.eval(self.words)

    @property
    def differentiated(self) -> bool:
        """Whether gradients by the values are being recorded."""
        return self.values is not None and dr.grad_enabled(self.values)

    def combine(
        self,
        outer: JitArray,
        views: list[Neighbour],
        lights: list[Neighbour],
        coefficients: list[JitArray],
        active: JitArray = True,
        total: JitArray = None,
    ) -> JitArray:
        """Interpolate over views and lights, and combine the colours of an entry linearly.

        Parameters
        ----------
        outer : UInt32
            Index of the outermost axis.
        views, lights : list of Neighbour
        coefficients : list of Float
            One for each colour of an entry (three values each); fewer than the entry holds ignore the rest.
        active : Bool
        total : optional
            What the sum starts from; default: nothing.

        Returns
        -------
        Color3f
            ``Σ_pairs weight Σ_j coefficient_j colour_j``.
        """
        if self.words is not None:
            # Applied first: unscaled halves times small weights would underflow.
            coefficients = [c * HALF_SCALE for c in coefficients]
        outer = outer * self.n_views
        pairs = single(views)
        total = mi.Color3f(0) if total is None else total
        weights = pairs, [light.single() for light in lights]
        straight = self.differentiated or dr.grad_enabled(coefficients, weights)
        if straight or self.width <= UNROLLED_WIDTH or len(pairs) == 1:
            for view, weight in pairs:
                total = self._add_view(total, outer + view, weight, lights, coefficients, active)
            return total

        def body(step: JitArray, total: JitArray) -> tuple[JitArray, JitArray]:
            view, weight = pairs[0]
            for i, (other, other_weight) in enumerate(pairs[1:], 1):
                view, weight = dr.select(step == i, other, view), dr.select(step == i, other_weight, weight)
            return step + 1, self._add_view(total, outer + view, weight, lights, coefficients, active)

        return dr.while_loop(
            (mi.UInt32(0), total), lambda step, total: step < len(pairs), body, label="views"
        )[1]

    def _blend(
        self, total: JitArray, values: list[JitArray], coefficients: list[JitArray], weight: JitArray
    ) -> JitArray:
        """``total`` plus the weighted combination of an entry's values; by default RGB colours back to back."""
        return _add(total, values, coefficients, weight)

    def _needed(self, coefficients: list[JitArray]) -> int:
        """How many of an entry's values these coefficients use."""
        return 3 * len(coefficients)

    def _add_view(
        self,
        total: JitArray,
        view: JitArray,
        weight: JitArray,
        lights: list[Neighbour],
        coefficients: list[JitArray],
        active: JitArray,
    ) -> JitArray:
        """``total`` plus the contribution of one view, interpolated over lights."""
        base = view * self.n_lights
        for light in lights:
            if self.words is not None and self.following is not None:
                words = read_packets(self.words, base + light.index, self.width, active)
                halves = [widened(word) for word in words[: self._needed(coefficients)]]
                total = self._blend(total, [low for low, _ in halves], coefficients, weight * light.weight)
                total = self._blend(
                    total, [high for _, high in halves], coefficients, weight * light.following_weight
                )
                continue
            for index, light_weight in light.single():
                pair_weight = weight * light_weight
                # Pairs without weight are not fetched: they may not be there.
                needed = active & (pair_weight != 0)
                total = self._blend(total, self._values(base + index, needed), coefficients, pair_weight)
        return total

    def _values(self, entry: JitArray, active: JitArray) -> list[JitArray]:
        """The values of an entry one by one, not yet multiplied by ``HALF_SCALE``."""
        if self.words is None:
            return [mi.Float(value) for value in read_packets(self.values, entry, self.width, active)]
        return [
            half
            for word in read_packets(self.words, entry, self.width // 2, active)
            for half in widened(word)
        ]


#: Bits of each half × ``HALF_SHIFT``, by its own; what overflows is not asked for.
with np.errstate(over="ignore", invalid="ignore"):
    _SHIFTED = (np.arange(1 << 16, dtype=np.uint16).view(np.float16) * np.float16(HALF_SHIFT)).view(np.uint16)

#: Rows of lights that are packed at a time: they stay in the processor's caches.
_TOGETHER = 512


def _words(halves: np.ndarray, following: np.ndarray | None) -> np.ndarray | None:
    """Pairs of halves that were multiplied, by their bits; None where one is too large, or no number.

    Parameters
    ----------
    halves : ndarray of uint16, shape (outer, n_views, n_lights, width)
    following : ndarray of int, shape (n_lights,), or None
        See `PairTable`.
    """
    _, _, lights, width = halves.shape
    rows = halves.reshape(-1, lights, width)
    words = np.zeros((len(rows), lights, width if following is not None else width // 2), np.uint32)
    most = np.float16(HALF_LIMIT).view(np.uint16)
    entry = np.dtype((np.void, 2 * width))
    for start in range(0, len(rows), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        # Moved bits make a number of NaN, which stands for what is not there: such tables stay as they are.
        if (rows[part] & 0x7FFF).max() > most:
            return None
        low = np.take(_SHIFTED, rows[part])
        if following is None:
            words[part] = low.view(np.uint32)
        else:
            high = np.take(low.view(entry)[..., 0], following, axis=1)
            words[part] = high[..., None].view(np.uint16)
            words[part] <<= 16
            words[part] |= low
    return words


def widened(word: JitArray) -> tuple[JitArray, JitArray]:
    """The two halves of a word as float32, both to be multiplied by ``HALF_SCALE``."""
    word = dr.reinterpret_array(mi.UInt32, word)
    low = dr.reinterpret_array(mi.Float, ((word << 13) & 0x0FFFE000) | ((word << 16) & 0x80000000))
    high = dr.reinterpret_array(mi.Float, ((word >> 3) & 0x0FFFE000) | (word & 0x80000000))
    return low, high


def _add(total: JitArray, values: list[JitArray], coefficients: list[JitArray], weight: JitArray) -> JitArray:
    """``total + weight Σ_j coefficient_j colour_j``: few live registers, whatever the number of coefficients."""
    result = []
    for channel in range(3):
        value = values[channel] * coefficients[0]
        for j, coefficient in enumerate(coefficients[1:], 1):
            value = dr.fma(values[3 * j + channel], coefficient, value)
        result.append(dr.fma(value, weight, total[channel]))
    return mi.Color3f(*result)


def as_float32(values: JitArray) -> JitArray:
    """Values of a table as float32, which is read in packets; gradients pass the conversion."""
    result = mi.Float(values.array)
    dr.eval(result)
    return result


def read_packets(array: JitArray, entry: JitArray, width: int, active: JitArray = True) -> list[JitArray]:
    """``width`` consecutive values of entry ``entry``, gathered in the largest packets that fit."""
    result: list[JitArray] = []
    while len(result) < width:
        # Packets must be aligned to their own size.
        if width % 16 == 0:
            packet = dr.gather(mi.Matrix4f, array, entry * (width // 16) + len(result) // 16, active)
            result += [packet[row, column] for row in range(4) for column in range(4)]
        elif width % 4:
            packet = dr.gather(mi.Vector2f, array, entry * (width // 2) + len(result) // 2, active)
            result += [packet.x, packet.y]
        else:
            packet = dr.gather(mi.Vector4f, array, entry * (width // 4) + len(result) // 4, active)
            result += [packet[k] for k in range(4)]
    return result
