"""What both factorizations do with a sampled BTF: tables of some texels, their maps, and the error of those."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from btfref.errors import InputError
from btfref.representations.factored.definition import texel_parts
from btfref.representations.lookup import positive_integer, refuse_not_finite
from btfref.sampling.blocks import texel_values
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: Called with what begins.
Step = Callable[[str], object]

#: What is made of some texels; see :class:`FactorizesPart`.
PartFactors = tuple[dict[str, np.ndarray], dict[str, np.ndarray], Any]


class FactorizesPart(Protocol):
    """Factorizes the tables of some texels: an object of a module's class, so that workers can be given it."""

    def __call__(self, index: int, data: np.ndarray) -> PartFactors:
        """Maps, approximations and facts of a part.

        Parameters
        ----------
        index : int
            Of the part.
        data : ndarray
            Of :func:`unit_tables`.

        Returns
        -------
        maps : dict of str to ndarray, shape (term, n², m)
            Of tables of mean 1.
        models : dict of str to ndarray
            Approximations of these tables by name.
        facts : object
            What else is measured.
        """


@dataclass(frozen=True)
class Factors:
    """Factors of every texel, before they are normalised, clustered and stored.

    Attributes
    ----------
    method : str
    maps : dict of str to ndarray of float32
        "p", "q", "r" and perhaps "d", shape (texel, term, n, n, 3), non-negative; P holds the scale.
    exponent : float
        Of the weights of errors; see :func:`btfref.numerics.solvers.factoring.sample_weights`.
    parameters : dict
        Of the factorization, for the file.
    facts : dict
        What the factorization measured, for ``meta["fit"]``.
    """

    method: str
    maps: dict[str, np.ndarray]
    exponent: float
    parameters: Facts
    facts: Facts


class Steps:
    """Counts the steps of a fit for ``progress(done, total, label)``, which may be None."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self, label: str) -> None:
        """One more step begins."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total, label)


def checked_ranges(**ranges: tuple[float, float, float]) -> None:
    """Raise InputError for a value outside its range; ``name=(value, low, high)``, both ends included."""
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise InputError(
                "a parameter is out of range", field=name, got=value, expected=f"{low:g} to {high:g}"
            )


def checked_map_size(map_size: object) -> int:
    """``map_size`` as an int; one texel is no map."""
    size = positive_integer("map_size", map_size)
    if size < 2:
        raise InputError("a parameter is out of range", field="map_size", got=map_size, expected="at least 2")
    return size


def factorized(
    btf: BTFBlocks, counts: Mapping[str, int], map_size: int, step: Step, factorize: FactorizesPart
) -> tuple[dict[str, np.ndarray], Facts, list[Any]]:
    """Factorize all texels, part by part.

    Parameters
    ----------
    btf : BTFBlocks
    counts : dict of str to int
        Terms of each factor.
    map_size : int
    step : callable
        ``step(label)``, called for each of :func:`~btfref.representations.factored.definition.texel_parts`.
    factorize : FactorizesPart
        P gets the mean here.

    Returns
    -------
    maps : dict of str to ndarray of float32, shape (texel, term, n, n, 3)
    errors : dict of str to float
        Relative squared errors of the approximations.
    facts : list
        What ``factorize`` measured of each part.
    """
    n_texels = int(np.prod(btf.texels))
    maps = {
        name: np.zeros((n_texels, terms, map_size, map_size, 3), np.float32) for name, terms in counts.items()
    }
    energy = 0.0
    squared: dict[str, float] = {}
    facts = []
    parts = texel_parts(n_texels)
    made = over_blocks(btf, _factorized_part, factorize, list(enumerate(parts)))
    for texels in parts:
        step("factorization")
        found, own_energy, errors, measured = next(made)
        energy += own_energy
        for name, error in errors.items():
            squared[name] = squared.get(name, 0.0) + error
        for name, values in found.items():
            values = values.reshape(counts[name], map_size, map_size, len(texels), 3)
            maps[name][texels] = np.moveaxis(values, 3, 0)
        facts.append(measured)
    return maps, {name: value / energy if energy > 0 else 0.0 for name, value in squared.items()}, facts


def _factorized_part(
    btf: BTFBlocks, factorize: FactorizesPart, part: tuple[int, np.ndarray]
) -> Iterator[tuple[dict[str, np.ndarray], float, dict[str, float], Any]]:
    """Maps of a part, its energy, squared errors of the approximations, and what else was measured."""
    index, texels = part
    data, mean = unit_tables(btf, texels)
    found, models, facts = factorize(index, data)
    errors = {
        name: float((((model - data) * mean).astype(float) ** 2).sum()) for name, model in models.items()
    }
    found["p"] = found["p"] * mean
    yield found, float(((data * mean).astype(float) ** 2).sum()), errors, facts


def unit_tables(btf: BTFBlocks, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tables of some texels with a mean of 1, and their means.

    Parameters
    ----------
    btf : BTFBlocks
    texels : ndarray of int, shape (k,)
        Flat indices.

    Returns
    -------
    tables : ndarray of float32, shape (view, light, k * 3)
        Negative values (noise of a measurement) count as 0; a black texel stays 0.
    mean : ndarray of float32, shape (k * 3,)

    Raises
    ------
    InputError
        For a value that is not finite.
    """
    values = texel_values(btf, texels)
    tables = values.astype(np.float32).reshape(*values.shape[:2], -1)
    refuse_not_finite(tables, btf)
    tables = np.maximum(tables, 0)
    mean = tables.mean((0, 1))
    return tables / np.where(mean > 0, mean, 1), mean
