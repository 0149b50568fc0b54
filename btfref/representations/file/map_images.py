"""How maps of any number of axes stand as images in OpenEXR files.

A part's channels are the last axis of its map; the other axes fold into the image: trailing axes into columns while
they fit, the rest into rows. Axes of which scenes need a part (views, clusters) come first, as rows, where the method
asks for it (:class:`~btfref.representations.protocol.KeepsRows`): those rows can be read alone
(:mod:`btfref.representations.file.rows`). The manifest's ``rows`` lists the axes.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from btfref.representations.protocol import KeepsRows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from btfref.types import Facts


#: Columns up to which further axes become columns.
MAXIMUM_WIDTH = 8192

#: Rows of an image that belong together: those that OpenEXR compresses in one go, and that one checksum is of.
BLOCK = 16


def image_size(shape: Sequence[int], leading: int = 0) -> tuple[int, int]:
    """Rows and columns of the image that holds a map: trailing axes fold into columns while they fit.

    The first ``leading`` axes are rows in any case.
    """
    spatial = [int(n) for n in shape[:-1]] or [1]
    width = spatial.pop() if len(spatial) > leading else 1
    while len(spatial) > leading and width * spatial[-1] <= MAXIMUM_WIDTH:
        width *= spatial.pop()
    return int(np.prod(spatial, dtype=np.int64)), width


def leading_axes(made: object, name: str) -> list[int]:
    """Axes of a map that are rows of its image, so that they can be read alone; ``made`` is the class."""
    patterns = made.ROWS_BY if isinstance(made, KeepsRows) else {}
    return next((list(axes) for pattern, axes in patterns.items() if fnmatchcase(name, pattern)), [])


def image_of(array: np.ndarray, leading: Sequence[int]) -> np.ndarray:
    """A map as an image, its leading axes first."""
    moved = np.moveaxis(array, leading, range(len(leading)))
    return moved.reshape(*image_size(moved.shape, len(leading)), moved.shape[-1])


def file_shape(entry: Facts) -> list[int]:
    """Shape of a map with the axes in the order of the file."""
    shape, leading = entry["shape"], entry.get("rows", [])
    return [shape[i] for i in leading] + [n for i, n in enumerate(shape) if i not in leading]


def channel_names(n: int) -> list[str]:
    """Names of a part's channels."""
    # A viewer shows "R, G, B" as colour and "Y" as grey; EXR sorts channels by name, hence the padded numbers.
    return {1: ["Y"], 3: ["R", "G", "B"]}.get(n, [f"c{i:04d}" for i in range(n)])


def rows_of(entry: Facts, axes: Mapping[int, np.ndarray]) -> np.ndarray | None:
    """Rows of a map's image that hold the chosen indices of its axes; None for all."""
    leading = entry.get("rows", [])
    if not any(axis in axes for axis in leading):
        return None
    shape = file_shape(entry)
    height, _ = image_size(shape, len(leading))
    chosen = np.ones([shape[i] for i in range(len(leading))], bool)
    for i, axis in enumerate(leading):
        if axis in axes:
            mask = np.zeros(shape[i], bool)
            inside = axes[axis][(axes[axis] >= 0) & (axes[axis] < shape[i])]
            mask[inside] = True
            chosen &= np.expand_dims(mask, [k for k in range(len(leading)) if k != i])
    return np.flatnonzero(np.repeat(chosen.ravel(), height // chosen.size))
