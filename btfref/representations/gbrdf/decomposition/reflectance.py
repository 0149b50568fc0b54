"""Reflectance of each texel by alternating least squares, once heights and normals are known.

Source: Menzel and Guthe 2009, eq. 9 to 20. Every residual is weighted by 1/L, so that it is the logarithmic error; L is
held above a share of the mean, so that weights stay finite in float32. Push–pull after S. Gortler et al., "The
Lumigraph", SIGGRAPH 1996.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.numerics.microfacets import fifth_power, geometry_factor
from btfref.numerics.sphere.frames import surface_frame
from btfref.numerics.sphere.parabolic import texel_solid_angles
from btfref.representations.gbrdf.decomposition.normals import visible
from btfref.representations.gbrdf.decomposition.pairs import mean_luminance, surface_stencil, tangent
from btfref.sampling.blocks import StreamedBTF
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.numerics.heightfield import HeightField
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress


#: Texels a block: bounds the memory of their tables.
BLOCK = 128

#: Texels of a store that are looked up together at least: each such group is a pass over the views.
GROUP = 8 * BLOCK

#: What looking a view up takes for each of them, in tables of a view.
PER_VIEW = 4

#: Cosines to the local normal below which a sample is left out: there the height map decides, not the material.
GRAZING = 0.1

#: Share of a texel's mean luminance at which the weight 1 / L ends: borders of shadows that the heights miss by a texel
#: are dark samples of lit points, and would count hundreds of times. Chosen on BTFs of random height maps with coloured
#: textures, which no other figure is of: RMS ΔE00 4.2, 3.8, 3.4, 3.4, 3.4, 3.5 and 2.9, 2.0, 1.9, 1.9, 1.9, 1.9 for
#: shares of 0.03, 0.1, 0.2, 0.3, 0.5, 1, least at 0.3 for both (0.12 and 0.05 tiles deep, GGX 0.35 and 0.2).
FLOOR = 0.3

#: r0 to start from: a refractive index of 1.5.
FIRST_FRESNEL = 0.04

#: Texels per side of the table of a single texel's distribution.
TEXEL_NDF = 16


@dataclass(frozen=True)
class BlockSamples:
    """What the surface points of a block of N texels show; P pairs (view, light), view slowest.

    Everything is multiplied by the weight: 1 / L where seen, lit and not grazing, else 0.

    Attributes
    ----------
    values : ndarray of float32, shape (channels, P, N)
        B in 1/sr.
    light : ndarray of float32, shape (P, N)
        k1·n / π.
    factor : ndarray of float32, shape (P, N)
        k1·n over the denominator of the BRDF.
    place : ndarray of intp, shape (P, N)
        Flat index of the half vector's texel in the table [group, row, column] of distributions.
    fifth : ndarray of float32, shape (P, 1)
        (1 − k1·h)^5, without the weight.
    """

    values: np.ndarray
    light: np.ndarray
    factor: np.ndarray
    place: np.ndarray
    fifth: np.ndarray

    def fresnel(self, r0: np.ndarray) -> np.ndarray:
        """F(k1·h), shape (N,) -> (P, N)."""
        return self.fifth + r0 * (1 - self.fifth)


class SurfaceSamples:
    """What is known of the points of a height field before a BTF is looked up there: :meth:`each` does that.

    Parameters
    ----------
    btf : BTFBlocks
        Its directions, and its mean.
    field : btfref.numerics.heightfield.HeightField
    rotation : ndarray, shape (rows, columns), optional
        Of the tangents, in turns.
    stride : int
        Every so many views only.
    mean : float, optional
        ``mean_luminance(btf, 4)``, where it is known.
    """

    def __init__(
        self,
        btf: BTFBlocks,
        field: HeightField,
        rotation: np.ndarray | None = None,
        stride: int = 1,
        mean: float | None = None,
    ) -> None:
        self._views = np.flatnonzero(btf.views.vectors[:, 2] > 1e-6)[::stride]
        views, lights = btf.views.vectors[self._views], btf.lights.vectors
        self._tangents = tangent(views)
        self._directions = views.astype(np.float32), lights.astype(np.float32)
        self.n_texels = int(np.prod(field.shape))
        self._seen, self._lit = visible(field, views), visible(field, lights)
        self._heights = field.heights.astype(float)
        turn = np.zeros(field.shape) if rotation is None else 2 * np.pi * rotation
        surface = np.concatenate([field.slopes, np.cos(turn)[..., None], np.sin(turn)[..., None]], -1)
        self._frame = np.stack(surface_frame(surface.reshape(-1, 4)), 1).astype(np.float32)
        half = views[:, None] + lights[None]
        half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
        self._half = half.reshape(-1, 3).astype(np.float32)
        self._fifth = fifth_power((half * lights).sum(-1)).reshape(-1, 1).astype(np.float32)
        # A little above 0 for a black one.
        self._black = 0.02 * ((mean_luminance(btf, 4) if mean is None else mean) + 1e-9)

    def groups(self, together: int) -> list[slice]:
        """Texels that are looked up together, as slices of the flat index; whole blocks."""
        size = -(-together // BLOCK) * BLOCK
        return [slice(i, min(i + size, self.n_texels)) for i in range(0, self.n_texels, size)]

    def each(
        self,
        btf: BTFBlocks,
        group: slice,
        size: int,
        labels: np.ndarray | None = None,
        colour: bool = True,
    ) -> Iterator[tuple[slice, BlockSamples]]:
        """BlockSamples of the texels of a group, block by block; one pass over the views.

        Parameters
        ----------
        btf : BTFBlocks
        group : slice
            Of the flat index, one of :meth:`groups`.
        size : int
            Texels per side of the distributions.
        labels : ndarray of int, shape (n_texels,), optional
            Which distribution each texel uses; default: its own.
        colour : bool
            Three channels, or luminance alone.

        Yields
        ------
        part : slice
            Of the flat index.
        samples : BlockSamples
        """
        tables = self._tables(btf, group)
        for first in range(group.start, group.stop, BLOCK):
            part = slice(first, min(first + BLOCK, group.stop))
            found = np.ascontiguousarray(tables[..., first - group.start : part.stop - group.start])
            yield part, self._samples(found, part, size, None if labels is None else labels[part], colour)

    def _tables(self, btf: BTFBlocks, group: slice) -> np.ndarray:
        """B of the points of some texels, float32 (channels, views, lights, n)."""
        n_lights = len(self._directions[1])
        tables = np.zeros((3, len(self._views), n_lights, group.stop - group.start), np.float32)
        for row, (view, at) in enumerate(zip(self._views, self._tangents, strict=True)):
            index, share = surface_stencil(self._heights, at, group)
            images = btf.view(int(view)).reshape(n_lights, -1, 3)
            seen = sum(
                images[:, index[:, k]].astype(np.float32) * share[:, k, None] for k in range(index.shape[1])
            )
            tables[:, row] = np.moveaxis(seen, -1, 0)
        return tables

    def _samples(
        self, tables: np.ndarray, part: slice, size: int, group: np.ndarray | None, colour: bool
    ) -> BlockSamples:
        """BlockSamples of a block, from its tables."""
        views, lights = self._directions
        frame = self._frame[part]
        n, n_views, n_lights = len(frame), len(views), len(lights)
        values = tables.reshape(3, -1, n)
        luminance = np.tensordot(LUMINANCE.astype(np.float32), values, 1)
        cos_view, cos_light = views @ frame[:, 2].T, lights @ frame[:, 2].T
        there = (self._seen[part].T & (cos_view > GRAZING))[:, None]
        there = there & (self._lit[part].T & (cos_light > GRAZING))[None]
        x, y, z = (self._half @ frame[:, k].T for k in range(3))
        there = there.reshape(-1, n) & (z > 0)
        mean = np.einsum("pn,pn->n", luminance, there) / np.maximum(there.sum(0), 1)
        weight = there / np.maximum(luminance, np.maximum(np.float32(FLOOR) * mean, np.float32(self._black)))
        scale = np.float32(0.5 * size) / (1 + np.maximum(z, 0))
        column, row = (
            np.clip(w * scale + np.float32(0.5 * size), 0, size - 1).astype(np.intp) for w in (x, y)
        )
        group = np.arange(n) if group is None else group
        factor = geometry_factor(cos_light[None], cos_view[:, None]).astype(np.float32).reshape(-1, n)
        light = np.broadcast_to(cos_light[None], (n_views, n_lights, n)).reshape(-1, n)
        return BlockSamples(
            (values if colour else luminance[None]) * weight,
            light * weight * np.float32(1 / np.pi),
            factor * weight,
            (group * size + row) * size + column,
            self._fifth,
        )


def texels_together(btf: BTFBlocks) -> int:
    """Texels that are looked up together in each pass over the views; without influence on any result.

    To be asked before any view is read. In memory a block is enough; of a store as many as there is room for, unless
    all views may be kept.

    Parameters
    ----------
    btf : BTFBlocks

    Returns
    -------
    int
    """
    if not isinstance(btf, StreamedBTF):
        return BLOCK
    together, texels = GROUP, btf.texels[0] * btf.texels[1]
    step = 12 * GROUP * len(btf.lights) * (len(btf.views) + PER_VIEW)
    if not btf.keeps_all:
        while together < texels and btf.claim(step):
            together += GROUP
    return together


def diffuse_colour(channel: np.ndarray, samples: BlockSamples, gloss: np.ndarray) -> np.ndarray:
    """c_d by eq. 9 to 11, shape (N,) in [0, 1].

    Parameters
    ----------
    channel : ndarray, shape (P, N)
        One channel of ``samples.values``.
    samples : BlockSamples
    gloss : ndarray, shape (P, N)
        Weighted c_s p F k1·n / D.
    """
    return np.clip(_projection(channel - gloss, samples.light), 0, 1)


def distribution(
    rest: np.ndarray, amount: np.ndarray, samples: BlockSamples, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each texel of the distributions, for p by eq. 12 to 14.

    Parameters
    ----------
    rest : ndarray, shape (P, N)
        Weighted δ_p: what the diffuse part leaves.
    amount : ndarray, shape (P, N)
        Weighted λ_p = c_s F k1·n / D.
    samples : BlockSamples
    size : int
        Texels of all tables.

    Returns
    -------
    numerator, denominator : ndarray, shape (size,)
    """
    place = samples.place.ravel()
    numerator, denominator = (np.bincount(place, (amount * a).ravel(), size) for a in (rest, amount))
    return numerator, denominator


def specular_amount(rest: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """c_s by eq. 15 to 17, shape (N,), not yet limited; ``shape`` is the weighted p F k1·n / D."""
    return _projection(rest, shape)


def normal_reflectance(rest: np.ndarray, shape: np.ndarray, samples: BlockSamples) -> np.ndarray:
    """r0 by eq. 18 to 20, shape (N,) in [0, 1]; ``shape`` is the weighted c_s p k1·n / D."""
    return np.clip(_projection(rest - shape * samples.fifth, shape * (1 - samples.fifth)), 0, 1)


def _projection(values: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Least squares factor of ``basis`` for each texel."""
    return _quotient(np.einsum("pn,pn->n", values, basis), np.einsum("pn,pn->n", basis, basis))


def _quotient(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    there = b > 1e-20
    return np.where(there, a / np.where(there, b, 1), 0).astype(a.dtype)


def limited_distribution(p: np.ndarray) -> np.ndarray:
    """A table of p that conserves energy, shape (..., n, n): at most 1 / solid angle, integral at most 1."""
    solid_angle = texel_solid_angles(p.shape[-1])
    floor = solid_angle.max() * 1e-3
    p = np.clip(p, 0, 1 / np.maximum(solid_angle, floor))
    return p / np.maximum((p * solid_angle).sum((-2, -1), keepdims=True), 1)


def push_pull(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Tables with holes, filled from coarser levels.

    Parameters
    ----------
    values, weight : ndarray, shape (..., n, n)
        n a power of two; weight 0 is a hole, 1 and more is certain.

    Returns
    -------
    ndarray, shape (..., n, n)
    """
    weight = np.minimum(weight, 1.0)
    n = values.shape[-1]
    if n == 1:
        return values
    blocks = (*values.shape[:-2], n // 2, 2, n // 2, 2)
    total = weight.reshape(blocks).sum((-3, -1))
    mean = (values * weight).reshape(blocks).sum((-3, -1)) / np.where(total > 0, total, 1)
    coarse = push_pull(mean, total)
    return weight * values + (1 - weight) * _finer(coarse)


def _finer(table: np.ndarray) -> np.ndarray:
    """A table at twice the size, bilinear, held at its borders."""
    for axis in (-2, -1):
        table = np.moveaxis(table, axis, -1)
        before = np.concatenate([table[..., :1], table[..., :-1]], -1)
        after = np.concatenate([table[..., 1:], table[..., -1:]], -1)
        both = np.stack([0.75 * table + 0.25 * before, 0.75 * table + 0.25 * after], -1)
        table = np.moveaxis(both.reshape(*table.shape[:-1], -1), -1, axis)
    return table


def texel_reflectance(
    btf: BTFBlocks,
    surface: SurfaceSamples,
    *,
    iterations: int = 5,
    together: int = BLOCK,
    progress: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Parameters of each texel on its own, in luminance: what clustering needs.

    Parameters
    ----------
    btf : BTFBlocks
    surface : SurfaceSamples
        Of its points.
    iterations : int
        Alternations c_d, p, c_s, r0.
    together : int
        See :func:`texels_together`.
    progress : callable, optional

    Returns
    -------
    dict of str to ndarray
        ``diffuse``, ``specular``, ``fresnel`` of shape (n,), ``ndf`` (n, TEXEL_NDF, TEXEL_NDF).
    """
    size = TEXEL_NDF
    n = surface.n_texels
    result = {name: np.zeros(n) for name in ("diffuse", "specular", "fresnel")}
    result["ndf"] = np.zeros((n, size, size))
    for part, found in over_blocks(btf, _of_texels, (surface, iterations), surface.groups(together)):
        for name, values in found.items():
            result[name][part] = values
        if progress:
            progress(part.stop, n, "reflectance")
    return result


def _of_texels(
    btf: BTFBlocks, shared: tuple[SurfaceSamples, int], group: slice
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """The parameters of the texels of a group, block by block."""
    surface, iterations = shared
    size = TEXEL_NDF
    for part, samples in surface.each(btf, group, size, colour=False):
        channel = samples.values[0]
        count = channel.shape[1]
        r0, specular = np.full(count, FIRST_FRESNEL, np.float32), np.ones(count, np.float32)
        p = np.zeros_like(channel)
        for _ in range(iterations):
            shape = samples.fresnel(r0) * samples.factor
            diffuse = diffuse_colour(channel, samples, specular * p * shape)
            rest = channel - diffuse * samples.light
            over, under = distribution(rest, specular * shape, samples, count * size * size)
            found = np.maximum(_quotient(over, under), 0).reshape(-1, size, size)
            known = (under > 1e-12).reshape(found.shape).astype(float)
            table = limited_distribution(push_pull(found, known))
            p = table.ravel().astype(np.float32)[samples.place]
            specular = np.clip(specular_amount(rest, p * shape), 0, 1 - diffuse)
            r0 = normal_reflectance(rest, specular * p * samples.factor, samples)
        yield part, {"diffuse": diffuse, "specular": specular, "fresnel": r0, "ndf": table}


def material_reflectance(
    btf: BTFBlocks,
    surface: SurfaceSamples,
    labels: np.ndarray,
    n_materials: int,
    *,
    size: int = 32,
    iterations: int = 4,
    together: int = BLOCK,
    progress: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Distributions of the materials, and c_d and r0 of the texels, in colour.

    Starts with c_d alone, as the paper does: a distribution that is there first would keep what is diffuse.

    Parameters
    ----------
    btf : BTFBlocks
    surface : SurfaceSamples
        Of its points, with the rotation of the tangents.
    labels : ndarray of int, shape (n,)
    n_materials : int
    size : int
        Texels per side of the distributions, a power of two.
    iterations : int
    together : int
        See :func:`texels_together`.
    progress : callable, optional

    Returns
    -------
    dict of str to ndarray
        ``diffuse`` (n, 3), ``fresnel`` (n,), ``ndf`` (n_materials, size, size, 3) of largest integral 1, ``specular``
        (n_materials,): c_s.
    """
    n = surface.n_texels
    # c_s p, the product that the data determine; it is taken apart at the end.
    product = np.zeros((3, n_materials, size, size))
    diffuse, r0 = np.zeros((n, 3)), np.full(n, FIRST_FRESNEL, np.float32)
    for turn in range(iterations):
        sums = np.zeros((2, 3, n_materials * size * size))
        table = product.reshape(3, -1).astype(np.float32)
        state = _Materials(surface, labels, table, r0.copy(), size, turn > 0)
        for part, colours, fresnel, of_block in over_blocks(
            btf, _of_materials, state, surface.groups(together)
        ):
            diffuse[part], r0[part] = colours, fresnel
            sums += of_block
            if progress:
                progress(turn * n + part.stop, iterations * n, "materials' reflectance")
        found = np.maximum(_quotient(*sums), 0).reshape(3, n_materials, size, size)
        under = sums[1].reshape(3, n_materials, -1)
        known = (under > 1e-3 * under.mean(-1, keepdims=True)).reshape(found.shape)
        product = push_pull(found, known.astype(float))
        total = (product * texel_solid_angles(size)).sum((-2, -1)).max(0)
        # Only the product with r0 is known; what exceeds c_s = 1 and an integral of 1 is the texels' reflectance.
        over = np.maximum(total, 1)
        product, total = product / over[:, None, None], total / over
        r0 = np.minimum(r0 * over[labels], 1).astype(np.float32)
    ndf = product / np.where(total > 0, total, 1)[:, None, None]
    return {
        "diffuse": diffuse,
        "fresnel": r0,
        "ndf": np.moveaxis(ndf, 0, -1),
        "specular": np.clip(total, 0, 1),
    }


@dataclass(frozen=True)
class _Materials:
    """What a turn starts with: the points, their materials, c_s p of these, r0, and whether r0 is looked for."""

    surface: SurfaceSamples
    labels: np.ndarray
    table: np.ndarray
    r0: np.ndarray
    size: int
    fresnel: bool


def _of_materials(
    btf: BTFBlocks, state: _Materials, group: slice
) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
    """c_d and r0 of the texels of a group, and sums for the distributions, block by block."""
    grey = LUMINANCE.astype(np.float32)
    for part, samples in state.surface.each(btf, group, state.size, state.labels):
        r0, p = state.r0[part], state.table[:, samples.place]
        shape = samples.fresnel(r0) * samples.factor
        found = [diffuse_colour(samples.values[c], samples, p[c] * shape) for c in range(3)]
        rest = [samples.values[c] - found[c] * samples.light for c in range(3)]
        if state.fresnel:
            of_grey = np.tensordot(grey, p, 1) * samples.factor
            all_rest = sum(k * r for k, r in zip(grey, rest, strict=True))
            r0 = normal_reflectance(all_rest, of_grey, samples)
            shape = samples.fresnel(r0) * samples.factor
        sums = [distribution(rest[c], shape, samples, state.table.shape[-1]) for c in range(3)]
        yield part, np.stack(found, -1), r0, np.stack(sums, 1)
