"""Gaussian pyramids of a sampled BTF's images in Y, Cb and Cr, made view by view and kept where there is memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from btfref.numerics.pyramid import expansion, level_shapes, reduction
from btfref.numerics.ycbcr import FROM_RGB
from btfref.representations.columns import each_part, light_blocks, planes
from btfref.representations.lookup import refuse_not_finite
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.sampling.blocks import BTFBlocks

S = TypeVar("S")
R = TypeVar("R")

#: Levels from this one on are always kept: a 256th of the texels and less.
KEPT = 4

#: Images of some pairs, level by level: each (pairs, channel, texels) float32.
Images = list[np.ndarray]

#: What is made of a block: ``(shared, pairs, images) -> result``, a function of a module.
ImageWork = Callable[[S, slice, Images], R]


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

    def fill(self, work: ImageWork[S, R], shared: S) -> Iterator[R]:
        """What is made of the images of all levels from the finest on, block by block, for the first time.

        Levels that are kept are filled.

        Parameters
        ----------
        work : callable
        shared : object
            The same for all blocks; nothing may change it.

        Raises
        ------
        InputError
            For values that are not finite.
        """
        last = len(self.shapes) - 1
        task = _Task(work, shared, self.shapes, self._operators, 0, last, tuple(self._kept), check=True)
        for part, result, kept in over_blocks(
            self._btf, _view_images, task, range(len(self._btf.views)), self._tick
        ):
            for k, images in kept.items():
                self._kept[k][part] = images
            yield result

    def over(
        self, level: int, work: ImageWork[S, R], shared: S, *, coarser: bool = False
    ) -> Iterator[tuple[slice, R]]:
        """Pairs, and what is made of their images, block by block.

        Parameters
        ----------
        level : int
            Whose images are the first.
        work : callable
        shared : object
            The same for all blocks; nothing may change it.
        coarser : bool
            Whether those of all coarser levels follow.
        """
        last = len(self.shapes) - 1 if coarser else level
        if level < self.first_kept:
            task = _Task(work, shared, self.shapes, self._operators, level, last, ())
            for part, result, _ in over_blocks(
                self._btf, _view_images, task, range(len(self._btf.views)), self._tick
            ):
                yield part, result
            return
        for view in range(len(self._btf.views)):
            for part in _parts(self._btf, view):
                yield part, work(shared, part, [self._kept[k][part] for k in range(level, last + 1)])


@dataclass(frozen=True)
class _Task(Generic[S, R]):
    """What is made of the images of each view, and how these are made.

    Attributes
    ----------
    work : callable
    shared : object
    shapes : list of tuple
        Of the levels.
    operators : list of tuple of ndarray
        From each level to the next.
    first, last : int
        Levels that are asked for.
    kept : tuple of int
        Levels whose images are wanted too.
    check : bool
    """

    work: ImageWork[S, R]
    shared: S
    shapes: list[tuple[int, int]]
    operators: list[tuple[np.ndarray, ...]]
    first: int
    last: int
    kept: tuple[int, ...]
    check: bool = False

    def reduced(self, level: int, images: np.ndarray) -> np.ndarray:
        """Images of the next level."""
        rows, columns = self.operators[level]
        shape, coarse = self.shapes[level], self.shapes[level + 1]

        def reduced(part: np.ndarray) -> np.ndarray:
            images = rows @ part.reshape(len(part), 3, *shape) @ columns.T
            return images.reshape(len(part), 3, -1)

        return each_part(reduced, images, (3, coarse[0] * coarse[1]))


def _parts(btf: BTFBlocks, view: int) -> list[slice]:
    """Pairs of the blocks of a view."""
    first = view * len(btf.lights)
    return [slice(first + lights.start, first + lights.stop) for lights in light_blocks(btf)]


def _view_images(
    btf: BTFBlocks, task: _Task[S, R], view: int
) -> Iterator[tuple[slice, R, dict[int, np.ndarray]]]:
    """Pairs of a view's blocks, what is made of their images, and those that are kept."""
    weights = FROM_RGB.astype(np.float32)
    values = btf.view(view).reshape(len(btf.lights), btf.texels[0] * btf.texels[1], 3)
    for part, lights in zip(_parts(btf, view), light_blocks(btf), strict=True):
        image = planes(values[lights])
        if task.check:
            refuse_not_finite(image, btf)
        images = [each_part(lambda block: weights @ block, image, image.shape[1:])]
        for k in range(task.last):
            images.append(task.reduced(k, images[-1]))
            if k < task.first:
                images[k] = images[k][:0]  # it was a step on the way
        result = task.work(task.shared, part, images[task.first :])
        yield part, result, {k: images[k] for k in task.kept}


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
