"""Reflectance of each texel by alternating least squares, once heights and normals are known.

Source: Menzel and Guthe 2009, eq. 9 to 20. Every residual is weighted by 1/L, so that it is the logarithmic error; L is
held above a share of the mean, so that weights stay finite in float32. Push–pull after S. Gortler et al., "The
Lumigraph", SIGGRAPH 1996.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.decomposition.normals import visible
from btfref.decomposition.pairs import surface_stencil, tangent
from btfref.numerics.microfacets import fifth_power, geometry_factor
from btfref.numerics.parabolic import texel_solid_angles
from btfref.representations.gbrdf import surface_frame

#: Texels a block: bounds the memory of their tables.
BLOCK = 128

#: Cosines to the local normal below which a sample is left out: there the height map decides, not the material.
GRAZING = 0.1

#: Texels per side of the table of a single texel's distribution.
TEXEL_NDF = 16


@dataclass(frozen=True)
class Samples:
    """What the surface points of a block of N texels show, float32; P pairs (view, light), view slowest.

    Attributes
    ----------
    values : ndarray, shape (N, P, 3)
        B in 1/sr.
    weight : ndarray, shape (N, P)
        1 / L where seen, lit and not grazing, else 0.
    cos_light, factor : ndarray, shape (N, P)
        k1·n, and k1·n over the denominator of the BRDF.
    cell : ndarray of int32, shape (N, P)
        Texel of the half vector in the distribution's table.
    fifth : ndarray, shape (P,)
        (1 − k1·h)^5.
    """

    values: np.ndarray
    weight: np.ndarray
    cos_light: np.ndarray
    factor: np.ndarray
    cell: np.ndarray
    fifth: np.ndarray


class SurfaceSamples:
    """Samples of a BTF on a height field.

    Parameters
    ----------
    btf : SampledBTF
    field : btfref.numerics.heightfield.HeightField
    rotation : ndarray, shape (rows, columns), optional
        Of the tangents, in turns.
    """

    def __init__(self, btf, field, rotation=None):
        self._btf, self._field = btf, field
        views, lights = btf.views.vectors, btf.lights.vectors
        self.n_texels = int(np.prod(field.shape))
        self._seen, self._lit = visible(field, views), visible(field, lights)
        safe = np.maximum(views[:, 2], 1e-6)
        heights = field.heights.astype(float)
        self._stencils = [
            surface_stencil(heights, tangent(np.array([x, y, z]))) if v[2] > 1e-6 else None
            for v, (x, y), z in zip(views, views[:, :2], safe, strict=True)
        ]
        turn = np.zeros(field.shape) if rotation is None else 2 * np.pi * rotation
        surface = np.concatenate([field.slopes, np.cos(turn)[..., None], np.sin(turn)[..., None]], -1)
        self._frame = np.stack(surface_frame(surface.reshape(-1, 4)), 1).astype(np.float32)
        half = (views[:, None] + lights[None]).reshape(-1, 3)
        half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
        self._half = half.astype(np.float32)
        self.fifth = fifth_power((half.reshape(len(views), -1, 3) * lights).sum(-1)).ravel().astype(np.float32)
        self.black = 0.02 * mean_luminance(btf)

    def blocks(self):
        """Texels of each block, as slices of the flat index."""
        return [slice(i, min(i + BLOCK, self.n_texels)) for i in range(0, self.n_texels, BLOCK)]

    def read(self, part, ndf_size):
        """Samples of some texels; ``cell`` is for tables of ``ndf_size`` texels a side."""
        views, lights = (d.vectors.astype(np.float32) for d in (self._btf.views, self._btf.lights))
        frame = self._frame[part]
        n, n_views, n_lights = len(frame), len(views), len(lights)
        values = np.zeros((n, n_views, n_lights, 3), np.float32)
        for view, stencil in enumerate(self._stencils):
            if stencil is None:
                continue
            index, share = stencil[0][part], stencil[1][part]
            images = self._btf.values[view].reshape(n_lights, -1, 3)
            for k in range(index.shape[1]):
                values[:, view] += np.swapaxes(images[:, index[:, k]], 0, 1) * share[:, k, None, None]
        cos_view = np.einsum("nc,vc->nv", frame[:, 2], views)
        cos_light = np.einsum("nc,lc->nl", frame[:, 2], lights)
        there = (self._seen[part] & (cos_view > GRAZING))[:, :, None]
        there = there & (self._lit[part] & (cos_light > GRAZING))[:, None, :]
        luminance = values @ LUMINANCE.astype(np.float32)
        weight = there / np.maximum(luminance, self.black)
        factor = geometry_factor(cos_light[:, None, :], cos_view[:, :, None]).astype(np.float32)
        local = np.einsum("nkc,pc->knp", frame, self._half, optimize=True)
        scale = 0.5 * ndf_size / (1 + np.maximum(local[2], 0))
        column, row = (
            np.clip(local[i] * scale + 0.5 * ndf_size, 0, ndf_size - 1).astype(np.int32) for i in (0, 1)
        )
        flat = (n, n_views * n_lights)
        light = np.broadcast_to(cos_light[:, None, :], luminance.shape)
        return Samples(
            values.reshape(*flat, 3),
            (weight.reshape(flat) * (local[2] > 0)).astype(np.float32),
            light.reshape(flat),
            factor.reshape(flat),
            row * ndf_size + column,
            self.fifth,
        )


def mean_luminance(btf):
    """Mean luminance of some of a BTF's samples in 1/sr, a little above 0 for a black one."""
    some = np.asarray(btf.values[:: max(1, len(btf.views) // 8), ::4], np.float32)
    return float((some @ LUMINANCE.astype(np.float32)).mean()) + 1e-9


def diffuse_colour(samples, channel, specular):
    """c_d by eq. 9 to 11, shape (N,) in [0, 1]; ``specular`` is c_s p F k1·n / D, shape (N, P)."""
    basis = samples.cos_light * samples.weight / np.float32(np.pi)
    rest = (channel - specular) * samples.weight
    return np.clip(_quotient((basis * rest).sum(1), (basis * basis).sum(1)), 0, 1)


def distribution(samples, channel, diffuse, amount, n_cells, group=None, n_groups=None):
    """Numerator and denominator of p by eq. 12 to 14, each of shape (n_groups, n_cells).

    Parameters
    ----------
    samples : Samples
    channel : ndarray, shape (N, P)
    diffuse : ndarray, shape (N,)
        c_d.
    amount : ndarray, shape (N, P)
        c_s F k1·n / D.
    n_cells : int
    group : ndarray of int, shape (N,), optional
        Texels of one group share a distribution; default: each has its own.
    n_groups : int, optional
    """
    n = len(channel)
    group, n_groups = (np.arange(n), n) if group is None else (group, n_groups)
    basis = amount * samples.weight
    rest = (channel - (diffuse / np.float32(np.pi))[:, None] * samples.cos_light) * samples.weight
    index = (group[:, None] * n_cells + samples.cell).ravel()
    size = n_groups * n_cells
    return tuple(
        np.bincount(index, (basis * other).ravel(), size).reshape(n_groups, n_cells) for other in (rest, basis)
    )


def specular_amount(samples, channel, diffuse, p, fresnel):
    """c_s by eq. 15 to 17, shape (N,), not yet limited; ``p`` and ``fresnel`` have shape (N, P)."""
    basis = p * fresnel * samples.factor * samples.weight
    rest = (channel - (diffuse / np.float32(np.pi))[:, None] * samples.cos_light) * samples.weight
    return _quotient((basis * rest).sum(1), (basis * basis).sum(1))


def normal_reflectance(samples, channel, diffuse, shape):
    """r0 by eq. 18 to 20, shape (N,) in [0, 1]; ``shape`` is c_s p k1·n / D, shape (N, P)."""
    basis = shape * (1 - samples.fifth) * samples.weight
    rest = channel - (diffuse / np.float32(np.pi))[:, None] * samples.cos_light - shape * samples.fifth
    return np.clip(_quotient((basis * rest * samples.weight).sum(1), (basis * basis).sum(1)), 0, 1)


def _quotient(a, b):
    there = b > 1e-20
    return np.where(there, a / np.where(there, b, 1), 0)


def limited_distribution(p):
    """A table of p that conserves energy, shape (..., n, n): at most 1 / solid angle, integral at most 1."""
    solid_angle = texel_solid_angles(p.shape[-1])
    floor = solid_angle.max() * 1e-3
    p = np.clip(p, 0, 1 / np.maximum(solid_angle, floor))
    return p / np.maximum((p * solid_angle).sum((-2, -1), keepdims=True), 1)


def push_pull(values, weight):
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


def _finer(table):
    """A table at twice the size, bilinear, held at its borders."""
    for axis in (-2, -1):
        table = np.moveaxis(table, axis, -1)
        before = np.concatenate([table[..., :1], table[..., :-1]], -1)
        after = np.concatenate([table[..., 1:], table[..., -1:]], -1)
        both = np.stack([0.75 * table + 0.25 * before, 0.75 * table + 0.25 * after], -1)
        table = np.moveaxis(both.reshape(*table.shape[:-1], -1), -1, axis)
    return table


def texel_reflectance(surface, *, iterations=6, progress=None):
    """Parameters of each texel on its own, in luminance: what clustering needs.

    Parameters
    ----------
    surface : SurfaceSamples
    iterations : int
        Alternations c_d, p, c_s, r0.
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
    for part in surface.blocks():
        samples = surface.read(part, size)
        channel = samples.values @ LUMINANCE.astype(np.float32)
        count = len(channel)
        rows = np.arange(count)[:, None]
        fresnel, specular = np.full(count, 0.04, np.float32), np.ones(count, np.float32)
        table, p = np.zeros((count, size, size)), np.float32(0)
        for _ in range(iterations):
            f = samples.fifth + fresnel[:, None] * (1 - samples.fifth)
            base = f * samples.factor
            diffuse = diffuse_colour(samples, channel, specular[:, None] * p * base).astype(np.float32)
            over, under = distribution(samples, channel, diffuse, specular[:, None] * base, size * size)
            found = np.maximum(_quotient(over, under), 0).reshape(-1, size, size)
            table = limited_distribution(push_pull(found, (under > 1e-12).reshape(found.shape).astype(float)))
            p = table.reshape(count, -1).astype(np.float32)[rows, samples.cell]
            specular = specular_amount(samples, channel, diffuse, p, f)
            specular = np.clip(specular, 0, 1 - diffuse).astype(np.float32)
            shape = specular[:, None] * p * samples.factor
            fresnel = normal_reflectance(samples, channel, diffuse, shape).astype(np.float32)
        result["diffuse"][part], result["specular"][part] = diffuse, specular
        result["fresnel"][part], result["ndf"][part] = fresnel, table
        if progress:
            progress(part.stop, n, "reflectance")
    return result


def material_reflectance(surface, labels, n_materials, *, start, size=32, iterations=4, progress=None):
    """Distributions of the materials, and c_d and r0 of the texels, in colour.

    Parameters
    ----------
    surface : SurfaceSamples
        With the rotation of the tangents.
    labels : ndarray of int, shape (n,)
    n_materials : int
    start : dict
        ``ndf`` (n_materials, n, n) and ``fresnel`` (n,) to start from.
    size : int
        Texels per side of the distributions, a power of two.
    iterations : int
    progress : callable, optional

    Returns
    -------
    dict of str to ndarray
        ``diffuse`` (n, 3), ``fresnel`` (n,), ``ndf`` (n_materials, size, size, 3) of largest integral 1, ``specular``
        (n_materials,): c_s.
    """
    from btfref.numerics.parabolic import bilinear_stencil, texel_directions

    n = surface.n_texels
    solid_angle = texel_solid_angles(size)
    index, share = bilinear_stencil(texel_directions(size), start["ndf"].shape[-1])
    grey = (start["ndf"].reshape(n_materials, -1)[:, index] * share).sum(-1)
    # c_s p, the product that the data determine; it is taken apart at the end.
    product = np.repeat(grey[..., None], 3, -1) * start["specular"][:, None, None, None]
    diffuse, fresnel = np.zeros((n, 3)), start["fresnel"].astype(np.float32).copy()
    for turn in range(iterations):
        over, under = np.zeros((2, 3, n_materials, size * size))
        table = product.reshape(n_materials, size * size, 3).astype(np.float32)
        for part in surface.blocks():
            samples = surface.read(part, size)
            own = labels[part]
            p = [table[own[:, None], samples.cell, c] for c in range(3)]
            f = samples.fifth + fresnel[part][:, None] * (1 - samples.fifth)
            channels = [samples.values[..., c] for c in range(3)]
            for c in range(3):
                diffuse[part, c] = diffuse_colour(samples, channels[c], p[c] * f * samples.factor)
            grey_value = sum(k * v for k, v in zip(LUMINANCE.astype(np.float32), channels, strict=True))
            grey_p = sum(k * v for k, v in zip(LUMINANCE.astype(np.float32), p, strict=True))
            grey_diffuse = (diffuse[part] @ LUMINANCE).astype(np.float32)
            r0 = normal_reflectance(samples, grey_value, grey_diffuse, grey_p * samples.factor)
            if turn:
                fresnel[part] = r0
            f = samples.fifth + fresnel[part][:, None] * (1 - samples.fifth)
            for c in range(3):
                found = distribution(
                    samples,
                    channels[c],
                    diffuse[part, c].astype(np.float32),
                    f * samples.factor,
                    size * size,
                    own,
                    n_materials,
                )
                over[c] += found[0]
                under[c] += found[1]
            if progress:
                progress(turn * n + part.stop, iterations * n, "materials' reflectance")
        found = np.maximum(_quotient(over, under), 0).reshape(3, n_materials, size, size)
        known = (under > 1e-3 * under.mean((-1,), keepdims=True)).reshape(found.shape)
        product = np.moveaxis(push_pull(found, known.astype(float)), 0, -1)
    total = (product * solid_angle[..., None]).sum((1, 2)).max(-1)
    ndf = product / np.where(total > 0, total, 1)[:, None, None, None]
    return {"diffuse": diffuse, "fresnel": fresnel, "ndf": ndf, "specular": np.clip(total, 0, 1)}
