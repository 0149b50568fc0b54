"""Dr.Jit port of :mod:`btfref.numerics.heightfield`: rays through a periodic field of bilinear patches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.types import JitArray
from mitsuba_plugins.lib.lookup import texel_position

if TYPE_CHECKING:
    from btfref.types import Facts


#: Stands for "never": far beyond every ray parameter, which is at most 1.
_NEVER = 1e30


#: Column and row of a cell, position in it, height.
Hit = tuple[JitArray, JitArray, JitArray]


class HeightField:
    """Marches through cells; heights are not differentiated through a hit.

    Parameters
    ----------
    cells : Float
        Corner heights, four a texel.
    shape : tuple of int
        Rows and columns.
    constants : dict
        ``top``, ``bottom``, ``tangent_limit``, ``lift``, ``maximum_steps``.
    """

    def __init__(self, cells: JitArray, shape: tuple[int, int], constants: Facts) -> None:
        self.cells = mi.Float(dr.detach(cells))
        dr.eval(self.cells)
        self.rows, self.columns = shape
        self.constants = constants
        self.depth = constants["top"] - constants["bottom"]

    def tangents(self, w: JitArray) -> JitArray:
        """``w_xy / w_z`` held at the limit."""
        across = dr.sqrt(dr.fma(w.x, w.x, w.y * w.y))
        scale = 1 / dr.maximum(w.z, across * (1 / self.constants["tangent_limit"]))
        return mi.Vector2f(w.x * scale, w.y * scale)

    def view_hit(self, uv: JitArray, w: JitArray, active: JitArray) -> Hit:
        """First point on the ray towards ``w`` through ``uv`` at z = 0: (column, row), position in it, height."""
        size = mi.Vector2f(self.columns, self.rows)
        top, depth = self.constants["top"], self.depth
        tangent = self.tangents(w)
        low, start = texel_position(uv, (self.rows, self.columns), 0.5)
        start = start + tangent * size * top
        whole = dr.floor(start)
        start = start - whole
        cell = self._wrapped(low + whole)
        if depth == 0:
            return cell, start, self._patch(cell, start, active)[0]
        travel = tangent * size * -depth
        s, crossed = self._march(cell, start, travel, mi.Float(top), mi.Float(-depth), None, active)
        local = dr.clip(dr.fma(travel, dr.minimum(s, 1), start - crossed), 0, 1)
        cell = self._wrapped(cell + crossed)
        return cell, local, self._patch(cell, local, active)[0]

    def lit(
        self, cell: JitArray, local: JitArray, height: JitArray, w: JitArray, active: JitArray
    ) -> JitArray:
        """Whether a point sees the direction ``w``."""
        if self.depth == 0:
            return mi.Bool(True)
        rise = self.constants["top"] - height
        above = rise <= self.constants["lift"]
        travel = self.tangents(w) * mi.Vector2f(self.columns, self.rows) * rise
        lift = dr.opaque(mi.Float, self.constants["lift"])
        s, _ = self._march(cell, local, travel, height, rise, lift, active & ~above)
        return above | (s > 1)

    def _wrapped(self, cell: JitArray) -> JitArray:
        """A cell of the tile; cells are floats, which hold these integers exactly."""
        size = mi.Vector2f(self.columns, self.rows)
        return cell - size * dr.floor((cell + 0.5) / size)

    def _patch(
        self, cell: JitArray, at: JitArray, active: JitArray
    ) -> tuple[JitArray, JitArray, JitArray, JitArray]:
        """Height at a position in a cell, and the patch's coefficients of x, y and xy."""
        index = mi.UInt32(dr.fma(cell.y, self.columns, cell.x))
        h00, h10, h01, h11 = dr.gather(mi.Vector4f, self.cells, index, active)
        hx, hy = h10 - h00, h01 - h00
        hxy = (h11 - h10) - hy
        return dr.fma(dr.fma(hxy, at.x, hy), at.y, dr.fma(hx, at.x, h00)), hx, hy, hxy

    def _march(
        self,
        cell: JitArray,
        start: JitArray,
        travel: JitArray,
        z0: JitArray,
        dz: JitArray,
        lift: JitArray,
        active: JitArray,
    ) -> tuple[JitArray, JitArray]:
        """Parameter of the first hit, ``_NEVER`` where there is none up to 1, and the cells crossed before it."""
        moving = mi.Vector2f(dr.select(travel != 0, 1, 0))
        inverse = dr.select(travel != 0, 1 / dr.select(travel != 0, travel, 1), 0)
        forward = dr.select(travel > 0, mi.Vector2f(1), 0)
        step = dr.select(travel > 0, mi.Vector2f(1), -1)
        limit = self.constants["maximum_steps"]

        def body(
            going: JitArray,
            s: JitArray,
            crossed: JitArray,
            hit: JitArray,
            n: JitArray,
            cell: JitArray,
            start: JitArray,
            travel: JitArray,
            z0: JitArray,
            dz: JitArray,
            inverse: JitArray,
            forward: JitArray,
            step: JitArray,
            moving: JitArray,
            lift: JitArray,
        ) -> tuple[JitArray, ...]:
            local = dr.clip(dr.fma(travel, s, start - crossed), 0, 1)
            height, hx, hy, hxy = self._patch(self._wrapped(cell + crossed), local, going)
            f0 = dr.fma(dz, s, z0) - height + lift
            if shadow:
                f0 = dr.select(n == 0, lift, f0)
            f1 = dz - dr.fma(hxy, local.y, hx) * travel.x - dr.fma(hxy, local.x, hy) * travel.y
            f2 = -hxy * travel.x * travel.y
            border = dr.select(moving > 0, (crossed + forward - start) * inverse, _NEVER)
            leave = dr.maximum(dr.minimum(dr.minimum(border.x, border.y), 1), s)
            q = first_root(f0, f1, f2)
            found = q <= leave - s
            hit = dr.select(going & found, s + q, hit)
            onward = going & ~found & (leave < 1)
            across_x = border.x <= border.y
            crossed = mi.Vector2f(
                dr.select(onward & across_x, crossed.x + step.x, crossed.x),
                dr.select(onward & ~across_x, crossed.y + step.y, crossed.y),
            )
            s = dr.select(onward, leave, s)
            n = n + 1
            onward &= n < limit
            return (
                onward,
                s,
                crossed,
                hit,
                n,
                cell,
                start,
                travel,
                z0,
                dz,
                inverse,
                forward,
                step,
                moving,
                lift,
            )

        shadow = lift is not None
        state = (
            mi.Bool(active),
            mi.Float(0),
            mi.Vector2f(0),
            mi.Float(_NEVER),
            mi.UInt32(0),
            mi.Vector2f(cell),
            mi.Vector2f(start),
            mi.Vector2f(travel),
            mi.Float(z0),
            mi.Float(dz),
            inverse,
            forward,
            step,
            moving,
            mi.Float(lift if shadow else 0),
        )
        state = dr.while_loop(state, lambda going, *_: going, body, label="heightfield")
        return state[3], state[2]


def first_root(f0: JitArray, f1: JitArray, f2: JitArray) -> JitArray:
    """As :func:`btfref.numerics.heightfield.first_root`."""
    disc = dr.fma(f1, f1, -4 * f2 * f0)
    root = dr.sqrt(dr.maximum(disc, 0))
    falls = f1 <= 0
    numerator = dr.select(falls, 2 * f0, f1 + root)
    denominator = dr.select(falls, root - f1, -2 * f2)
    there = (disc >= 0) & (denominator > 0)
    q = dr.select(there, numerator / dr.select(there, denominator, 1), _NEVER)
    return dr.select(f0 <= 0, 0, q)
