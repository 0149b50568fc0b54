"""Light directions by half vectors drawn from tables of normal distributions, plus diffuse reflection."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.conventions import LUMINANCE
from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere.parabolic import texel_centres, texel_solid_angles
from mitsuba_plugins.lib.guide import alias_tables, drawn
from mitsuba_plugins.lib.proposals import COSINE_SHARE, folded

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.types import JitArray


#: Cosine between view and half vector down to which light is the view's reflection: its density, p(h) / (4 k·h), is
#: singular at 0. Below it, ever more half vectors are directions of light themselves.
LEAST_COSINE = 0.1


class HalfVectors:
    """Tables to draw half vectors from, one a material.

    Parameters
    ----------
    ndf : ndarray, shape (m, n, n, channels)
        Parabolic tables of p, as ports have them: three channels count.
    """

    def __init__(self, ndf: ArrayLike) -> None:
        p = np.maximum(np.asarray(ndf, float)[..., :3], 0) @ LUMINANCE
        self.n = p.shape[-1]
        # A texel is as probable as the mean of what is interpolated in it. Those that the rim cuts are left to the
        # cosine: half vectors along the surface.
        for axis in (1, 2):
            edge = np.pad(p, [(0, 0)] + [(1, 1) if k == axis else (0, 0) for k in (1, 2)], mode="edge")
            low, high = (np.take(edge, np.arange(self.n) + k, axis) for k in (0, 2))
            p = 0.75 * p + 0.125 * (low + high)
        corner = np.abs(texel_centres(self.n)) + 1 / self.n
        inside = (corner * corner).sum(-1) < 1
        weight = (p * texel_solid_angles(self.n) * inside).reshape(len(p), -1)
        total = weight.sum(1)
        share = (
            np.where(total[:, None] > 0, weight, inside.ravel())
            / np.where(total > 0, total, inside.sum())[:, None]
        )
        self.bits = max((self.n * self.n - 1).bit_length(), 1)
        self.alias = to_device(mi.UInt32, alias_tables(share, self.bits))
        self.share, self.total = to_device(mi.Float, share), to_device(mi.Float, total)
        dr.eval(self.alias, self.share, self.total)

    def sample(self, material: JitArray, sample: JitArray) -> JitArray:
        """A half vector in its tangent frame."""
        count = self.n * self.n
        cell, x = drawn(self.alias, material * count, count, self.bits, sample.x)
        place = mi.Vector2f(mi.Float(cell % self.n) + x, mi.Float(cell // self.n) + sample.y)
        st = place * (2 / self.n) - 1
        r2 = dr.squared_norm(st)
        return mi.Vector3f(2 * st.x, 2 * st.y, 1 - r2) / (1 + r2)

    def pdf(self, material: JitArray, h: JitArray, active: JitArray) -> JitArray:
        """Density of unit half vectors with respect to their solid angle; 0 on the lower side."""
        active = active & (h.z > 0)
        scale = 1 / (1 + dr.maximum(h.z, 0))
        place = (mi.Vector2f(h.x, h.y) * scale + 1) * (0.5 * self.n)
        cell = mi.Vector2u(dr.clip(place, 0, self.n - 1))
        share = dr.gather(mi.Float, self.share, (material * self.n + cell.y) * self.n + cell.x, active)
        # dω = 4 / (1 + s² + t²)² ds dt, and 1 + s² + t² = 2 / (1 + h_z).
        return share * (0.25 * self.n * self.n) * dr.square(scale)


class Microfacets:
    """Reflection at half vectors, and a cosine about the shading normal.

    Parameters
    ----------
    tables : HalfVectors
    material : UInt32
    frame : tuple of Vector3f
        Tangent, bitangent, normal at the point.
    w_view : Vector3f
    gloss : Float
        Share of the half vectors, before the least share of the cosine.
    """

    def __init__(
        self,
        tables: HalfVectors,
        material: JitArray,
        frame: tuple[JitArray, JitArray, JitArray],
        w_view: JitArray,
        gloss: JitArray,
    ) -> None:
        self._tables, self._material, self._frame, self._view = tables, material, frame, w_view
        self._gloss = dr.clip(gloss, 0, 1 - COSINE_SHARE)

    def pdf(self, w_light: JitArray, active: JitArray) -> JitArray:
        """Density in 1/sr."""
        active = active & (w_light.z > 0)
        mirrored = mi.Vector3f(w_light.x, w_light.y, -w_light.z)
        return dr.select(active, self._whole(w_light, active) + self._whole(mirrored, active), 0)

    def _whole(self, w: JitArray, active: JitArray) -> JitArray:
        """Density over the whole sphere."""
        h = w + self._view
        length = dr.norm(h)
        cosine = 0.5 * length
        # A half vector and its opposite reflect alike: the one above the surface is drawn.
        facet = self._local(h / dr.maximum(length, 1e-20))
        facet = dr.select(facet.z < 0, -facet, facet)
        glossy = self._density(facet, active) / (4 * dr.maximum(cosine, LEAST_COSINE))
        stays = 1 - _reflected_share(dr.dot(w, self._view))
        glossy += self._density(self._local(w), active & (stays > 0)) * stays
        diffuse = dr.maximum(dr.dot(w, self._frame[2]), 0) * dr.inv_pi
        return dr.lerp(diffuse, glossy, self._gloss)

    def _local(self, w: JitArray) -> JitArray:
        return mi.Vector3f(*(dr.dot(w, axis) for axis in self._frame))

    def _density(self, facet: JitArray, active: JitArray) -> JitArray:
        return self._tables.pdf(self._material, facet, active)

    def sample(self, sample1: JitArray, sample2: JitArray) -> JitArray:
        """A direction of that density."""
        facet = self._tables.sample(self._material, sample2)
        tangent, bitangent, normal = self._frame
        h = facet.x * tangent + facet.y * bitangent + facet.z * normal
        cosine = dr.dot(h, self._view)
        reflected = 2 * cosine * h - self._view
        rest = sample1 / dr.maximum(self._gloss, 1e-20)
        glossy = dr.select(rest < _reflected_share(cosine), reflected, h)
        local = mi.warp.square_to_cosine_hemisphere(sample2)
        diffuse = local.x * tangent + local.y * bitangent + local.z * normal
        return dr.normalize(folded(dr.select(sample1 < self._gloss, glossy, diffuse)))


def _reflected_share(cosine: JitArray) -> JitArray:
    """Share of the half vectors at a cosine to the view at which it is reflected."""
    return dr.minimum(dr.abs(cosine) * (1 / LEAST_COSINE), 1)
