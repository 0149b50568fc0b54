"""Dr.Jit port of :mod:`btfref.representations.gbrdf.definition`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.conventions import LUMINANCE
from btfref.numerics.sphere.frames import ROTATION_FLOOR
from mitsuba_plugins.lib.heightfield import HeightField
from mitsuba_plugins.lib.microfacets import HalfVectors, Microfacets
from mitsuba_plugins.lib.parabolic import ParabolicMaps, bilinear_stencil, half_sum
from mitsuba_plugins.lib.port import Port
from mitsuba_plugins.lib.tables import as_float32

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.base import Maps
    from mitsuba_plugins.lib.heightfield import Hit


class Evaluator(Port):
    """Marches to the surface, to the light, and evaluates the microfacet materials around the hit."""

    #: What samples light directions unless told otherwise; measured by ``btfref bench proposals``.
    sampling = "both"

    #: Hits are found by a march through the heights, which has no derivative by them.
    fixed = ("cells",)

    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
        tensors = maps.tensors
        self.field = HeightField(tensors["cells"].array, self.shape, self.constants)
        self.surface, self.gloss = as_float32(tensors["surface"]), as_float32(tensors["gloss"])
        self.colour, self.ndf = as_float32(tensors["colour"]), ParabolicMaps(tensors["ndf"], 1)
        self.half_vectors = HalfVectors(dr.detach(tensors["ndf"]).numpy())

    def hit(self, uv: JitArray, w_view: JitArray, active: JitArray) -> tuple[Hit, JitArray]:
        """The point that a view ray hits, for :meth:`evaluate`, and its texture coordinates, for sampling."""
        hit = self.field.view_hit(uv, w_view, active)
        cell, local, _ = hit
        return hit, (cell + local + 0.5) / mi.Vector2f(self.shape[1], self.shape[0])

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, hit: Hit | None = None
    ) -> JitArray:
        """B in 1/sr for valid directions; never negative. A ``hit`` that is known need not be found again."""
        cell, local, height = hit or self.field.view_hit(uv, w_view, active)
        texels = self._texels(cell, local)
        tangent, bitangent, normal = self._frame(texels, active)
        cos_light = dr.dot(w_light, normal)
        active = active & (cos_light > 0)
        active &= self.field.lit(cell, local, height, w_light, active)
        h = half_sum(w_light, w_view)
        length = dr.sqrt(dr.squared_norm(h))
        # Tables are looked up with any length: a normalisation less is a rounding less near the horizon.
        facet = mi.Vector3f(dr.dot(h, tangent), dr.dot(h, bitangent), dr.dot(h, normal))
        light, view = dr.maximum(cos_light, 0), dr.maximum(dr.dot(w_view, normal), 0)
        factor = light / dr.maximum(dr.fma(view, 1 - light, light), 1e-30)
        factor = dr.select(facet.z > 0, factor, 0)
        grazing = 1 - dr.clip(dr.dot(w_light, h) / dr.maximum(length, 1e-30), 0, 1)
        fifth = dr.square(dr.square(grazing)) * grazing
        stencil = bilinear_stencil(facet, self.ndf.n)
        diffuse, gloss = mi.Color3f(0), mi.Color3f(0)
        for texel, weight in texels:
            # Not fetched without weight: a texel whose material is not kept holds no numbers.
            here = active & (weight > 0)
            red, green, blue, r0 = dr.gather(mi.Vector4f, self.colour, texel, here)
            material, amount, _, _ = dr.gather(mi.Vector4f, self.gloss, texel, here)
            diffuse += weight * mi.Color3f(red, green, blue)
            share = weight * amount * dr.fma(1 - r0, fifth, r0)
            gloss += share * self.ndf.lookup(_index(material), stencil, active)
        value = dr.fma(diffuse, light * dr.inv_pi, gloss * factor)
        return dr.select(active, value, 0)

    def proposal(
        self, uv: JitArray, w_view: JitArray, active: JitArray, hit: Hit | None = None
    ) -> Microfacets:
        """Half vectors of the nearest texel's material, and its diffuse part, in the frame of the hit."""
        cell, local, _ = hit or self.field.view_hit(uv, w_view, active)
        texels = self._texels(cell, local)
        frame = self._frame(texels, active)
        nearest, most = texels[0]
        for texel, weight in texels[1:]:
            nearest, most = dr.select(weight > most, texel, nearest), dr.maximum(weight, most)
        red, green, blue, r0 = dr.detach(dr.gather(mi.Vector4f, self.colour, nearest, active))
        material, amount, _, _ = dr.detach(dr.gather(mi.Vector4f, self.gloss, nearest, active))
        material = _index(material)
        # Albedos: of the gloss as if all half vectors were the normal, ∫ 4 p F g (k·h) dω_h.
        cosine = dr.clip(dr.dot(w_view, frame[2]), 0.05, 1)
        fresnel = dr.fma(1 - r0, (1 - cosine) ** 5, r0)
        total = dr.gather(mi.Float, self.half_vectors.total, material, active)
        gloss = amount * fresnel * total * 4 * cosine / (2 - cosine)
        diffuse = dr.dot(mi.Color3f(red, green, blue), mi.Color3f(*LUMINANCE.tolist()))
        share = gloss / dr.maximum(gloss + diffuse, 1e-20)
        return Microfacets(self.half_vectors, material, dr.detach(frame), w_view, share)

    def _texels(self, cell: JitArray, local: JitArray) -> list[tuple[JitArray, JitArray]]:
        """Texels that a point blends and their weights, as `btfref.representations.gbrdf.definition.texel_weights`."""
        rows, columns = self.shape
        c0, r0 = mi.UInt32(cell.x), mi.UInt32(cell.y)
        c1, r1 = c0 + 1, r0 + 1
        c1, r1 = dr.select(c1 == columns, 0, c1), dr.select(r1 == rows, 0, r1)
        a, b = local.x, local.y
        if self.filter_type == "nearest":
            return [(dr.select(b < 0.5, r0, r1) * columns + dr.select(a < 0.5, c0, c1), mi.Float(1))]
        return [
            (r0 * columns + c0, (1 - a) * (1 - b)),
            (r0 * columns + c1, a * (1 - b)),
            (r1 * columns + c0, (1 - a) * b),
            (r1 * columns + c1, a * b),
        ]

    def _frame(
        self, texels: list[tuple[JitArray, JitArray]], active: JitArray
    ) -> tuple[JitArray, JitArray, JitArray]:
        """Tangent, bitangent and normal, as `btfref.numerics.sphere.frames.surface_frame`."""
        total = mi.Vector4f(0)
        for texel, weight in texels:
            total = dr.fma(dr.gather(mi.Vector4f, self.surface, texel, active), weight, total)
        sx, sy, c, s = total
        normal = _unit(mi.Vector3f(-sx, -sy, 1))
        u = _unit(mi.Vector3f(dr.fma(sy, sy, 1), -sx * sy, sx))
        v = dr.cross(normal, u)
        length = dr.sqrt(dr.fma(c, c, s * s))
        there = length > ROTATION_FLOOR
        scale = 1 / dr.select(there, length, 1)
        c, s = dr.select(there, c * scale, 1), dr.select(there, s * scale, 0)
        return c * u + s * v, c * v - s * u, normal


def _index(material: JitArray) -> JitArray:
    """Index of a material, which stands among floats: the nearest whole number, so that a small step changes none."""
    return mi.UInt32(material + 0.5)


def _unit(v: JitArray) -> JitArray:
    """``v`` over its length by a square root and a division; ``dr.normalize`` takes an approximate reciprocal root."""
    return v / dr.sqrt(dr.squared_norm(v))
