"""Reciprocal pairs of images: two directions that have changed the roles of light and view.

Source: Menzel and Guthe 2009, eq. 3 and 4: ``L(k1, k2) = ρ(k1, k2) (k1·n) L_i`` with ρ reciprocal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.representations.lookup import refuse_not_finite
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike

    from btfref.sampling.blocks import BTFBlocks


#: Directions further from the normal take no part: their images are foreshortened to little more than silhouettes.
LARGEST_ANGLE = np.radians(62)

#: Pairs of images that take part, unless told otherwise.
N_PAIRS = 128

#: Share of the mean luminance below which a sample counts as black: its logarithm would be noise.
BLACK = 0.01


class ReciprocalPairs:
    """Luminance images of a BTF for pairs of directions, all of them made in one pass over the views.

    Parameters
    ----------
    btf : BTFBlocks
        Lights that differ from the views are interpolated by their own stencil.
    count : int
        At most so many pairs, drawn with ``seed``.
    seed : int

    Attributes
    ----------
    first, second : ndarray of float64, shape (n, 3)
        The two directions of each pair.
    shape : tuple of int
        Rows and columns of an image.
    black : float
        Luminance in 1/sr that :meth:`logarithms` holds.

    Raises
    ------
    InputError
        For values that are not finite.
    """

    def __init__(self, btf: BTFBlocks, count: int = N_PAIRS, seed: int = 0) -> None:
        self.shape = btf.texels
        views = btf.views.vectors
        near = np.flatnonzero(views[:, 2] >= np.cos(LARGEST_ANGLE))
        a, b = (near[i] for i in np.triu_indices(len(near), 1))
        if len(a) > count:
            chosen = np.sort(np.random.default_rng(seed).choice(len(a), count, replace=False))
            a, b = a[chosen], b[chosen]
        self._views = np.stack([a, b], 1)
        self.first, self.second = views[a], views[b]
        self.black = BLACK * mean_luminance(btf, 8) + 1e-12
        under: dict[int, list[int]] = {}
        for one, other in self._views.tolist():
            under.setdefault(one, []).append(other)
            under.setdefault(other, []).append(one)
        wanted = _Wanted(under, *btf.lights.stencil(views, hold=False))
        found = over_blocks(btf, _images, wanted, range(len(views)))
        self._images = {(view, light): image for view, light, image in found}

    def __len__(self) -> int:
        return len(self._views)

    def images(self, pair: int) -> tuple[np.ndarray, np.ndarray]:
        """Luminance seen from the first direction under the second one, and the other way round.

        Returns
        -------
        tuple of ndarray of float32, shape (rows, columns)
        """
        a, b = self._views[pair].tolist()
        return self._images[a, b], self._images[b, a]

    def logarithms(self, pair: int) -> tuple[np.ndarray, np.ndarray]:
        """Natural logarithms of :meth:`images`, held at ``black``."""
        return tuple(np.log(np.maximum(image, self.black)) for image in self.images(pair))


@dataclass(frozen=True)
class _Wanted:
    """Images that take part: view → views whose directions light it, and the lights that stand for such a direction."""

    under: dict[int, list[int]]
    light: np.ndarray
    share: np.ndarray


def _images(btf: BTFBlocks, wanted: _Wanted, view: int) -> Iterator[tuple[int, int, np.ndarray]]:
    """The images of a view, whose values are checked."""
    values = btf.view(view)
    refuse_not_finite(values, btf)
    for other in wanted.under.get(view, ()):
        total = np.zeros(btf.texels, np.float32)
        for index, share in zip(wanted.light[other], wanted.share[other], strict=True):
            if share:
                image = np.asarray(values[index], np.float32) @ LUMINANCE.astype(np.float32)
                total += np.float32(share) * image
        yield view, other, total


def mean_luminance(btf: BTFBlocks, every: int) -> float:
    """Mean luminance of some of a BTF's samples, 1/sr: of eight views or some more, and of every so many lights."""
    views = range(0, len(btf.views), max(1, len(btf.views) // 8))
    sums = list(over_blocks(btf, _luminance, every, views))
    return sum(total for total, _ in sums) / sum(count for _, count in sums)


def _luminance(btf: BTFBlocks, every: int, view: int) -> Iterator[tuple[float, int]]:
    """Sum and number of a view's luminances."""
    found = np.asarray(btf.view(view)[::every], np.float32) @ LUMINANCE.astype(np.float32)
    yield float(found.sum(dtype=float)), found.size


def tangent(w: ArrayLike) -> np.ndarray:
    """``w_xy / w_z`` of directions, shape (..., 3) -> (..., 2)."""
    w = np.asarray(w, float)
    return w[..., :2] / w[..., 2:]


def shifted(image: np.ndarray, offset: ArrayLike) -> np.ndarray:
    """An image of the periodic tile, moved so that each texel shows what is ``offset`` away.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
    offset : sequence of 2 floats
        Along u and v in tiles; a surface point at height z shows at ``−z tangent(view)``.

    Returns
    -------
    ndarray
        Bilinear between texels.
    """
    result = np.zeros_like(image)
    rows, columns = image.shape
    whole = np.floor(np.asarray(offset) * (columns, rows)).astype(int)
    fx, fy = np.asarray(offset) * (columns, rows) - whole
    # A row and a column more: the four neighbours are parts of one copy.
    row, column = (np.arange(rows + 1) + whole[1]) % rows, (np.arange(columns + 1) + whole[0]) % columns
    moved = image[row[:, None], column]
    for dy, wy in ((0, 1 - fy), (1, fy)):
        for dx, wx in ((0, 1 - fx), (1, fx)):
            if wx * wy > 0:
                part = moved[dy : dy + rows, dx : dx + columns]
                result += np.asarray(wx * wy, image.dtype) * part
    return result


def surface_stencil(
    heights: np.ndarray, view_tangent: np.ndarray, part: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Texels that show the points of a height map from a view, and their weights.

    Parameters
    ----------
    heights : ndarray, shape (rows, columns)
        Tile units.
    view_tangent : ndarray, shape (2,)
    part : slice
        Of the flat index: these points.

    Returns
    -------
    index : ndarray of int, shape (n, 4)
        Flat.
    weight : ndarray of float32, shape (n, 4)
    """
    from btfref.conventions import texel_stencil

    rows, columns = heights.shape
    row, column = np.divmod(np.arange(heights.size)[part], columns)
    uv = np.stack([(column + 0.5) / columns, (row + 0.5) / rows], -1)
    uv -= heights.reshape(-1)[part, None] * view_tangent
    index, weight = texel_stencil(uv, heights.shape, "bilinear")
    return index, weight.astype(np.float32)
