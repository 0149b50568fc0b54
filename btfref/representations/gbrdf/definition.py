"""g-BRDF: a height field with a few microfacet materials, the one representation whose maps are made for editing.

Source: N. Menzel, M. Guthe, "g-BRDFs: An Intuitive and Editable BTF Representation", Computer Graphics Forum 28(8),
2009, sections 3 and 4. A view ray finds its point on the height field, a second march towards the light shadows it, and
the point reflects by the distribution-based BRDF of :mod:`btfref.numerics.microfacets` in its tangent frame:
``B = c_d/π (k1·n) + c_s p(h) F(k1·h) g``.

Differs from the paper: hits are exact roots in bilinear patches instead of a linear search
(:mod:`btfref.numerics.heightfield`); distributions are RGB; c_s is held below ``(1 − max c_d) / A(r0)`` with A the
largest albedo of the distribution, because one of integral 1 may reflect up to four times the light.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref import conventions
from btfref.numerics.heightfield import HEIGHT_LIMIT, LIFT, HeightField
from btfref.numerics.microfacets import geometry_factor, schlick, specular_albedo_bound
from btfref.numerics.sphere.frames import surface_frame
from btfref.numerics.sphere.halfway import half_vector
from btfref.numerics.sphere.parabolic import bilinear_stencil
from btfref.precision import computing_in, real
from btfref.representations.file.resident import refuse_absent
from btfref.representations.file.schema import (
    FLOATS,
    INDICES,
    LARGEST,
    Constant,
    MapSchema,
    Range,
    Schema,
)
from btfref.representations.guide import group_means, spread_members, texel_groups
from btfref.representations.lookup import StoredMaps, evaluate_points
from btfref.representations.protocol import Entries

if TYPE_CHECKING:
    from collections.abc import Collection
    from typing import Self

    from numpy.typing import ArrayLike

    from btfref.numerics.heightfield import Hit
    from btfref.types import Facts


#: Tiles by which a port's hit may differ from the definition's: float32 positions at the far end of the longest ray.
HIT_TOLERANCE = 2e-6

#: Directions in which a hit is moved to find its neighbourhood.
_MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))

#: Members of a group of texels whose mean guides importance sampling.
GUIDE_MEMBERS = 2

#: Values of r0 at which the bound of a distribution's albedo is tabulated.
_FRESNEL_NODES = 17

#: Texels that are told apart for sampling at a time.
_BLOCK = 4096


class Representation(StoredMaps):
    """Maps of a g-BRDF, all over [row, column].

    ``height`` [r, c, 1] in [0, 1] between the constants ``height_min`` and ``height_max`` (tile units); ``rotation``
    [r, c, 1] of the tangent in turns; ``diffuse`` [r, c, 3] c_d; ``fresnel`` [r, c, 1] r0; ``material`` [r, c, 1]
    uint32; ``ndf`` [material, n, n, 3] parabolic tables of p; ``specular`` [material, 1] c_s; and direction tables,
    which only guide sampling.
    """

    ENTRIES: ClassVar = Entries("material", {"ndf": 0, "specular": 0}, "fresnel")

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""

        def unit(axes: str, *, absent: bool = False) -> MapSchema:
            return MapSchema(axes, FLOATS, least=0, most=1, absent=absent)

        maps = {
            "height": unit("rows columns 1"),
            "rotation": unit("rows columns 1"),
            "diffuse": unit("rows columns 3"),
            "fresnel": unit("rows columns 1", absent=True),
            "material": MapSchema("rows columns 1", INDICES, below=("ndf",)),
            "ndf": MapSchema("materials side side 3", FLOATS, least=0),
            "specular": unit("materials 1"),
        }
        low = meta["constants"].get("height_min")
        low = low if isinstance(low, float | int) and -HEIGHT_LIMIT <= low <= HEIGHT_LIMIT else -HEIGHT_LIMIT
        constants: dict[str, Constant] = {
            "height_min": Range(-HEIGHT_LIMIT, HEIGHT_LIMIT),
            "height_max": Range(low, HEIGHT_LIMIT),
        }
        # Whatever they are, they are made anew of the heights: :meth:`from_arrays`.
        derived = ("top", "bottom", "tangent_limit", "lift", "maximum_steps")
        return Schema(maps, constants | dict.fromkeys(derived, Range(-LARGEST, LARGEST)), optional=derived)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], meta: Facts) -> Self:
        """The representation whose :meth:`arrays` and ``meta`` these are; derived constants are made anew."""
        return cls(arrays, meta | {"constants": field_constants(arrays, meta["constants"])})

    @cached_property
    def field(self) -> HeightField:
        """The height field."""
        return height_field(self.maps["height"], self.meta["constants"])

    @cached_property
    def specular_scale(self) -> np.ndarray:
        """c_s of each texel after the limit of energy, float32 (rows, columns).

        ``min(c_s, (1 − max_c c_d) / A(r0))``: the albedo is at most 1 for whatever maps.
        """
        material = self.maps["material"][..., 0]
        own = self.maps["specular"].astype(float)[:, 0][material]
        # The bound is convex in r0, so that lines between its values at nodes lie above it.
        nodes = np.linspace(0, 1, _FRESNEL_NODES)
        table = specular_albedo_bound(self.maps["ndf"], nodes)
        # Not a number where the material is not kept.
        place = np.nan_to_num(self.maps["fresnel"][..., 0].astype(float)) * (_FRESNEL_NODES - 1)
        low = np.minimum(place.astype(int), _FRESNEL_NODES - 2)
        t = place - low
        bound = (1 - t) * table[material, low] + t * table[material, low + 1]
        room = np.maximum(1 - self.maps["diffuse"].astype(float).max(-1), 0)
        # A step below: rounding to float32 must not exceed the limit.
        limited = np.minimum(own * bound, room) / np.where(bound > 0, bound, 1) * (1 - 2**-23)
        return np.where(bound > 0, limited, 0).astype(np.float32)

    @cached_property
    def port_tables(self) -> dict[str, np.ndarray]:
        """What the ports and the definition read, by texel; see :meth:`port_arrays`."""
        # Made once for all ports, in whatever precision a lookup computes.
        with computing_in(np.float64):
            scale = self.specular_scale
        turn = 2 * np.pi * self.maps["rotation"].astype(float)
        surface = np.concatenate([self.field.slopes, np.cos(turn), np.sin(turn)], -1)
        gloss = np.stack([self.maps["material"][..., 0].astype(np.float32), scale], -1)
        return {
            "cells": self.field.cells,
            "surface": surface.astype(np.float32),
            "colour": np.concatenate([self.maps["diffuse"], self.maps["fresnel"]], -1),
            "gloss": np.pad(gloss, [(0, 0), (0, 0), (0, 2)]),
        }

    def port_arrays(self) -> dict[str, np.ndarray]:
        """``cells`` corner heights; ``surface`` slopes, cosine and sine of the rotation; ``colour`` c_d and r0;
        ``gloss`` material and limited c_s; ``ndf``; and the direction tables.
        """  # noqa: D205
        from btfref.representations.lookup import packed_arrays

        kept = {"ndf", *(name for name in self.maps if name.startswith(("view_", "light_")))}
        return self.port_tables | packed_arrays({name: self.maps[name] for name in kept})

    def seen_texels(self, uv: ArrayLike, w_view: ArrayLike) -> np.ndarray:
        """Texels that lookups blend, where view rays meet the surface: flat indices, shape (N, 2), (N, 3) -> (N, T)."""
        hit = self.field.view_hits(np.asarray(uv, float), np.asarray(w_view, float))
        return texel_weights(hit, self.field.shape, self.meta["filter_type"])[0]

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.Representation.evaluate`; ``lod`` is ignored. Never negative."""

        def lookup(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
            hit = self.field.view_hits(uv, w_view)
            return self.shade(hit, w_light, w_view)

        return evaluate_points(lookup, uv, w_light, w_view)

    def spread(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, tolerance: float = HIT_TOLERANCE
    ) -> np.ndarray:
        """How much the definition changes when the hit moves by a tolerance: silhouettes and borders of shadows.

        Parameters
        ----------
        uv, w_light, w_view : array_like
            As for :meth:`evaluate`.
        tolerance : float
            Tiles by which ``uv`` moves along both axes and diagonals, and share by which the tangents of light and view
            change: together the rounding of a float32 march.

        Returns
        -------
        ndarray, shape (..., 3)
            Largest change of B in 1/sr.
        """
        uv, w_light, w_view = (np.asarray(a, float) for a in (uv, w_light, w_view))
        uv = np.where(np.isfinite(uv), uv, 0.0)
        here = self.evaluate(uv, w_light, w_view)
        largest = np.zeros_like(here)
        steps = [tolerance * np.array(s) for s in _MOVES]
        steeper, flatter = (np.array([1, 1, 1 + s * tolerance]) for s in (1, -1))
        cases = [(uv + step, w_light, w_view) for step in steps]
        cases += [(uv, w_light * scale, w_view) for scale in (steeper, flatter)]
        cases += [(uv, w_light, w_view * scale) for scale in (steeper, flatter)]
        for case in cases:
            largest = np.maximum(largest, np.abs(self.evaluate(*case) - here))
        return largest

    def shade(
        self, hit: Hit, w_light: np.ndarray, w_view: np.ndarray, *, lit: np.ndarray | None = None
    ) -> np.ndarray:
        """B of points on the surface.

        Parameters
        ----------
        hit : btfref.numerics.heightfield.Hit
        w_light, w_view : ndarray, shape (N, 3)
            Valid directions.
        lit : ndarray of bool, shape (N,), optional
            Which points see the light; default: found by the march towards it.

        Returns
        -------
        ndarray of float64, shape (N, 3)
        """
        index, weight = texel_weights(hit, self.field.shape, self.meta["filter_type"])
        flat = {name: table.reshape(-1, table.shape[-1]) for name, table in self.port_tables.items()}
        surface = np.einsum("nt,ntk->nk", weight, real(flat["surface"][index]))
        tangent, bitangent, normal = surface_frame(surface)
        cos_light = (w_light * normal).sum(-1)
        value = np.zeros((len(index), 3), weight.dtype)
        if lit is None:
            lit = cos_light > 0
            lit[lit] = self.field.lit(hit[lit], w_light[lit])
        else:
            lit = lit & (cos_light > 0)
        if not lit.any():
            return value
        index, weight, cos_light = index[lit], weight[lit], cos_light[lit]
        colour = real(flat["colour"][index])
        if self.meta.get("partial", False):
            colour = refuse_absent(colour, weight, "entries")
        diffuse = np.einsum("nt,ntc->nc", weight, colour[..., :3]) * (cos_light / np.pi)[:, None]
        h = half_vector(w_light[lit], w_view[lit])
        local = np.stack([(h * axis[lit]).sum(-1) for axis in (tangent, bitangent, normal)], -1)
        factor = geometry_factor(cos_light, (w_view[lit] * normal[lit]).sum(-1))
        # Microfacets behind the surface reflect nothing.
        factor = np.where(local[:, 2] > 0, factor, 0)
        fresnel = schlick((w_light[lit] * h).sum(-1)[:, None], colour[..., 3])
        share = weight * real(flat["gloss"][index, 1]) * fresnel
        material = flat["gloss"][index, 0].astype(np.int64)
        cell, cell_weight = bilinear_stencil(local, self.maps["ndf"].shape[1])
        table = self.maps["ndf"].reshape(len(self.maps["ndf"]), -1, 3)
        p = np.einsum("nk,ntkc->ntc", cell_weight, real(table[material[:, :, None], cell[:, None]]))
        value[lit] = diffuse + factor[:, None] * np.einsum("nt,ntc->nc", share, p)
        return value

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of points of the surface alike (by B from above), and means over a few members of each.

        The plugin looks the group up where the view ray hits.
        """
        if self.meta.get("partial", False):
            # What is not there guides as if it had no gloss at the normal.
            there = self.maps | {"fresnel": np.nan_to_num(self.maps["fresnel"])}
            return type(self)(there, self.meta | {"partial": False}).sampling_tables()
        rows, columns = self.field.shape
        views, lights = (self.maps[f"{kind}_directions"].astype(float) for kind in ("view", "light"))
        some = lights[np.unique(np.linspace(0, len(lights) - 1, min(24, len(lights))).round().astype(int))]
        features = [
            self._luminance(
                np.arange(first, min(first + _BLOCK, rows * columns)), some, np.array([[0, 0, 1.0]])
            )
            for first in range(0, rows * columns, _BLOCK)
        ]
        labels = texel_groups(np.concatenate(features)[:, 0])
        members = spread_members(labels, GUIDE_MEMBERS)
        means = group_means(labels[members], self._luminance(members, lights, views).astype(np.float32))
        return labels.reshape(rows, columns), means

    def _luminance(self, texels: np.ndarray, lights: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Luminance of B at texel centres on the surface, shape (n, n_views, n_lights)."""
        n, n_lights = len(texels), len(lights)
        pairs = np.repeat(np.arange(n), n_lights)
        w_light = np.tile(lights, (n, 1))
        hit = self.field.points(texel_uv(texels, *self.field.shape)[pairs])
        lit = np.zeros(len(pairs), bool)
        # Directions on the horizon are none that B is asked for.
        valid = conventions.valid_directions(w_light)
        lit[valid] = self.field.lit(hit[valid], w_light[valid])
        seen, w_light = np.flatnonzero(lit), w_light[lit]
        hit = hit[seen]
        result = np.zeros((n * n_lights, len(views)))
        for column, view in enumerate(views):
            w_view = np.broadcast_to(view, w_light.shape)
            value = self.shade(hit, w_light, w_view, lit=np.ones(len(seen), bool))
            result[seen, column] = conventions.luminance(value)
        return result.reshape(n, n_lights, -1).swapaxes(1, 2)


def height_field(height: np.ndarray, constants: Facts) -> HeightField:
    """The field of a map of heights in [0, 1], rounded to float32 as the ports have it."""
    low, high = constants["height_min"], constants["height_max"]
    heights = low + (high - low) * np.asarray(height, float)[..., 0]
    return HeightField(heights.astype(np.float32))


def field_constants(arrays: dict[str, np.ndarray], constants: Facts) -> Facts:
    """Constants of the ports, from the maps and ``height_min`` and ``height_max``; the others are kept."""
    field = height_field(arrays["height"], constants)
    return constants | {
        "top": field.top,
        "bottom": field.bottom,
        "tangent_limit": float(np.float32(field.tangent_limit)),
        "lift": LIFT * field.depth,
        "maximum_steps": field.maximum_steps,
    }


def texel_uv(index: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Texture coordinates of texel centres, shape (N,) -> (N, 2)."""
    return np.stack([(index % columns + 0.5) / columns, (index // columns + 0.5) / rows], -1)


def texel_weights(hit: Hit, shape: tuple[int, ...], filter_type: str) -> tuple[np.ndarray, np.ndarray]:
    """Texels that a point blends, as flat indices (N, T), and their weights; see `conventions.texel_stencil`."""
    rows, columns = shape
    c0, r0 = hit.cell.T
    c1, r1 = (c0 + 1) % columns, (r0 + 1) % rows
    a, b = hit.local.T
    if filter_type == "nearest":
        column, row = np.where(a < 0.5, c0, c1), np.where(b < 0.5, r0, r1)
        return (row * columns + column)[:, None], np.ones((len(a), 1), a.dtype)
    index = np.stack([r0 * columns + c0, r0 * columns + c1, r1 * columns + c0, r1 * columns + c1], -1)
    return index, np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], -1)
