"""What a BTF shows of the points of a height field, block by block: what reflectances are found from.

Source: Menzel and Guthe 2009, section 5. Samples are weighted by 1/L, so that residuals are logarithmic errors; L is
held above a share of the mean, so that weights stay finite in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.numerics.microfacets import fifth_power, geometry_factor
from btfref.numerics.sphere.frames import surface_frame
from btfref.representations.gbrdf.decomposition.normals import visible
from btfref.representations.gbrdf.decomposition.pairs import mean_luminance, surface_stencil, tangent
from btfref.sampling.blocks import StreamedBTF

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.numerics.heightfield import HeightField
    from btfref.sampling.blocks import BTFBlocks


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
