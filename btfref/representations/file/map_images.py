"""How maps of any number of axes stand as images in OpenEXR files.

A part's channels are the last axis of its map; the other axes fold into the image: trailing axes into columns while
they fit, the rest into rows. Axes of which scenes need a part (views, clusters) come first, as rows, where the method
asks for it (:class:`~btfref.representations.protocol.KeepsRows`): those rows can be read alone
(:mod:`btfref.representations.file.rows`). The manifest's ``rows`` lists the axes.
"""

from __future__ import annotations

import math
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

#: Bytes of a row from which on it may be compressed alone: shorter ones would cost more than they save.
LEAST_LINE = 1024


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


def planes_of(array: np.ndarray, leading: Sequence[int]) -> list[np.ndarray]:
    """Channels of a map as images, its leading axes first."""
    moved = np.moveaxis(array, leading, range(len(leading)))
    size = image_size(moved.shape, len(leading))
    return [np.ascontiguousarray(moved[..., i]).reshape(size) for i in range(moved.shape[-1])]


def file_shape(entry: Facts) -> list[int]:
    """Shape of a map with the axes in the order of the file."""
    shape, leading = entry["shape"], entry.get("rows", [])
    return [shape[i] for i in leading] + [n for i, n in enumerate(shape) if i not in leading]


def channel_names(n: int) -> list[str]:
    """Names of a part's channels."""
    # A viewer shows "R, G, B" as colour and "Y" as grey; EXR sorts channels by name, hence the padded numbers.
    return {1: ["Y"], 3: ["R", "G", "B"]}.get(n, [f"c{i:04d}" for i in range(n)])


def rows_alone(entry: Facts) -> bool:
    """Whether a row of a map's image is compressed alone: where fewer rows than a block belong to the same indices."""
    leading = len(entry.get("rows", ()))
    shape = file_shape(entry)
    height, width = image_size(shape, leading)
    line = width * shape[-1] * np.dtype(entry["dtype"]).itemsize
    return leading > 0 and height // math.prod(shape[:leading]) < BLOCK and line >= LEAST_LINE


def kept_along(entry: Facts, axes: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Of the chosen indices by axis those that :func:`rows_of` leaves, ascending: axes that are rows of the image."""
    shape, leading = entry["shape"], entry.get("rows", ())
    found = {axis: np.unique(axes[axis]) for axis in leading if axis in axes}
    return {axis: kept[(kept >= 0) & (kept < shape[axis])] for axis, kept in found.items()}


def rows_of(entry: Facts, axes: Mapping[int, np.ndarray]) -> np.ndarray | None:
    """Rows of a map's image that hold the chosen indices of its axes, ascending; None for all."""
    kept = kept_along(entry, axes)
    if not kept:
        return None
    shape, leading = file_shape(entry), entry["rows"]
    height, _ = image_size(shape, len(leading))
    chosen = np.zeros(shape[: len(leading)], bool)
    chosen[np.ix_(*(kept.get(axis, np.arange(n)) for axis, n in zip(leading, chosen.shape, strict=True)))] = (
        True
    )
    return np.flatnonzero(np.repeat(chosen.ravel(), height // chosen.size))
