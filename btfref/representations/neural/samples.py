"""What steps of the fit see: bands of rows, windows of neighbouring texels in them, and the values there.

A band is what is held of the BTF at a time, so that it need not be in memory. Each pass goes through all bands; every
other one cuts them half a band back, so that rows at an end are in the middle the next time.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from btfref.representations.file.schema import LARGEST
from btfref.representations.lookup import refuse_not_finite
from btfref.representations.neural import network

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.sampling.blocks import BTFBlocks

#: Texels a side of a step, at most.
SIDE = 8

#: Texels of a band, at most; of a texture that is so wide that two rows have more, two rows.
TEXELS = 8192

#: Bytes per value of a band: itself as it is read, and as two parts of the texture are put together.
ROW_BYTES = 4.0


@dataclass(frozen=True)
class Band:
    """Rows ``first … last − 1``, wrapped; ``whole``: those of the texture, so that its ends meet."""

    first: int
    last: int
    whole: bool


@dataclass(frozen=True)
class Samples:
    """A BTF, and what is known of its pairs of directions."""

    btf: BTFBlocks
    codes: np.ndarray
    cosine: np.ndarray
    scale: np.ndarray
    bilinear: bool
    kept: dict[Band, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, btf: BTFBlocks, bilinear: bool) -> Samples:
        """What steps read of a BTF; looks at all values once.

        Parameters
        ----------
        btf : BTFBlocks
        bilinear : bool
            Whether lookups interpolate between texels.

        Raises
        ------
        InputError
            For values that are not finite.
        """
        views, lights = btf.views.vectors, btf.lights.vectors
        pairs = len(views), len(lights)
        cosine = float(lights[:, 2].mean())
        result = cls(
            btf,
            network.code(np.tile(lights, (pairs[0], 1)), np.repeat(views, pairs[1], 0)).astype(np.float32),
            np.tile(lights[:, 2], pairs[0]).astype(np.float32),
            np.zeros(3, np.float32),
            bilinear,
        )
        total = np.zeros(3)
        for band in result.bands:
            for values in result.read(band).reshape(*pairs, band.last - band.first, -1, 3):
                refuse_not_finite(values, btf)
                total += np.maximum(values, 0).sum((0, 1, 2), dtype=float)
        mean = total / (pairs[0] * pairs[1] * btf.texels[0] * btf.texels[1])
        result.scale[:] = np.minimum(mean / max(cosine, 1e-3), LARGEST)
        return result

    @property
    def bands(self) -> list[Band]:
        """All rows, in bands of about the same height."""
        rows, columns = self.btf.texels
        # Two rows at least: what is interpolated lies between them.
        count = min(-(-rows // max(2, TEXELS // columns)), max(1, rows // 2))
        edges = [rows * k // count for k in range(count + 1)]
        return [Band(first, last, count == 1) for first, last in itertools.pairwise(edges)]

    def visits(self, steps: int, passes: float) -> Iterator[tuple[Band, int]]:
        """The bands in the order in which they are read, each with the step that ends its visit.

        Parameters
        ----------
        steps : int
            Of all visits.
        passes : float
            How many times a sample is seen.
        """
        bands = self.bands
        half = (bands[0].last - bands[0].first) // 2 if len(bands) > 1 else 0
        rounds = max(2, round(passes)) if len(bands) > 1 else 1
        for number in range(rounds):
            back = half * (number % 2)
            for k, band in enumerate(bands):
                done = number + (k + 1) / len(bands)
                yield Band(band.first - back, band.last - back, band.whole), round(steps * done / rounds)

    def read(self, band: Band) -> np.ndarray:
        """Values of a band, shape (pairs of directions, rows, columns, 3)."""
        if band in self.kept:
            return self.kept[band]
        rows = self.btf.texels[0]
        if band.first < 0:
            parts = self.btf.rows(band.first + rows, rows), self.btf.rows(0, band.last)
            values = np.concatenate(parts, 2)
        else:
            values = self.btf.rows(band.first, band.last)
        values = values.reshape(-1, *values.shape[2:])
        if self.btf.claim(values.nbytes):
            self.kept[band] = values
        return values


@dataclass(frozen=True)
class Window:
    """Neighbouring texels, wrapped, and how far they are moved.

    Attributes
    ----------
    rows, columns : ndarray of int
        One more than there are lookups a side.
    way : (float, float)
        Down and to the right, parts of a texel.
    within : ndarray of int
        The rows, counted from the first of their band.
    """

    rows: np.ndarray
    columns: np.ndarray
    way: tuple[float, float]
    within: np.ndarray

    def corners(self) -> list[tuple[slice, slice, np.float32]]:
        """The four texels around each lookup: where they are among the window's, and their weight."""
        lower, upper = slice(None, -1), slice(1, None)
        y, x = self.way
        return [
            (row, column, np.float32(a * b))
            for row, a in ((lower, 1 - y), (upper, y))
            for column, b in ((lower, 1 - x), (upper, x))
            if a * b > 0
        ]

    def moved(self, items: np.ndarray) -> np.ndarray:
        """Interpolate the window's items, shape (rows, columns, …) -> (rows − 1, columns − 1, …)."""
        parts = [items[row, column] * weight for row, column, weight in self.corners()]
        return sum(parts[1:], parts[0])

    def targets(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """B of the lookups under pairs of directions, shape (texels, pairs, 3).

        Parameters
        ----------
        values : ndarray
            Of the band; see :meth:`Samples.read`.
        chosen : ndarray of int
            The pairs.
        """
        found = values[chosen[:, None, None], self.within[:, None], self.columns]
        moved = self.moved(np.moveaxis(found, 0, 2).astype(np.float32))
        return np.maximum(moved, 0).reshape(-1, len(chosen), 3)

    def gathered(
        self, slopes: np.ndarray, texels: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The transpose of :meth:`moved`: the items' slopes, and their rows and columns, each of them once."""
        rows, columns = self.rows, self.columns
        result = np.zeros((len(rows), len(columns), slopes.shape[-1]), np.float32)
        for row, column, weight in self.corners():
            result[row, column] += weight * slopes
        # A window as large as the texture meets its own first row and column again.
        if len(rows) > texels[0]:
            result[0] += result[-1]
            result, rows = result[:-1], rows[:-1]
        if len(columns) > texels[1]:
            result[:, 0] += result[:, -1]
            result, columns = result[:, :-1], columns[:-1]
        return result, rows, columns


def a_window(rng: np.random.Generator, texels: tuple[int, int], bilinear: bool, band: Band) -> Window:
    """A window anywhere in a band.

    Parameters
    ----------
    rng : numpy.random.Generator
    texels : (int, int)
        Rows and columns of the texture.
    bilinear : bool
    band : Band
    """
    height = band.last - band.first
    if band.whole:
        within = (int(rng.integers(height)) + np.arange(min(SIDE, height) + 1)) % height
    else:
        count = min(SIDE, height - 1)
        within = int(rng.integers(height - count)) + np.arange(count + 1)
    columns = (int(rng.integers(texels[1])) + np.arange(min(SIDE, texels[1]) + 1)) % texels[1]
    down, right = rng.random(2)
    way = (float(down), float(right)) if bilinear else (0.0, 0.0)
    return Window((band.first + within) % texels[0], columns, way, within)
