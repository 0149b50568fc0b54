"""Inner products of the data with the terms that a factorization stores: what the scales of texels follow from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.solvers.factoring import map_operators, sample_weights
from btfref.representations.factored.definition import (
    FACTORS,
    batch_last,
    decoded,
    index_slots,
    texel_parts,
)
from btfref.representations.factored.fit import unit_tables
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.numerics.solvers.factoring import FactorOperators
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts

#: Inner products of the data with itself (texel, 3), with the terms (texel, 3, term), of terms (texel, 3, term, term).
Moments = tuple[np.ndarray, np.ndarray, np.ndarray]


def moments_of(
    btf: BTFBlocks,
    arrays: dict[str, np.ndarray],
    constants: Facts,
    scale: np.ndarray,
    half_scale: np.ndarray,
    exponent: float,
) -> tuple[Moments, Moments]:
    """Inner products of data and unscaled terms, per texel and channel: plain ones, and weighted by the scaled terms.

    Returns
    -------
    moments, weighted : Moments
    """
    operators = map_operators(
        btf.views.vectors, btf.lights.vectors, arrays["factor_p"].shape[1], "factor_d" in arrays
    )
    power = constants["map_power"]
    if "half_scale" in arrays:
        half_scale = decoded(arrays["half_scale"], power).reshape(half_scale.shape)
    index = arrays["index"].reshape(-1, arrays["index"].shape[-1])
    books = {name: arrays[f"factor_{name}"] for name in FACTORS if f"factor_{name}" in arrays}
    task = _Terms(operators, books, index, index_slots(constants), power, scale, half_scale, exponent)
    parts = list(over_blocks(btf, _moments_of_part, task, texel_parts(len(index))))
    plain, weighted = (_joined([part[i] for part in parts], len(index)) for i in range(2))
    return plain, weighted


@dataclass(frozen=True)
class _Terms:
    """What the terms of texels are made of; see :func:`moments_of`."""

    operators: FactorOperators
    books: dict[str, np.ndarray]
    index: np.ndarray
    slots: dict[str, slice]
    power: int
    scale: np.ndarray
    half_scale: np.ndarray
    exponent: float


def _moments_of_part(btf: BTFBlocks, task: _Terms, texels: np.ndarray) -> Iterator[tuple[Moments, Moments]]:
    """Plain and weighted moments of some texels."""
    data, mean = unit_tables(btf, texels)
    operators, factors = task.operators, {}
    for name, book in task.books.items():
        m = decoded(book[task.index[texels, task.slots[name]]], task.power, np.float32)
        if name == "q":
            m = m * task.half_scale[texels][:, :, None, None].astype(np.float32)
        factors[name] = batch_last(m)
    half = operators.half(factors)
    p, r = operators.read("p", factors["p"]), operators.read("r", factors["r"])
    terms = np.stack([half * a[:, None] * b for a, b in zip(r, p, strict=True)])
    amount = np.moveaxis(task.scale[texels], 0, 1).reshape(len(terms), -1) / np.where(mean > 0, mean, 1)
    model = np.einsum("kvlm,km->vlm", terms, amount.astype(np.float32))
    size = mean.astype(float)

    def moments(weight: np.ndarray | int) -> Moments:
        heavy = weight * terms
        return (
            np.einsum("vlm,vlm->m", weight * data, data) * size**2,
            np.einsum("vlm,kvlm->mk", data, heavy) * size[:, None],
            np.einsum("jvlm,kvlm->mjk", terms, heavy).astype(float),
        )

    yield moments(1), moments(sample_weights(model, task.exponent))


def _joined(parts: list[Moments], n_texels: int) -> Moments:
    """Moments of all texels from those of their parts."""
    energy, product, gram = (
        np.concatenate(m).reshape(n_texels, 3, *m[0].shape[1:]) for m in zip(*parts, strict=True)
    )
    return energy, product, gram
