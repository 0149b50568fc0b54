"""What a Laplacian level's images leave of what coarser levels say of them, and what fits add up of that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.solvers.streaming import ROWS, gram_products
from btfref.numerics.solvers.threads import product
from btfref.representations.laplacian.images import expanded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from btfref.representations.laplacian.images import Images


@dataclass(frozen=True)
class Model:
    """Images as tables of pairs times weights of texels, [channel] ((pairs, m), (m, texels)), float32."""

    tables: list[tuple[np.ndarray, np.ndarray]]

    def rests(self, part: slice, images: Images) -> list[np.ndarray]:
        """Differences of a level's images, the first, to the model, [channel] (pairs, texels)."""
        return [
            images[0][:, channel] - product(basis[part], weights, rows=ROWS)
            for channel, (basis, weights) in enumerate(self.tables)
        ]


@dataclass(frozen=True)
class Exact:
    """Differences of a level to the exact coarser ones.

    Attributes
    ----------
    average : ndarray, shape (pairs, channel)
        Mean of the coarsest level.
    shapes : list of tuple
        Of the level and all coarser ones.
    filter_type : {"bilinear", "nearest"}
    """

    average: np.ndarray
    shapes: list[tuple[int, int]]
    filter_type: str

    def rests(self, part: slice, images: Images) -> list[np.ndarray]:
        """Differences of the level's images, the first, to what the following say, [channel] (pairs, texels)."""
        rests: list[tuple[int, np.ndarray]] = []
        for j in range(len(self.shapes) - 1, -1, -1):
            rest = images[j] - self.average[part, :, None]
            for i, coarser in rests:
                rest -= expanded(coarser, self.shapes[i], self.shapes[j], self.filter_type)
            rests.append((j, rest))
        return [np.ascontiguousarray(rests[-1][1][:, c]) for c in range(3)]


def rest_products(
    task: tuple[Model | Exact, list[np.ndarray], bool], part: slice, images: Images
) -> tuple[list[tuple[np.ndarray, np.ndarray] | None], np.ndarray | None]:
    """What a block's differences add to each channel's pass, and their squares by channel where asked for."""
    model, bases, with_squares = task
    rests = model.rests(part, images)
    products = [
        gram_products(basis, rest) if basis.shape[1] else None
        for basis, rest in zip(bases, rests, strict=True)
    ]
    if not with_squares:
        return products, None
    return products, np.array([np.einsum("ij,ij->i", r, r).sum(dtype=float) for r in rests])


def rest_gram(model: Model, part: slice, images: Images) -> np.ndarray:
    """Inner products of a block's differences to the model."""
    return gram(model.rests(part, images))


def gram(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Inner products of the channels' arrays, shape (3, 3), in float64 by rows."""
    return np.array([[np.einsum("ij,ij->i", a, b).sum(dtype=float) for b in arrays] for a in arrays])
