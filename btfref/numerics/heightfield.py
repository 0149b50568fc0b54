"""Rays through a periodic height field of bilinear patches: exact hits, no fixed steps.

Heights stand at texel centres (i + ½)/n; between four of them the surface is the bilinear patch. A ray of direction
w through (u, v) on the plane z = 0 is at ``uv + z w_xy / w_z`` at height z. It is followed from the top of the field to
its bottom, cell by cell; in a cell the height above the surface is a quadratic in the ray's parameter, whose first root
is the hit. Source of the idea: parallax occlusion mapping (N. Tatarchuk, "Dynamic Parallax Occlusion Mapping with
Approximate Soft Shadows", 2006), whose linear search and refinement the quadratic replaces. The ports are
:mod:`mitsuba_plugins.lib.heightfield` and ``shaders/lib/surface/heightfield.glsl``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from btfref.precision import real

#: Tiles that a ray may travel sideways: what bounds the steps at grazing. Steeper than that it never is: its tangent is
#: held at this limit, which is part of the definition. 4 tiles through a field 0.15 deep are 88° from the normal.
MAXIMUM_TRAVEL = 4.0

#: Tiles that a height may be away from the plane z = 0, as for mesostructures.
HEIGHT_LIMIT = 4.0

#: Shadow rays start this share of the height's range above the surface: rounding must not shadow a point by itself.
LIFT = 1e-5


@dataclass(frozen=True)
class Hit:
    """Points on the surface.

    Attributes
    ----------
    cell : ndarray of int64, shape (N, 2)
        Column and row of the patch: the texel of its lower corner.
    local : ndarray, shape (N, 2)
        Position in the patch, [0, 1]².
    height : ndarray, shape (N,)
        Tile units.
    """

    cell: np.ndarray
    local: np.ndarray
    height: np.ndarray

    def __getitem__(self, index: np.ndarray | slice) -> Hit:
        """Some of the points."""
        return Hit(self.cell[index], self.local[index], self.height[index])


@dataclass(frozen=True, eq=False)
class HeightField:
    """A periodic height field.

    Parameters
    ----------
    heights : ndarray of float32, shape (rows, columns)
        Tile units.
    """

    heights: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.heights.shape

    @cached_property
    def top(self) -> float:
        """Largest height."""
        return float(self.heights.max())

    @cached_property
    def bottom(self) -> float:
        """Smallest height."""
        return float(self.heights.min())

    @property
    def depth(self) -> float:
        """Distance from the bottom to the top."""
        return self.top - self.bottom

    @property
    def tangent_limit(self) -> float:
        """Largest tangent of a ray: with it, no ray travels further than :data:`MAXIMUM_TRAVEL`."""
        return MAXIMUM_TRAVEL / max(self.depth, abs(self.top), abs(self.bottom), 1e-6)

    @property
    def maximum_steps(self) -> int:
        """Most cells that a ray can cross."""
        return int(2 * MAXIMUM_TRAVEL * max(self.shape)) + 4

    @cached_property
    def cells(self) -> np.ndarray:
        """Corner heights of the patches, float32 (rows, columns, 4).

        In the order (row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1).
        """
        h = np.asarray(self.heights, np.float32)
        right = np.roll(h, -1, 1)
        return np.stack([h, right, np.roll(h, -1, 0), np.roll(right, -1, 0)], -1)

    @cached_property
    def slopes(self) -> np.ndarray:
        """Derivatives along u and v at the texel centres by the Sobel filter, float32 (rows, columns, 2)."""
        h = np.asarray(self.heights, float)
        rows, columns = h.shape
        result = []
        for axis, n in ((1, columns), (0, rows)):
            step = np.roll(h, -1, axis) - np.roll(h, 1, axis)
            smooth = np.roll(step, 1, 1 - axis) + 2 * step + np.roll(step, -1, 1 - axis)
            result.append(smooth * (n / 8))
        return np.stack(result, -1).astype(np.float32)

    def tangents(self, w: np.ndarray) -> np.ndarray:
        """``w_xy / w_z``, held at :attr:`tangent_limit`; shape (N, 3) -> (N, 2)."""
        w = real(w)
        across = np.hypot(w[:, 0], w[:, 1])
        return w[:, :2] / np.maximum(w[:, 2], across / self.tangent_limit)[:, None]

    def view_hits(self, uv: np.ndarray, w: np.ndarray) -> Hit:
        """First points of the surface on rays from above.

        Parameters
        ----------
        uv : ndarray, shape (N, 2)
            Where the rays cross the plane z = 0; not finite counts as 0.
        w : ndarray, shape (N, 3)
            Towards the viewer, above the horizon.

        Returns
        -------
        Hit
        """
        size = real([self.shape[1], self.shape[0]])
        uv = np.where(np.isfinite(uv), uv, 0.0)
        tangent = self.tangents(w)
        position = (uv - np.floor(uv)) * size - 0.5 + self.top * tangent * size
        cell = np.floor(position)
        start = position - cell
        n = len(uv)
        travel = -self.depth * tangent * size
        s, crossed = self._march(
            cell.astype(np.int64), start, travel, real(np.full(n, self.top)), real(np.full(n, -self.depth))
        )
        return self._hit(cell.astype(np.int64), start, travel, np.minimum(s, 1), crossed)

    def points(self, uv: np.ndarray) -> Hit:
        """Points of the surface above positions of the tile, shape (N, 2) -> Hit."""
        position = real(uv) * real([self.shape[1], self.shape[0]]) - 0.5
        cell = np.floor(position)
        zero = np.zeros_like(position)
        return self._hit(
            cell.astype(np.int64), position - cell, zero, np.zeros(len(position), zero.dtype), zero
        )

    def lit(self, hit: Hit, w: np.ndarray) -> np.ndarray:
        """Whether points see a direction.

        Parameters
        ----------
        hit : Hit
        w : ndarray, shape (N, 3)
            Above the horizon.

        Returns
        -------
        ndarray of bool, shape (N,)
        """
        lift = LIFT * self.depth
        rise = self.top - hit.height
        # A ray that starts within the lift of the top is above everything.
        result = rise <= lift
        rest = np.flatnonzero(~result)
        if len(rest):
            hit = hit[rest]
            travel = (
                rise[rest, None] * self.tangents(np.asarray(w)[rest]) * real([self.shape[1], self.shape[0]])
            )
            s, _ = self._march(hit.cell, hit.local, travel, hit.height, rise[rest], lift)
            result[rest] = s > 1
        return result

    def _hit(
        self, cell: np.ndarray, start: np.ndarray, travel: np.ndarray, s: np.ndarray, crossed: np.ndarray
    ) -> Hit:
        size = np.array([self.shape[1], self.shape[0]])
        cell = (cell + crossed.astype(np.int64)) % size
        local = np.clip(start - crossed + s[:, None] * travel, 0, 1)
        height, _, _, _ = self._patch(cell[:, 0], cell[:, 1], local[:, 0], local[:, 1])
        return Hit(cell, local, height)

    def _patch(
        self, column: np.ndarray, row: np.ndarray, a: np.ndarray, b: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Height at (a, b) of a patch, and its coefficients of a, b and ab."""
        h00, h10, h01, h11 = np.moveaxis(real(self.cells[row, column]), -1, 0)
        hx, hy = h10 - h00, h01 - h00
        hxy = (h11 - h10) - hy
        return h00 + hx * a + (hy + hxy * a) * b, hx, hy, hxy

    def _march(
        self,
        cell: np.ndarray,
        start: np.ndarray,
        travel: np.ndarray,
        z0: np.ndarray,
        dz: np.ndarray,
        lift: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parameter of the first hit, infinite where there is none up to 1, and the cells crossed before it.

        Parameters
        ----------
        cell, start, travel : ndarray, shape (N, 2)
            First cell, position in it, and the way to go, in texels.
        z0, dz : ndarray, shape (N,)
            Height at the start, and how much it changes.
        lift : float, optional
            Of shadow rays, which start on the surface: what they are raised by.
        """
        n, kind = len(start), start.dtype
        hit, crossed_at_hit = np.full(n, np.inf, kind), np.zeros((n, 2), kind)
        rows, columns = self.shape
        # What is below the smallest normal float32 moves no ray, and has no finite inverse there.
        moving = np.abs(travel) > 2.0**-126
        forward = (travel > 0).astype(kind)
        inverse = np.where(moving, 1 / np.where(moving, travel, 1), 0)
        active = np.arange(n)
        s, crossed = np.zeros(n, kind), np.zeros((n, 2), kind)
        first = True
        while len(active):
            dx, dy = travel[active].T
            local = np.clip(start[active] - crossed + s[:, None] * travel[active], 0, 1)
            index = cell[active] + crossed.astype(np.int64)
            height, hx, hy, hxy = self._patch(index[:, 0] % columns, index[:, 1] % rows, *local.T)
            f0 = z0[active] + s * dz[active] - height
            if lift is not None:
                f0 = np.full(len(active), lift, kind) if first else f0 + lift
            f1 = dz[active] - (hx + hxy * local[:, 1]) * dx - (hy + hxy * local[:, 0]) * dy
            f2 = -hxy * dx * dy
            border = np.where(
                moving[active], (crossed + forward[active] - start[active]) * inverse[active], np.inf
            )
            leave = np.maximum(np.minimum(border.min(1), 1), s)
            q = first_root(f0, f1, f2)
            found = q <= leave - s
            hit[active[found]] = (s + q)[found]
            crossed_at_hit[active[found]] = crossed[found]
            going = ~found & (leave < 1)
            # Where nothing is found the last cell stays: its far end is the bottom.
            last = ~found & ~going
            crossed_at_hit[active[last]] = crossed[last]
            across_x = border[going, 0] <= border[going, 1]
            step = np.where(travel[active[going]] > 0, kind.type(1), kind.type(-1))
            step[:, 0] *= across_x
            step[:, 1] *= ~across_x
            crossed = crossed[going] + step
            s, active, first = leave[going], active[going], False
        return hit, crossed_at_hit


def first_root(f0: np.ndarray, f1: np.ndarray, f2: np.ndarray) -> np.ndarray:
    """Smallest q ≥ 0 with ``f0 + f1 q + f2 q² ≤ 0``, infinite where there is none; without cancellation."""
    disc = f1 * f1 - 4 * f2 * f0
    root = np.sqrt(np.maximum(disc, 0))
    # Falling at first, or rising and bending down.
    falls = f1 <= 0
    numerator = np.where(falls, 2 * f0, f1 + root)
    denominator = np.where(falls, root - f1, -2 * f2)
    there = (disc >= 0) & (denominator > 0) & (f0 > 0)
    with np.errstate(over="ignore"):
        q = np.where(there, numerator / np.where(there, denominator, 1), np.inf)
    return np.where(f0 <= 0, 0.0, q)
