"""Dr.Jit ports of the shared lookups: directions and texels; their tables are in :mod:`mitsuba_plugins.lib.tables`.

Everything here is recorded, never executed per sample: no data-dependent Python control flow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.conventions import LEAST_Z, SQUARED_LENGTHS
from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere.interpolation import MISSING
from mitsuba_plugins.lib.draws import chosen

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from btfref.types import JitArray


#: The largest finite float32.
LARGEST = float(np.finfo(np.float32).max)


def valid_directions(w: JitArray) -> JitArray:
    """As :func:`btfref.conventions.valid_directions`."""
    low, high = SQUARED_LENGTHS
    square = dr.squared_norm(w)
    return (w.z >= LEAST_Z) & (square > low) & (square < high)


def malformed(uv: JitArray, w_light: JitArray, w_view: JitArray) -> tuple[JitArray, JitArray]:
    """Where a lookup asks for what is none, as :func:`btfref.conventions.malformed` counts it.

    Returns
    -------
    directions, coordinates : Bool
    """
    low, high = SQUARED_LENGTHS
    squares = [dr.squared_norm(w) for w in (w_light, w_view)]
    unit = (squares[0] > low) & (squares[0] < high) & (squares[1] > low) & (squares[1] < high)
    # A comparison, which FastMath keeps: tests for NaN it may take out.
    finite = (dr.abs(uv.x) <= LARGEST) & (dr.abs(uv.y) <= LARGEST)
    return ~unit, ~finite


#: π/4 as a sum of two float32: differences to a tabulated angle keep float accuracy.
QUARTER_PI = (0.785398185253143310546875, -2.18556948040e-8)


def angle_of(y: JitArray, x: JitArray) -> tuple[JitArray, JitArray]:
    """Angle of (x, y) as a multiple of an eighth turn in [0, 8] plus a remainder of at most π/8 in magnitude.

    The sum of the two would be rounded to a float32 of magnitude 2π; steps between directions multiply that error.
    ``dr.atan2`` is good to 8e-7, this to 6e-8.
    """
    ax, ay = dr.abs(x), dr.abs(y)
    small, large = dr.minimum(ax, ay), dr.maximum(ax, ay)
    # Beyond tan(π/8) the remainder is taken from the diagonal: atan(s/l) = π/4 + atan((s − l)/(s + l)).
    diagonal = small > 0.41421357 * large
    q = dr.select(diagonal, small - large, small) / dr.maximum(
        dr.select(diagonal, small + large, large), 1e-37
    )
    z = q * q
    # Minimax fit of (atan(q)/q − 1)/q² on [0, tan(π/8)], relative error below 1e-9.
    p = mi.Float(-0.060823050)
    for coefficient in (0.10595571, -0.14243794, 0.19998487, -0.33333315):
        p = dr.fma(p, z, coefficient)
    rest = dr.fma(q * z, p, q)
    eighths = dr.select(diagonal, mi.Float(1), 0)
    for mask, turn in ((ay > ax, 2), (x < 0, 4), (y < 0, 8)):
        eighths = dr.select(mask, turn - eighths, eighths)
        rest = dr.select(mask, -rest, rest)
    return eighths, rest


def texel_position(uv: JitArray, shape: tuple[JitArray, JitArray], shift: float) -> tuple[JitArray, JitArray]:
    """Whole part (wrapped, as floats) and fraction of ``uv * size - shift``; not finite counts as 0."""
    size = mi.Vector2f(shape[1], shape[0])
    uv = dr.select(dr.isfinite(uv), uv, 0)
    # Far out the fraction is taken first, so that texel numbers stay exact; near 0 that would cost accuracy.
    uv = dr.select(dr.abs(uv) > 1024, uv - dr.floor(uv), uv)
    low = dr.floor(dr.fma(uv, size, -shift))
    # One rounding, of a number in [0, 1): the integer part cancels inside the fused operation.
    f = dr.clip(dr.fma(uv, size, -shift - low), 0, 1)
    # Half a texel keeps exact multiples of the size away from where a rounded quotient would fall below its floor.
    return low - size * dr.floor((low + 0.5) / size), f


def texel_stencil(
    uv: JitArray, shape: tuple[JitArray, JitArray], filter_type: str
) -> tuple[list[JitArray], list[JitArray]]:
    """As :func:`btfref.conventions.texel_stencil`: lists of indices and weights."""
    rows, columns = shape
    low, f = texel_position(uv, shape, 0.0 if filter_type == "nearest" else 0.5)
    i0 = dr.minimum(mi.Vector2u(low), mi.Vector2u(columns - 1, rows - 1))
    if filter_type == "nearest":
        return [i0.y * columns + i0.x], [mi.Float(1)]
    i1 = i0 + 1
    i1 = mi.Vector2u(dr.select(i1.x == columns, 0, i1.x), dr.select(i1.y == rows, 0, i1.y))
    index = [i0.y * columns + i0.x, i0.y * columns + i1.x, i1.y * columns + i0.x, i1.y * columns + i1.x]
    weight = [(1 - f.x) * (1 - f.y), f.x * (1 - f.y), (1 - f.x) * f.y, f.x * f.y]
    return index, weight


class Neighbour:
    """A sample with its weight, and the next sample on the same ring with its own (None where there is no ring)."""

    def __init__(
        self, index: JitArray, weight: JitArray, following: JitArray = None, following_weight: JitArray = None
    ) -> None:
        self.index, self.weight = index, weight
        self.following, self.following_weight = following, following_weight

    def single(self) -> list[tuple[JitArray, JitArray]]:
        """The samples one by one: a list of (index, weight)."""
        pairs = [(self.index, self.weight)]
        if self.following is not None:
            pairs.append((self.following, self.following_weight))
        return pairs


def single(neighbours: list[Neighbour]) -> list[tuple[JitArray, JitArray]]:
    """Samples of a stencil one by one: a list of (index, weight)."""
    return [pair for neighbour in neighbours for pair in neighbour.single()]


def drawn(neighbours: list[Neighbour], draw: JitArray, *, hold: bool) -> list[Neighbour]:
    """A stencil, or the one sample of it that is drawn, with the weight of all."""
    return neighbours if draw is None else [Neighbour(*chosen(single(neighbours), draw, hold=hold))]


class RingTable:
    """Port of :class:`btfref.numerics.sphere.interpolation.RingInterpolation`."""

    def __init__(self, rings: ArrayLike) -> None:
        self.rings = np.asarray(rings, float)

    def following(self) -> np.ndarray:
        """For each sample the next one on its ring, shape (n,)."""
        result = []
        for _, _, count, first in self.rings.astype(int):
            result += [first + (i + 1) % count for i in range(count)]
        return np.array(result)

    def stencil(self, w: JitArray, *, hold: bool = True, draw: JitArray = None) -> list[Neighbour]:
        """List of :class:`Neighbour`: one on the lower and one on the upper ring; the drawn one alone with ``draw``."""
        polar = angle_of(dr.sqrt(dr.fma(w.x, w.x, w.y * w.y)), w.z)
        theta = dr.fma(polar[0], QUARTER_PI[0], polar[1])
        eighths, rest = angle_of(w.y, w.x)
        last = len(self.rings) - 1
        # Tables this small are cheaper as chains of selects than as gathers.
        above = [theta >= float(ring[0]) for ring in self.rings[1:]]

        def choose(values: Sequence[float] | np.ndarray) -> JitArray:
            values = [float(v) for v in values]
            result = mi.Float(values[0])
            for mask, value, previous in zip(above, values[1:], values, strict=False):
                if any(v != values[0] for v in values) or value != previous:
                    result = dr.select(mask, value, result)
            return result

        low = np.arange(last + 1)
        high = np.minimum(low + 1, last)
        step = self.rings[high, 0] - self.rings[low, 0]
        inverse = np.where(step > 0, 1 / np.where(step > 0, step, 1), 0)
        beyond = dr.fma(polar[0], QUARTER_PI[0], -choose(self.rings[low, 0])) + polar[0] * QUARTER_PI[1]
        t = dr.clip((beyond + polar[1]) * choose(inverse), 0, 1)
        fade = mi.Float(1)
        edge = self.rings[last, 0]
        if not hold and np.cos(edge) > 1e-6:
            fade = dr.select(theta > float(edge), dr.maximum(w.z, 0) * float(1 / np.cos(edge)), 1)
        neighbours = []
        for ring, share in ((low, (1 - t) * fade), (high, t * fade)):
            count = choose(self.rings[ring, 2])
            # Whole and fractional parts apart: a sum of magnitude ``count`` would round the fraction.
            start = dr.fma(
                eighths, 0.125 * count, -choose(self.rings[ring, 1] / (2 * np.pi) * self.rings[ring, 2])
            )
            whole = dr.floor(start)
            position = dr.fma(rest, count * (0.5 / np.pi), start - whole)
            carry = dr.floor(position)
            fraction = dr.clip(position - carry, 0, 1)
            first = whole + carry
            first = first - count * dr.floor((first + 0.5) / count)
            following = dr.select(first + 1 < count, first + 1, 0)
            offset = choose(self.rings[ring, 3])
            neighbours.append(
                Neighbour(
                    mi.UInt32(offset + first),
                    share * (1 - fraction),
                    mi.UInt32(offset + following),
                    share * fraction,
                )
            )
            if ring is low and self.rings[0, 0] > 0:
                # In the cap, ``beyond`` and the rest of the angle are θ − θ_first.
                inset = (beyond + polar[1]) * float(-1 / self.rings[0, 0])
                cap = self._across_the_cap(first, fraction, inset)
        if self.rings[0, 0] > 0:
            inside = theta < float(self.rings[0, 0])
            neighbours = [_selected(inside, *pair) for pair in zip(cap, neighbours, strict=True)]
        return drawn(neighbours, draw, hold=hold)

    def _across_the_cap(
        self, first: JitArray, fraction: JitArray, inset: JitArray
    ) -> tuple[Neighbour, Neighbour]:
        """As :func:`btfref.numerics.sphere.interpolation.across_the_cap`."""
        _, _, count, offset = (float(v) for v in self.rings[0])
        step, radius = 2 * np.pi / count, 1 - inset
        lower = first + fraction > 0.5 * count
        first = dr.select(lower, count - 1 - first, first)
        fraction = dr.select(lower, 1 - fraction, fraction)
        (a_sin, a_cos), (b_sin, b_cos) = dr.sincos(step * first), dr.sincos(step * (first + 1))
        x, y = radius * dr.lerp(a_cos, b_cos, fraction), radius * dr.lerp(a_sin, b_sin, fraction)
        corner = dr.floor(dr.acos(dr.clip(x, -1, 1)) * float(1 / step))
        corner = dr.clip(corner, 0, max(count // 2 - 1, 0))

        def before(k: JitArray) -> JitArray:
            return 2 * dr.sin(0.5 * step * (corner + k)) * dr.sin(0.5 * step * (k - corner))

        start_sin, start_cos = dr.sincos(step * corner)
        way = dr.fma(inset, start_cos, radius * dr.lerp(before(first), before(first + 1), fraction))
        width = before(corner + 1)
        along = dr.clip(way / dr.select(width > 0, width, 1), 0, 1)
        height = dr.lerp(start_sin, dr.sin(step * (corner + 1)), along)
        # At a corner on the axis the chord is a point, and any share of it will do.
        far = dr.clip(0.5 - 0.5 * y / dr.maximum(height, 1e-30), 0, 1)
        below = dr.select(lower, 1 - far, far)
        above, mirrored = 1 - below, count - 1 - corner

        def pair(sample: JitArray, weight: JitArray, following_weight: JitArray) -> Neighbour:
            following = dr.select(sample + 1 < count, sample + 1, 0)
            return Neighbour(
                mi.UInt32(offset + sample), weight, mi.UInt32(offset + following), following_weight
            )

        return pair(corner, above * (1 - along), above * along), pair(
            mirrored, below * along, below * (1 - along)
        )


def _selected(mask: JitArray, one: Neighbour, other: Neighbour) -> Neighbour:
    """One neighbour where a mask holds, else another."""
    (a, b), (c, d) = one.single(), other.single()
    return Neighbour(*(dr.select(mask, x, y) for x, y in zip((*a, *b), (*c, *d), strict=True)))


class TriangleTable:
    """Port of :class:`btfref.numerics.sphere.interpolation.TriangleInterpolation`."""

    def __init__(self, triangles: np.ndarray, cells: np.ndarray) -> None:
        self.n_triangles, self.n_cells = len(triangles), len(cells)
        self.triangles = to_device(mi.Float, triangles)
        self.cells = to_device(mi.UInt32, cells)

    def following(self) -> None:
        """There are no rings."""
        return None

    def _row(self, triangle: JitArray, active: JitArray = True) -> list[JitArray]:
        packets = [dr.gather(mi.Vector4f, self.triangles, triangle * 6 + i, active) for i in range(6)]
        return [p[k] for p in packets for k in range(4)]

    @staticmethod
    def _barycentric(row: list[JitArray], w: JitArray) -> tuple[JitArray, JitArray, JitArray]:
        from_a = w - mi.Vector3f(row[0:3])
        from_b = w - mi.Vector3f(row[3:6])
        n_a, n_b, n_c = (mi.Vector3f(row[i : i + 3]) for i in (6, 9, 12))
        return dr.dot(n_a, from_b), dr.dot(n_b, from_a), dr.dot(n_c, from_a)

    def stencil(self, w: JitArray, *, hold: bool = True, draw: JitArray = None) -> list[Neighbour]:
        """List of three :class:`Neighbour` without followers; the drawn one alone with ``draw``."""
        w = mi.Vector3f(dr.detach(w))
        s = w.x / (1 + w.z)
        t = w.y / (1 + w.z)
        half = 0.5 * self.n_cells
        column = mi.UInt32(dr.clip((s + 1) * half, 0, self.n_cells - 1))
        row = mi.UInt32(dr.clip((t + 1) * half, 0, self.n_cells - 1))
        start = dr.gather(mi.UInt32, self.cells, row * self.n_cells + column)

        def body(
            triangle: JitArray, steps: JitArray, walking: JitArray, w: JitArray
        ) -> tuple[JitArray, JitArray, JitArray, JitArray]:
            data = self._row(triangle, walking)
            a, b, c = self._barycentric(data, w)
            worst = dr.minimum(a, dr.minimum(b, c))
            # Float32 noise on an edge must not make the walk step back and forth.
            outside = worst < -1e-6
            across = dr.select(a == worst, data[18], dr.select(b == worst, data[19], data[20]))
            triangle = dr.select(walking & outside, mi.UInt32(across), triangle)
            steps = steps + 1
            return triangle, steps, walking & outside & (steps < self.n_triangles), w

        triangle, _, _, _ = dr.while_loop(
            (start, mi.UInt32(0), mi.Bool(True), w), lambda triangle, steps, walking, w: walking, body
        )
        data = self._row(triangle)
        a, b, c = (dr.maximum(x, 0) for x in self._barycentric(data, w))
        beyond = data[17] < 0
        c = dr.select(beyond, 0, c)
        scale = dr.rcp(a + b + c)
        weights = [a * scale, b * scale, c * scale]
        if not hold:
            edge = mi.Vector3f(data[0:3]) * weights[0] + mi.Vector3f(data[3:6]) * weights[1]
            cos_edge = edge.z * dr.rsqrt(dr.squared_norm(edge))
            fade = dr.minimum(dr.maximum(w.z, 0) / dr.maximum(cos_edge, 1e-6), 1)
            weights = [x * dr.select(beyond, fade, 1) for x in weights]
        indices = [mi.UInt32(dr.maximum(x, 0)) for x in data[15:18]]
        return drawn([Neighbour(i, x) for i, x in zip(indices, weights, strict=True)], draw, hold=hold)


class ResidentTable:
    """Port of :class:`btfref.numerics.sphere.interpolation.ResidentInterpolation`: what is not kept gives no number."""

    def __init__(self, inner: RingTable | TriangleTable, slots: np.ndarray) -> None:
        self.inner, self._table = inner, np.ascontiguousarray(slots[:, 0])
        self.slots = to_device(mi.UInt32, self._table)
        dr.eval(self.slots)

    def following(self) -> np.ndarray | None:
        """The slot of the next sample on each kept one's ring; of one that is not kept, its own."""
        following = self.inner.following()
        if following is None:
            return None
        kept = np.flatnonzero(self._table != MISSING)
        after = self._table[following[kept]]
        return np.where(after == MISSING, self._table[kept], after).astype(np.int64)

    def stencil(self, w: JitArray, *, hold: bool = True, draw: JitArray = None) -> list[Neighbour]:
        """As the table's own, in slots; a drawn lookup needs only what it draws."""

        def kept(index: JitArray, weight: JitArray) -> tuple[JitArray, JitArray]:
            slot = dr.gather(mi.UInt32, self.slots, index)
            absent = slot == MISSING
            return dr.select(absent, 0, slot), dr.select(absent & (weight > 0), dr.nan, weight)

        result = []
        for neighbour in self.inner.stencil(w, hold=hold, draw=draw):
            pairs = [kept(*pair) for pair in neighbour.single()]
            if len(pairs) == 2 and not hold:
                # Packed tables reach the second light through the first one: without it there is no number either.
                (slot, weight), (after, after_weight) = pairs
                absent = dr.gather(mi.UInt32, self.slots, neighbour.index) == MISSING
                pairs[1] = after, dr.select(absent & (after_weight > 0), dr.nan, after_weight)
                pairs[0] = slot, weight
            result.append(Neighbour(*(value for pair in pairs for value in pair)))
        return result


#: Port of an interpolation over directions.
DirectionTable = RingTable | TriangleTable | ResidentTable


def direction_table(arrays: dict[str, np.ndarray], prefix: str) -> DirectionTable:
    """The port of the interpolation whose tables are stored under ``prefix``."""
    found: RingTable | TriangleTable
    if f"{prefix}_rings" in arrays:
        found = RingTable(arrays[f"{prefix}_rings"])
    else:
        found = TriangleTable(arrays[f"{prefix}_triangles"], arrays[f"{prefix}_cells"])
    slots = arrays.get(f"{prefix}_slots")
    return found if slots is None else ResidentTable(found, slots)
