"""Visibility kept at small triangles, and its use without bias at any point of the surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device

if TYPE_CHECKING:
    from btfref.sampling.surface.lobes import BroadLobes
    from btfref.sampling.surface.triangles import Descent
    from btfref.sampling.tiled_scene import TiledScene
    from btfref.types import JitArray

#: Of the directions that a vertex looks at, one in so many is traced; the others are looked up.
SHARE = 8

#: Small triangles beyond which nothing is kept, as a multiple of the number of points and at the least.
LARGEST, LEAST = 2, 60_000


class VisibilityCache:
    """Which directions the centroids of small triangles see.

    A vertex of a path takes the visibility C of its small triangle for all directions, and traces a random
    eighth of them: there ``C + 8 (V − C)`` stands for the visibility V. Its expectation is V whatever C is;
    where C is right, as it is but for borders of shadows, nothing is added to the noise.

    Parameters
    ----------
    bits : ndarray (n_directions, T) of uint8, or None
        None traces all directions.
    descent : Descent
    lobes : BroadLobes
        Says which BSDF is whose.
    directions : ndarray (n_directions, 3)
    """

    def __init__(
        self, bits: np.ndarray | None, descent: Descent, lobes: BroadLobes, directions: np.ndarray
    ) -> None:
        import mitsuba as mi

        self.n = len(directions)
        self.share = 1 if bits is None else SHARE
        self.bits = None if bits is None else to_device(mi.UInt8, bits.T)
        part_start = np.zeros(max(lobes.ids) + 1, np.uint32)
        part_start[lobes.ids] = descent.part_start
        self._part_start = to_device(mi.UInt32, part_start)
        self._level, self._first, self._row = (
            to_device(mi.UInt32, words) for words in (descent.level, descent.first, descent.row)
        )
        self._deepest = int(descent.level.max())
        # A direction's class depends on itself alone: parts of a BTF are traced as the whole is.
        integers = np.round(np.asarray(directions, np.float64) * 1e6).astype(np.int64)
        mixed = (integers @ np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D])).astype(np.uint64)
        # The high bits of a product depend on all bits of its factors.
        mixed = (mixed * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)
        classes = (mixed % np.uint64(self.share)).astype(np.int64)
        order = np.argsort(classes, kind="stable")
        starts = np.searchsorted(classes[order], np.arange(self.share + 1))
        self._members, self._starts = (to_device(mi.UInt32, words) for words in (order, starts))
        self.vectors = to_device(mi.Float, directions)

    def row(self, hit: JitArray, number: JitArray) -> JitArray:
        """Small triangle of preliminary intersections (`mitsuba.PreliminaryIntersection3f`)."""
        import drjit as dr
        import mitsuba as mi

        found = number > 0
        face = dr.gather(mi.UInt32, self._part_start, number, found) + hit.prim_index
        level = dr.gather(mi.UInt32, self._level, face, found)
        code = mi.UInt32(0)
        c, a = mi.Float(hit.prim_uv.y), 1 - hit.prim_uv.x - hit.prim_uv.y
        b = 1 - a - c
        for depth in range(self._deepest):
            deeper = level > depth
            at_a, at_b, at_c = a > 0.5, b > 0.5, c > 0.5
            digit = dr.select(
                at_a, mi.UInt32(0), dr.select(at_b, mi.UInt32(1), dr.select(at_c, mi.UInt32(2), mi.UInt32(3)))
            )
            corner = at_a | at_b | at_c
            x, y, z = (
                dr.select(corner, 2 * t - dr.select(at, 1, 0), 1 - 2 * t)
                for t, at in ((a, at_a), (b, at_b), (c, at_c))
            )
            # The middle quarter's corners are bc, ca, ab: opposite to a, b, c.
            a, b, c = (dr.select(deeper, new, old) for new, old in ((x, a), (y, b), (z, c)))
            code = dr.select(deeper, 4 * code + digit, code)
        first = dr.gather(mi.UInt32, self._first, face, found)
        return dr.gather(mi.UInt32, self._row, first + code, found)

    def sights(
        self,
        tiles: TiledScene,
        si: JitArray,
        row: JitArray,
        choice: JitArray,
        *,
        towards: JitArray | None = None,
    ) -> JitArray:
        """Visibility of all directions from surface interactions.

        Parameters
        ----------
        tiles : TiledScene
        si : mitsuba.SurfaceInteraction3f
            Only ``p`` and ``n`` and the shading frame are used.
        row : mitsuba.UInt32
        choice : mitsuba.Float
            Random number in [0, 1): which class of directions is traced.
        towards : mitsuba.Vector3f, optional
            Where light came from: directions on the other side of the surface are not looked at.

        Returns
        -------
        mitsuba.UInt8
            [interaction, direction]; see `value`.
        """
        import drjit as dr
        import mitsuba as mi

        n_records, n = dr.width(si.p), dr.opaque(mi.UInt32, self.n)
        lane = dr.arange(mi.UInt32, n_records)
        result = dr.zeros(mi.UInt8, n_records * self.n)
        if self.bits is not None:
            every = dr.arange(mi.UInt32, n_records * self.n)
            owner = every // n
            bit = dr.gather(mi.UInt8, self.bits, dr.gather(mi.UInt32, row, owner) * n + every % n)
            result = mi.UInt8(dr.select(bit > 0, mi.UInt32(1), mi.UInt32(0)))
            dr.eval(result)
        kind = dr.minimum(mi.UInt32(choice * self.share), self.share - 1)
        begin, end = (dr.gather(mi.UInt32, self._starts, kind + k) for k in (0, 1))
        side = None if towards is None else dr.dot(si.sh_frame.n, towards)

        # Stored with 128 added where traced: V and C are one bit each.
        def look(i: JitArray) -> tuple[JitArray]:
            direction = dr.gather(mi.UInt32, self._members, i)
            w = dr.gather(mi.Vector3f, self.vectors, direction)
            active = mi.Bool(True) if side is None else side * dr.dot(si.sh_frame.n, w) > 0
            free = active & ~tiles.occluded(si.spawn_ray(w), active, coherent=False)
            at = dr.fma(lane, n, direction)
            if self.bits is None:
                cached = mi.UInt32(0)
            else:
                cached = mi.UInt32(dr.gather(mi.UInt8, self.bits, dr.fma(row, n, direction)))
            coded = mi.UInt32(128) + cached + dr.select(free, mi.UInt32(2), mi.UInt32(0))
            dr.scatter(result, mi.UInt8(coded), at)
            return (i + 1,)

        dr.while_loop((begin,), lambda i: i < end, look)
        dr.eval(result)
        return result

    def value(self, coded: JitArray) -> JitArray:
        """Visibility as a number from its code: 0 or 1, or ``C + share (V − C)`` where it was traced."""
        import drjit as dr
        import mitsuba as mi

        word = mi.UInt32(coded)
        kept = mi.Float(word & 1)
        traced = mi.Float((word >> 1) & 1)
        return dr.select(word >= 128, dr.fma(dr.opaque(mi.Float, self.share), traced - kept, kept), kept)
