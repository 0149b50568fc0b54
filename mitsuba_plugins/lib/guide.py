"""Importance sampling of light directions from the data, shared by all methods.

The hemisphere is mapped to the unit square by ``(sin² θ, φ / 2π)``, where the cosine density is uniform, and cut into
cells. Per group of texels and measured view a table holds the mean of B / cos θ over each cell, relative to its mean
over all cells, mixed with a constant: cosine sampling is the case of equal cells, so a Lambertian BTF is sampled
exactly as by cosine. Between measured views the tables are blended with the interpolation's own weights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere import interpolation
from btfref.representations.protocol import HasLevels
from mitsuba_plugins.lib.lookup import single, texel_stencil

if TYPE_CHECKING:
    from btfref.numerics.sphere.interpolation import Interpolation
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray
    from mitsuba_plugins.lib.lookup import DirectionTable


#: Cells in sin² θ and in φ. Finer cells would resolve more than directions 15° apart contain.
N_RADIAL, N_AZIMUTH = 8, 32
N_CELLS = N_RADIAL * N_AZIMUTH

#: An entry of an alias table is one word: the alias below, the threshold above.
ALIAS_BITS = N_CELLS.bit_length() - 1

#: Share of pure cosine sampling: bounds the weight of a sample by 1 / share times that of cosine sampling, for texels
#: that differ from their group's mean.
COSINE_SHARE = 0.4

#: Alias tables that are made at once: what this many need stays in a core's own cache.
_BLOCK = 64

#: Points per side of a cell over which B / cos θ is averaged.
_SUBSAMPLES = 4


def cell_directions() -> np.ndarray:
    """Cosine-distributed directions that fill the cells, shape (N_CELLS, points, 3)."""
    s = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES
    radial = (np.arange(N_RADIAL)[:, None, None, None] + s[None, None, :, None]) / N_RADIAL
    azimuth = (np.arange(N_AZIMUTH)[None, :, None, None] + s[None, None, None, :]) / N_AZIMUTH * 2 * np.pi
    radial, azimuth = np.broadcast_arrays(radial, azimuth)
    r = np.sqrt(radial)
    w = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.sqrt(1 - radial)], -1)
    return w.reshape(N_CELLS, -1, 3)


def cell_densities(mean: np.ndarray, lights: Interpolation) -> np.ndarray:
    """Relative densities of the cells.

    Parameters
    ----------
    mean : ndarray, shape (n_groups, n_views, n_lights)
        Mean luminance of B, cosine included.
    lights : RingInterpolation or TriangleInterpolation

    Returns
    -------
    ndarray of float32, shape (n_groups, n_views, N_CELLS)
        Positive; mean over the cells 1, at least ``COSINE_SHARE``.
    """
    w = cell_directions()
    if isinstance(lights, interpolation.ResidentInterpolation):
        # Lights that are not kept are not sampled by the data either: they count as black.
        mean = np.where(
            lights.slots == interpolation.MISSING, 0, mean[..., np.minimum(lights.slots, mean.shape[-1] - 1)]
        )
        lights = lights.inner
    index, weight = lights.stencil(w, hold=False)
    weight = weight / w[..., 2:] / w.shape[1]
    operator = np.zeros((N_CELLS, mean.shape[-1]))
    np.add.at(operator, (np.arange(N_CELLS)[:, None, None], index), weight)
    density = np.maximum(np.maximum(mean, 0) @ operator.T, 0)
    total = density.mean(-1, keepdims=True)
    density = np.where(total > 0, density / np.where(total > 0, total, 1), 1)
    return (COSINE_SHARE + (1 - COSINE_SHARE) * density).astype(np.float32)


def alias_tables(weights: np.ndarray, bits: int = ALIAS_BITS) -> np.ndarray:
    """Alias tables (Walker 1977), all rows at once.

    Two sweeps fill a table, one over the cells below the mean, one over those above: each poor cell is filled by the
    rich one that the sweep stands at, and a rich cell that has given away its surplus is filled by the next rich one.
    Where the sweeps stand follows from prefix sums of deficits and surpluses (Hübschle-Schneider and Sanders 2022,
    "Parallel Weighted Random Sampling", section 4.3), so that no loop goes over cells.

    Parameters
    ----------
    weights : ndarray, shape (n_tables, n)
        Non-negative, not all 0 in a row; proportional to the probabilities.
    bits : int
        Of an entry for the alias: 2^bits ≥ n.

    Returns
    -------
    ndarray of uint32, shape (n_tables, n)
        Threshold in steps of 2^(bits − 32) above the ``bits`` low bits, which hold the alias. See :func:`drawn`.
    """
    tables = np.zeros(weights.shape, np.uint32)
    for first in range(0, len(weights), _BLOCK):
        block = slice(first, first + _BLOCK)
        tables[block] = _alias_tables(weights[block], bits)
    return tables


def _alias_tables(weights: np.ndarray, bits: int) -> np.ndarray:
    n_tables, n = weights.shape
    surplus = np.asarray(weights, float) * (n / weights.sum(1, keepdims=True)) - 1
    poor = surplus < 0
    lacking, spare = np.cumsum(np.where(poor, -surplus, 0), 1), np.cumsum(np.where(poor, 0, surplus), 1)
    # Rows one after the other on one axis: neither sum reaches n.
    start = 2.0 * n * np.arange(n_tables)[:, None]
    first, end = n * np.arange(n_tables)[:, None], n - 1
    # A poor cell takes from the first rich one with something left after the poor ones before it; a rich one that
    # is used up takes from the next.
    reached = np.where(poor, lacking + surplus, spare)
    alias = np.searchsorted((spare + start).ravel(), reached + start, side="right") - first
    emptied = np.searchsorted((lacking + start).ravel(), spare + start) - first
    left = 1 + spare - np.take_along_axis(lacking, np.minimum(emptied, end), 1)
    threshold = np.clip(np.where(poor, 1 + surplus, np.where(emptied > end, 1, left)), 0, 1)
    # The last of either kind keeps itself: what the sums' rounding leaves is not given away.
    threshold = np.where(alias > end, 1, threshold)
    most = 1 << (32 - bits)
    steps = np.minimum(np.round(threshold * most).astype(np.uint32), most - 1)
    return steps << bits | np.minimum(alias, end).astype(np.uint32)


def drawn(
    tables: JitArray, first: JitArray, count: int, bits: int, sample: JitArray
) -> tuple[JitArray, JitArray]:
    """A cell of an alias table, and a number in [0, 1) that is uniform again.

    Parameters
    ----------
    tables : UInt32
        Entries of :func:`alias_tables`, one table after the other.
    first : UInt32
        Where the table begins.
    count, bits : int
        Cells of a table, and bits of an alias.
    sample : Float
        Uniform in [0, 1).
    """
    scaled = sample * count
    cell = dr.minimum(mi.UInt32(scaled), count - 1)
    rest = scaled - mi.Float(cell)
    entry = dr.gather(mi.UInt32, tables, first + cell)
    threshold = mi.Float(entry >> bits) * 2.0 ** (bits - 32)
    keep = rest < threshold
    cell = dr.select(keep, cell, entry & ((1 << bits) - 1))
    # What is left of the number, after its two decisions, is uniform again.
    below, above = (dr.maximum(x, 1e-20) for x in (threshold, 1 - threshold))
    x = dr.select(keep, rest / below, (rest - threshold) / above)
    return cell, dr.clip(x, 0, dr.one_minus_epsilon(mi.Float))


class LightGuide:
    """Samples and densities of light directions for one representation.

    Parameters
    ----------
    representation : Representation
    views : RingTable or TriangleTable
        Port of the interpolation over views.
    sampling : {"data", "cosine"}
        "cosine" ignores the data: the yardstick that the guide is measured against.
    """

    def __init__(self, representation: Representation, views: DirectionTable, sampling: str) -> None:
        self.uniform = sampling == "cosine"
        if self.uniform:
            # The same for all texels and views: nothing of the representation is looked at.
            self.shapes, group = [(1, 1)], np.zeros((1, 1), np.uint32)
            density = np.ones((1, 1, N_CELLS), np.float32)
        else:
            if isinstance(representation, HasLevels):
                levels = range(representation.sampling_levels)
                tables = [representation.sampling_tables(level) for level in levels]
            else:
                tables = [representation.sampling_tables()]
            self.shapes = [group.shape for group, _ in tables]
            lights = interpolation.from_arrays(representation.arrays(), "light")
            density = np.concatenate([cell_densities(mean, lights) for _, mean in tables])
            first = np.cumsum([0, *(len(mean) for _, mean in tables)])
            group = np.concatenate([f + g.ravel() for f, (g, _) in zip(first, tables, strict=False)])
        self.views = views
        self.n_views = density.shape[1]
        self.single_group = density.shape[0] == 1
        self.group = to_device(mi.UInt32, group)
        self.density = to_device(mi.Float, density)
        self.alias = to_device(mi.UInt32, alias_tables(density.reshape(-1, N_CELLS)))
        start = np.cumsum([0, *(rows * columns for rows, columns in self.shapes)])
        sizes = [[*shape, at, 0] for shape, at in zip(self.shapes, start, strict=False)]
        self.sizes = to_device(mi.UInt32, sizes)
        dr.eval(self.group, self.density, self.alias, self.sizes)

    def _first_table(self, uv: JitArray, lod: JitArray) -> JitArray:
        """Index of the tables of the group of the texel, of the level nearest to ``lod`` where there are levels."""
        if self.single_group:
            return mi.UInt32(0)
        if lod is None or len(self.shapes) == 1:
            (texel,), _ = texel_stencil(uv, self.shapes[0], "nearest")
        else:
            level = mi.UInt32(dr.clip(lod + 0.5, 0, len(self.shapes) - 1))
            rows, columns, first, _ = dr.gather(mi.Array4u, self.sizes, level)
            (texel,), _ = texel_stencil(uv, (rows, columns), "nearest")
            texel = first + texel
        return dr.gather(mi.UInt32, self.group, texel) * self.n_views

    def neighbours(
        self, uv: JitArray, w_view: JitArray, lod: JitArray = None, draw: JitArray = None
    ) -> list[tuple[JitArray, JitArray]]:
        """Tables that the view direction blends, or draws, as a list of (table, weight); weights sum to 1."""
        if self.uniform:
            return [(mi.UInt32(0), mi.Float(1))]
        first = self._first_table(uv, lod)
        return [(first + view, weight) for view, weight in single(self.views.stencil(w_view, draw=draw))]

    def pdf(
        self, neighbours: list[tuple[JitArray, JitArray]], w_light: JitArray, active: JitArray
    ) -> JitArray:
        """Density with respect to solid angle in 1/sr."""
        radial = dr.fma(w_light.x, w_light.x, w_light.y * w_light.y)
        turn = dr.atan2(w_light.y, w_light.x) * (0.5 / np.pi)
        turn = dr.select(turn < 0, turn + 1, turn)
        row = dr.minimum(mi.UInt32(radial * N_RADIAL), N_RADIAL - 1)
        column = dr.minimum(mi.UInt32(turn * N_AZIMUTH), N_AZIMUTH - 1)
        cell = row * N_AZIMUTH + column
        density = mi.Float(0)
        for table, weight in neighbours:
            value = dr.gather(mi.Float, self.density, table * N_CELLS + cell)
            density = dr.fma(value, weight, density)
        return dr.select(active, density * dr.maximum(w_light.z, 0) * dr.inv_pi, 0)

    def sample(
        self, neighbours: list[tuple[JitArray, JitArray]], sample1: JitArray, sample2: JitArray
    ) -> JitArray:
        """A light direction with density :meth:`pdf`.

        Parameters
        ----------
        neighbours : list of (UInt32, Float)
            From :meth:`neighbours`.
        sample1 : Float
            Chooses among the neighbouring views.
        sample2 : Point2f
            Chooses the cell and the position in it.
        """
        table, cumulative = neighbours[0][0], mi.Float(0)
        for following, weight in neighbours:
            # A view without weight is never chosen: its interval is empty.
            table = dr.select((sample1 >= cumulative) & (weight > 0), following, table)
            cumulative = cumulative + weight
        cell, x = drawn(self.alias, table * N_CELLS, N_CELLS, ALIAS_BITS, sample2.x)
        radial = (mi.Float(cell // N_AZIMUTH) + x) / N_RADIAL
        # The sum may round up to 1, which is the horizon.
        radial = dr.minimum(radial, dr.one_minus_epsilon(mi.Float))
        azimuth = (mi.Float(cell % N_AZIMUTH) + sample2.y) * (2 * np.pi / N_AZIMUTH)
        r = dr.sqrt(radial)
        s, c = dr.sincos(azimuth)
        return mi.Vector3f(r * c, r * s, dr.sqrt(dr.maximum(1 - radial, 0)))
