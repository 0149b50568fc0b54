"""Importance sampling of light directions from the data, shared by all methods.

The hemisphere is mapped to the unit square by ``(sin² θ, φ / 2π)``, where the cosine density is uniform, and cut into
cells. Per group of texels and measured view a table holds the mean of B / cos θ over each cell, relative to its mean
over all cells, mixed with a constant: cosine sampling is the case of equal cells, so a Lambertian BTF is sampled
exactly as by cosine. Between measured views the tables are blended with the interpolation's own weights.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics import interpolation

#: Cells in sin² θ and in φ. Finer cells would resolve more than directions 15° apart contain.
N_RADIAL, N_AZIMUTH = 8, 32
N_CELLS = N_RADIAL * N_AZIMUTH

#: Share of pure cosine sampling: bounds the weight of a sample by 1 / share times that of cosine sampling, for texels
#: that differ from their group's mean.
COSINE_SHARE = 0.4

#: Points per side of a cell over which B / cos θ is averaged.
_SUBSAMPLES = 4


def cell_directions():
    """Cosine-distributed directions that fill the cells, shape (N_CELLS, points, 3)."""
    s = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES
    radial = (np.arange(N_RADIAL)[:, None, None, None] + s[None, None, :, None]) / N_RADIAL
    azimuth = (np.arange(N_AZIMUTH)[None, :, None, None] + s[None, None, None, :]) / N_AZIMUTH * 2 * np.pi
    radial, azimuth = np.broadcast_arrays(radial, azimuth)
    r = np.sqrt(radial)
    w = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.sqrt(1 - radial)], -1)
    return w.reshape(N_CELLS, -1, 3)


def cell_densities(mean, lights):
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
    index, weight = lights.stencil(w, hold=False)
    weight = weight / w[..., 2:] / w.shape[1]
    operator = np.zeros((N_CELLS, mean.shape[-1]))
    np.add.at(operator, (np.arange(N_CELLS)[:, None, None], index), weight)
    density = np.maximum(np.maximum(mean, 0) @ operator.T, 0)
    total = density.mean(-1, keepdims=True)
    density = np.where(total > 0, density / np.where(total > 0, total, 1), 1)
    return (COSINE_SHARE + (1 - COSINE_SHARE) * density).astype(np.float32)


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

    def __init__(self, representation, views, sampling):
        group, mean = representation.sampling_tables()
        if sampling == "cosine":
            group, density = np.zeros_like(group), np.ones((1, mean.shape[1], N_CELLS), np.float32)
        else:
            density = cell_densities(mean, interpolation.from_arrays(representation.arrays(), "light"))
        rows = density.reshape(*density.shape[:2], N_RADIAL, N_AZIMUTH)
        marginal = np.cumsum(rows.sum(-1), -1)
        conditional = np.cumsum(rows, -1)
        self.views = views
        self.shape = group.shape
        self.n_views = density.shape[1]
        self.single_group = density.shape[0] == 1
        self.group = mi.UInt32(np.ascontiguousarray(group, np.uint32).ravel())
        self.density = mi.Float(density.ravel())
        self.marginal = mi.Float((marginal / marginal[..., -1:]).astype(np.float32).ravel())
        self.conditional = mi.Float((conditional / conditional[..., -1:]).astype(np.float32).ravel())
        dr.eval(self.group, self.density, self.marginal, self.conditional)

    def _first_table(self, uv, active):
        """Index of the tables of the texel's group."""
        if self.single_group:
            return mi.UInt32(0)
        from mitsuba_plugins.lookup import texel_stencil

        (texel,), _ = texel_stencil(uv, self.shape, "nearest")
        return dr.gather(mi.UInt32, self.group, texel, active) * self.n_views

    def neighbours(self, uv, w_view, active):
        """Tables that the view direction blends, as a list of (table, weight); weights sum to 1."""
        first = self._first_table(uv, active)
        return [
            (first + view, weight)
            for neighbour in self.views.stencil(w_view)
            for view, weight in neighbour.single()
        ]

    def pdf(self, neighbours, w_light, active):
        """Density with respect to solid angle in 1/sr."""
        radial = dr.fma(w_light.x, w_light.x, w_light.y * w_light.y)
        turn = dr.atan2(w_light.y, w_light.x) * (0.5 / np.pi)
        turn = dr.select(turn < 0, turn + 1, turn)
        row = dr.minimum(mi.UInt32(radial * N_RADIAL), N_RADIAL - 1)
        column = dr.minimum(mi.UInt32(turn * N_AZIMUTH), N_AZIMUTH - 1)
        cell = row * N_AZIMUTH + column
        density = mi.Float(0)
        for table, weight in neighbours:
            value = dr.gather(mi.Float, self.density, table * N_CELLS + cell, active)
            density = dr.fma(value, weight, density)
        return dr.select(active, density * dr.maximum(w_light.z, 0) * dr.inv_pi, 0)

    def sample(self, neighbours, sample1, sample2, active):
        """A light direction with density :meth:`pdf`.

        Parameters
        ----------
        neighbours : list of (UInt32, Float)
            From :meth:`neighbours`.
        sample1 : Float
            Chooses among the neighbouring views.
        sample2 : Point2f
            Warped to the hemisphere; stratification survives within a view's table.
        """
        table, cumulative = neighbours[0][0], mi.Float(0)
        for following, weight in neighbours:
            # A view without weight is never chosen: its interval is empty.
            table = dr.select((sample1 >= cumulative) & (weight > 0), following, table)
            cumulative = cumulative + weight
        row, x = self._invert(self.marginal, table * N_RADIAL, N_RADIAL, sample2.x, active)
        column, y = self._invert(
            self.conditional, (table * N_RADIAL + row) * N_AZIMUTH, N_AZIMUTH, sample2.y, active
        )
        radial = (mi.Float(row) + x) / N_RADIAL
        azimuth = (mi.Float(column) + y) * (2 * np.pi / N_AZIMUTH)
        r = dr.sqrt(radial)
        s, c = dr.sincos(azimuth)
        return mi.Vector3f(r * c, r * s, dr.sqrt(dr.maximum(1 - radial, 0)))

    @staticmethod
    def _invert(table, start, n, sample, active):
        """Cell of a cumulative table that holds ``sample``, and the position inside of it in [0, 1)."""
        index, low, step = mi.UInt32(0), mi.Float(0), n // 2
        while step:
            value = dr.gather(mi.Float, table, start + index + (step - 1), active)
            right = sample >= value
            index = dr.select(right, index + step, index)
            low = dr.select(right, value, low)
            step //= 2
        high = dr.gather(mi.Float, table, start + index, active)
        position = (sample - low) / dr.maximum(high - low, 1e-20)
        return index, dr.clip(position, 0, dr.one_minus_epsilon(mi.Float))
