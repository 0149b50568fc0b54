"""Gaussian pyramids of a sampled BTF's images in Y, Cb and Cr, made view by view and kept where there is memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.pyramid import expansion, level_shapes, reduction
from btfref.numerics.ycbcr import FROM_RGB
from btfref.representations.columns import each_part, light_blocks, planes
from btfref.representations.lookup import refuse_not_finite

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from btfref.sampling.blocks import BTFBlocks

#: Levels from this one on are always kept: a 256th of the texels and less.
KEPT = 4

#: Images of some pairs, level by level: each (pairs, channel, texels) float32.
Images = list[np.ndarray]


class PyramidImages:
    """Images of all levels, block by block of pairs of directions, the same blocks for all of them.

    Parameters
    ----------
    btf : BTFBlocks
    n_levels : int
    kind : {"binomial", "box"}
        Of the reduction.
    tick : callable
        Called after each view that is read.
    """

    def __init__(self, btf: BTFBlocks, n_levels: int, kind: str, tick: Callable[[], object]) -> None:
        self._btf, self._tick = btf, tick
        self.shapes = level_shapes(btf.texels, n_levels)
        self.n_pairs = len(btf.views) * len(btf.lights)
        self._operators = [
            tuple(reduction(n, m, kind).astype(np.float32) for n, m in zip(fine, coarse, strict=True))
            for fine, coarse in zip(self.shapes, self.shapes[1:], strict=False)
        ]
        #: Level -> its images, for levels that are kept.
        self._kept: dict[int, np.ndarray] = {}
        for k in range(n_levels - 1, -1, -1):
            size = 12 * self.n_pairs * self.texels(k)
            if not btf.claim(size) and k < KEPT:
                break
            self._kept[k] = np.zeros((self.n_pairs, 3, self.texels(k)), np.float32)
        #: The finest level that is kept, or one more than there are.
        self.first_kept = min(self._kept, default=n_levels)

    def texels(self, level: int) -> int:
        """Texels of a level."""
        rows, columns = self.shapes[level]
        return rows * columns

    def fill(self) -> Iterator[Images]:
        """Images of all levels from the finest on, for the first time; levels that are kept are filled.

        Raises
        ------
        InputError
            For values that are not finite.
        """
        for part, images in self._made(0, check=True):
            for k, kept in self._kept.items():
                kept[part] = images[k]
            yield images

    def blocks(self, level: int) -> Iterator[tuple[slice, Images]]:
        """Pairs, and their images of a level and all coarser ones."""
        if level < self.first_kept:
            yield from self._made(level)
            return
        for part in self._parts():
            yield part, [self._kept[k][part] for k in range(level, len(self.shapes))]

    def _parts(self) -> Iterator[slice]:
        n_lights = len(self._btf.lights)
        for view in range(len(self._btf.views)):
            for lights in light_blocks(self._btf):
                yield slice(view * n_lights + lights.start, view * n_lights + lights.stop)

    def _made(self, level: int, *, check: bool = False) -> Iterator[tuple[slice, Images]]:
        """The same from the values themselves."""
        n_lights, weights = len(self._btf.lights), FROM_RGB.astype(np.float32)
        for view in range(len(self._btf.views)):
            values = self._btf.view(view).reshape(n_lights, self.texels(0), 3)
            for lights in light_blocks(self._btf):
                image = planes(values[lights])
                if check:
                    refuse_not_finite(image, self._btf)
                image = each_part(lambda block: weights @ block, image, image.shape[1:])
                part = slice(view * n_lights + lights.start, view * n_lights + lights.stop)
                images = [image]
                for k in range(1, len(self.shapes)):
                    there = not check and k in self._kept
                    images.append(self._kept[k][part] if there else self._reduced(k - 1, images[-1]))
                yield part, images[level:]
            self._tick()

    def _reduced(self, level: int, images: np.ndarray) -> np.ndarray:
        rows, columns = self._operators[level]
        shape = self.shapes[level]

        def reduced(part: np.ndarray) -> np.ndarray:
            images = rows @ part.reshape(len(part), 3, *shape) @ columns.T
            return images.reshape(len(part), 3, -1)

        return each_part(reduced, images, (3, self.texels(level + 1)))


def expanded(
    images: np.ndarray, coarse: tuple[int, int], fine: tuple[int, int], filter_type: str
) -> np.ndarray:
    """Images (…, texels) looked up at the texel centres of a finer level."""
    if coarse == fine:
        return images
    rows, columns = (
        expansion(n, m, filter_type).astype(images.dtype) for n, m in zip(fine, coarse, strict=True)
    )
    return (rows @ images.reshape(-1, *coarse) @ columns.T).reshape(*images.shape[:-1], -1)
