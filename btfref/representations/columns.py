"""The matrix of a sampled BTF with a texel a row, read view by view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from btfref.numerics.solvers.threads import in_parallel
from btfref.representations.lookup import refuse_not_finite
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress

S = TypeVar("S")
R = TypeVar("R")

#: Bytes of a block in float32, unless a single light has more: some lights of a view. Of every machine and budget the
#: same, since sums go by blocks.
BLOCK_BYTES = 96 << 20

#: Images of a block that a thread works on at a time.
TOGETHER = 16


class Steps:
    """Counts the steps of a fit for ``progress(done, total, label)``, which may be None.

    Parameters
    ----------
    progress : callable or None
    total : int
    """

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self.total, self._done, self.label = progress, total, 0, ""

    def begin(self, label: str) -> None:
        """What is done from here on."""
        self.label = label
        self._report()

    def __call__(self) -> None:
        """One more step is done."""
        self._done += 1
        self._report()

    def _report(self) -> None:
        if self._progress is not None:
            self._progress(min(self._done, self.total), self.total, self.label)


def light_blocks(btf: BTFBlocks) -> list[slice]:
    """Lights of a view that make a block."""
    n_lights, rows, columns = len(btf.lights), *btf.texels
    step = max(1, BLOCK_BYTES // (12 * rows * columns))
    return [slice(first, min(first + step, n_lights)) for first in range(0, n_lights, step)]


def planes(values: np.ndarray, order: np.ndarray | None = None) -> np.ndarray:
    """Values as planes of float32, shape (lights, texels, 3) -> (lights, 3, texels).

    Parameters
    ----------
    values : ndarray
    order : ndarray of int, optional
        Of the texels.
    """
    return each_part(
        lambda part: (part if order is None else part[:, order]).astype(np.float32).swapaxes(1, 2),
        values,
        (3, values.shape[1]),
    )


def each_part(
    action: Callable[[np.ndarray], np.ndarray], images: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """An action on images, a few of them at a time, on several threads; each result has the given shape, in float32."""
    result = np.zeros((len(images), *shape), np.float32)

    def some(first: int) -> None:
        part = slice(first, first + TOGETHER)
        result[part] = action(images[part])

    in_parallel(some, range(0, len(images), TOGETHER))
    return result


class TexelColumns:
    """A sampled BTF as :class:`btfref.numerics.solvers.streaming.Columns`: a texel a row.

    Columns are (view, light, channel).

    Parameters
    ----------
    btf : BTFBlocks
    tick : callable
        Called after each view.
    order : ndarray of int, optional
        Order of the texels.
    """

    def __init__(self, btf: BTFBlocks, tick: Callable[[], object], order: np.ndarray | None = None) -> None:
        self._btf, self._tick, self._order = btf, tick, order
        self._checked = False

    @property
    def shape(self) -> tuple[int, int]:
        """Texels, and pairs of directions times channels."""
        rows, columns = self._btf.texels
        return rows * columns, 3 * len(self._btf.views) * len(self._btf.lights)

    def over(self, work: Callable[[S, slice, np.ndarray], R], shared: S) -> Iterator[tuple[slice, R]]:
        """See :class:`btfref.numerics.solvers.streaming.Columns`.

        Raises
        ------
        InputError
            For values that are not finite.
        """
        task = _Task(work, shared, self._order, not self._checked)
        yield from over_blocks(self._btf, _view_columns, task, range(len(self._btf.views)), self._tick)
        self._checked = True


@dataclass(frozen=True)
class _Task(Generic[S, R]):
    """What is made of the columns of each view."""

    work: Callable[[S, slice, np.ndarray], R]
    shared: S
    order: np.ndarray | None
    check: bool


def _view_columns(btf: BTFBlocks, task: _Task[S, R], view: int) -> Iterator[tuple[slice, R]]:
    """The columns of a view, block by block, and what is made of them."""
    n_lights, n_texels = len(btf.lights), btf.texels[0] * btf.texels[1]
    values = btf.view(view).reshape(n_lights, n_texels, 3)
    for lights in light_blocks(btf):
        block = planes(values[lights], task.order).reshape(-1, n_texels)
        if task.check:
            refuse_not_finite(block, btf)
        first = 3 * (view * n_lights + lights.start)
        part = slice(first, first + len(block))
        yield part, task.work(task.shared, part, block)
