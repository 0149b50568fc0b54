"""A BSDF as a broad lobe that separates into view and light, and the rest.

``f = ρ a(cos θ_view) a(cos θ_light) / π + rest``. Light that arrives by way of the broad lobe is the same
number for all views but for a(cos θ_view), so it is gathered once; the rest is sampled per view. The rest may
be negative: nothing but noise depends on how good the split is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.types import JitArray

#: Entries of the table of a: those of Mitsuba's rough plastic, so that its lobe is the table's to the last bits.
N_TABLE = 64

#: Deviation of a diffuse lobe from the table, relative to its largest value, below which nothing tells them apart.
EXACT = 1e-5

#: Largest deviation of a diffuse lobe from the product, relative to its largest value, to be taken as it is.
SEPARABLE = 2e-3


class BroadLobes:
    """Broad lobes of several BSDFs; build inside a variant.

    Parameters
    ----------
    bsdfs : list of mitsuba.BSDF

    Attributes
    ----------
    masked : bool
        Whether every BSDF can sample and evaluate the rest by itself (it honours Mitsuba's type mask).
    any : bool
        Whether there is any broad lobe.
    exact : bool
        Whether every broad lobe is the table's, and the rest evaluates by itself.
    drawn : mitsuba.BSDFContext
        Lobes that the rest is sampled by.
    """

    def __init__(self, bsdfs: Sequence[JitArray]) -> None:
        import drjit as dr
        import mitsuba as mi

        self.ids = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs]
        size = max(self.ids) + 1
        tables, kind = np.ones((size, N_TABLE)), np.zeros(size)
        exact = True
        diffuse = int(mi.BSDFFlags.DiffuseReflection)
        everything = int(mi.BSDFContext().type_mask)
        self.full, self.diffuse, self.rest = (mi.BSDFContext() for _ in range(3))
        self.diffuse.type_mask = diffuse
        self.rest.type_mask = everything & ~diffuse
        for index, bsdf in zip(self.ids, bsdfs, strict=True):
            if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection):
                continue
            table, deviation = self._separated(bsdf)
            exact &= deviation <= EXACT
            kind[index] = 1 if table is None else 2
            if table is not None:
                tables[index] = table
        used = kind[self.ids]
        # Without a broad lobe everything is the rest, whatever the mask.
        self.masked = bool((used != 1).all() and (used == 2).any())
        self.any = bool((used > 0).any())
        self.exact = self.masked and exact
        self.drawn = self.rest if self.masked else self.full
        self._kind, self._table = to_device(mi.Float, kind), to_device(mi.Float, tables)
        self.table = tables

    def _separated(self, bsdf: JitArray) -> tuple[np.ndarray | None, float]:
        """The table of a when the BSDF keeps its diffuse lobe apart and that lobe separates, else None; deviation."""
        import drjit as dr
        import mitsuba as mi

        z = np.linspace(0, 1, N_TABLE)
        z[0] = 1e-3

        def value(
            context: JitArray, wi: np.ndarray, wo: np.ndarray, uv: ArrayLike = (0.37, 0.61)
        ) -> np.ndarray:
            si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
            si.wi, si.uv = to_device(mi.Vector3f, wi.T), to_device(mi.Point2f, uv)
            si.n = mi.Normal3f(0, 0, 1)
            si.sh_frame = mi.Frame3f(si.n)
            return np.array(bsdf.eval(context, si, to_device(mi.Vector3f, wo.T))).T

        rng = np.random.default_rng(0)
        wi, wo = (np.abs(rng.normal(size=(512, 3))) for _ in range(2))
        wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (wi, wo))
        parts = value(self.diffuse, wi, wo) + value(self.rest, wi, wo)
        full = value(self.full, wi, wo)
        if np.abs(parts - full).max() > SEPARABLE * np.abs(full).max():
            return None, np.inf
        normal = np.tile([0.0, 0.0, 1.0], (N_TABLE, 1))
        slanted = np.stack([np.sqrt(1 - z**2), np.zeros_like(z), z], 1)
        along = value(self.diffuse, slanted, normal)
        if along[-1].max() <= 0:
            return None, np.inf
        table = along.sum(1) / along[-1].sum()
        # The first was taken off the horizon.
        t = z[0] * (N_TABLE - 1)
        table[0] = (table[0] - t * table[1]) / (1 - t)
        z[0] = 0
        model = np.interp(wi[:, 2], z, table) * np.interp(wo[:, 2], z, table) * wo[:, 2]
        # Elsewhere on a texture the lobe may be of another colour, not of another shape.
        uv, up = rng.random((2, len(wi))), np.tile([0.0, 0.0, 1.0], (len(wi), 1))
        model = model[:, None] * value(self.diffuse, up, up, uv)
        measured = value(self.diffuse, wi, wo, uv)
        deviation = np.abs(model - measured).max() / measured.max()
        return (None, np.inf) if deviation > SEPARABLE else (table, deviation)

    def albedo(self, bsdf: JitArray, index: JitArray, si: JitArray, active: JitArray = True) -> JitArray:
        """ρ at surface points; 0 where the BSDF has no broad lobe.

        Parameters
        ----------
        bsdf : mitsuba.BSDFPtr
        index : mitsuba.UInt32
            The same as a number.
        si : mitsuba.SurfaceInteraction3f
            Its ``wi`` is not used.

        Returns
        -------
        mitsuba.Color3f
        """
        import drjit as dr
        import mitsuba as mi

        if not self.any:
            return mi.Color3f(0)
        kind = dr.gather(mi.Float, self._kind, index, active)
        probe = type(si)(si)
        probe.wi = mi.Vector3f(0, 0, 1)
        value = bsdf.eval(self.diffuse, probe, mi.Vector3f(0, 0, 1), active & (kind == 2))
        # Two directions at 60 degrees, at right angles in azimuth: far from any mirror direction.
        probe.wi = mi.Vector3f(0.8660254, 0, 0.5)
        far = bsdf.eval(self.full, probe, mi.Vector3f(0, 0.8660254, 0.5), active & (kind == 1))
        return dr.pi * mi.Color3f(dr.select(kind == 2, value, dr.select(kind == 1, 2 * far, 0)))

    def shape(self, index: JitArray, cosine: JitArray, active: JitArray = True) -> JitArray:
        """a(cos θ); 0 at and below the horizon."""
        import drjit as dr
        import mitsuba as mi

        x = dr.clip(cosine, 0, 1) * (N_TABLE - 1)
        low = dr.minimum(mi.UInt32(x), N_TABLE - 2)
        t, at = x - mi.Float(low), index * N_TABLE + low
        a = dr.gather(mi.Float, self._table, at, active)
        b = dr.gather(mi.Float, self._table, at + 1, active)
        return dr.select(cosine > 0, dr.lerp(a, b, t), 0)

    def value(self, index: JitArray, albedo: JitArray, wi: JitArray, wo: JitArray) -> JitArray:
        """Broad lobe times cosine of ``wo``."""
        import drjit as dr

        return albedo * (self.shape(index, wi.z) * self.shape(index, wo.z) * dr.maximum(wo.z, 0) * dr.inv_pi)

    def sample_rest(
        self,
        bsdf: JitArray,
        index: JitArray,
        albedo: JitArray,
        si: JitArray,
        lobe: JitArray,
        uv: JitArray,
        active: JitArray,
    ) -> tuple[JitArray, JitArray]:
        """Sample the rest: (BSDFSample3f, weight = rest · cosine / pdf)."""
        import drjit as dr

        sample, weight = bsdf.sample(self.drawn, si, lobe, uv, active)
        if self.any and not self.masked:
            import mitsuba as mi

            smooth = active & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & (sample.pdf > 0)
            weight = weight - dr.select(smooth, self.value(index, albedo, si.wi, sample.wo) / sample.pdf, 0)
        return sample, weight

    def eval_rest(
        self, bsdf: JitArray, index: JitArray, albedo: JitArray, si: JitArray, wo: JitArray, active: JitArray
    ) -> JitArray:
        """The rest times cosine of ``wo``."""
        return self._less_broad(bsdf.eval(self.drawn, si, wo, active), index, albedo, si, wo)

    def eval_pdf_rest(
        self, bsdf: JitArray, index: JitArray, albedo: JitArray, si: JitArray, wo: JitArray, active: JitArray
    ) -> tuple[JitArray, JitArray]:
        """`eval_rest` and `pdf_rest` for the price of little more than one."""
        value, pdf = bsdf.eval_pdf(self.drawn, si, wo, active)
        return self._less_broad(value, index, albedo, si, wo), pdf

    def _less_broad(
        self, value: JitArray, index: JitArray, albedo: JitArray, si: JitArray, wo: JitArray
    ) -> JitArray:
        return value - self.value(index, albedo, si.wi, wo) if self.any and not self.masked else value

    def pdf_rest(self, bsdf: JitArray, si: JitArray, wo: JitArray, active: JitArray) -> JitArray:
        """Density (per solid angle) of `sample_rest`."""
        return bsdf.pdf(self.drawn, si, wo, active)
