"""Reflectance of each texel by alternating least squares, once heights and normals are known.

Source: Menzel and Guthe 2009, eq. 9 to 20. Push–pull after S. Gortler et al., "The Lumigraph", SIGGRAPH 1996.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.numerics.sphere.parabolic import texel_solid_angles
from btfref.representations.gbrdf.decomposition.samples import BLOCK
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.representations.gbrdf.decomposition.samples import BlockSamples, SurfaceSamples
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress


#: r0 to start from: a refractive index of 1.5.
FIRST_FRESNEL = 0.04

#: Texels per side of the table of a single texel's distribution.
TEXEL_NDF = 16


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
