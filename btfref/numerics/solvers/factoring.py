"""Products of non-negative factors of the light, half, view and difference directions, fitted to tables.

Source: F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture Functions",
Eurographics 2003, eq. 3: ``f(l, v) ≈ (Σ_k P_k(l) R_k(v)) · (Σ_j Q_j(h) D_j(d))``. Arrays have the batch of tables last,
as the values of a BTF have their texels: tables are (view, light, m), factors (term, sample, m).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.numerics.sphere.halfway import half_difference
from btfref.numerics.sphere.parabolic import bilinear_stencil

#: Below this, a quotient's denominator counts as this: tables are scaled to a mean of 1, so nothing of use is so small,
#: and squares of it are still normal floats.
TINY = np.float32(1e-18)

#: Alternating steps of one term: the second singular value is at most about half the first, 2^-30 = 1e-9.
RANK_ONE_STEPS = 30

#: Share of a table's mean that is added to its values when they weigh their own errors.
WEIGHT_FLOOR = 0.1

#: Joint sweeps over several terms.
TERM_SWEEPS = 20


def sparse_operator(index: ArrayLike, weight: ArrayLike, n: int) -> Any:
    """Sparse matrix of a stencil, float32 (rows, n): row i blends the samples ``index[i]`` with ``weight[i]``."""
    from scipy import sparse

    index = np.asarray(index)
    index = index.reshape(len(index), -1)
    rows = np.repeat(np.arange(len(index)), index.shape[1])
    entries = (np.asarray(weight).reshape(-1).astype(np.float32), (rows, index.reshape(-1)))
    matrix = sparse.csr_matrix(entries, shape=(len(index), n))
    matrix.eliminate_zeros()
    return matrix


#: Factors by name: "p", "q", "r" and perhaps "d", shape (term, sample, m).
Factors = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class FactorOperators:
    """How factors are read at the measured pairs of directions.

    Attributes
    ----------
    p, r : sparse matrices, shapes (lights, n_p) and (views, n_r)
    q, d : sparse matrices, shapes (views * lights, n_q) and (…, n_d); d is None without a difference factor
    """

    p: Any
    q: Any
    r: Any
    d: Any = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of views and lights."""
        return self.r.shape[0], self.p.shape[0]

    def read(self, name: str, factor: np.ndarray) -> np.ndarray:
        """Values of a factor's terms where it is measured: (term, n, m) -> (term, rows, m)."""
        operator = getattr(self, name)
        return np.stack([operator @ term for term in factor])

    def in_out(self, factors: Factors) -> np.ndarray:
        """``Σ_k P_k(l) R_k(v)``, shape (view, light, m)."""
        p, r = self.read("p", factors["p"]), self.read("r", factors["r"])
        return np.einsum("kvm,klm->vlm", r, p)

    def half(self, factors: Factors) -> np.ndarray:
        """``Σ_j Q_j(h) D_j(d)``, shape (view, light, m)."""
        q = self.read("q", factors["q"])
        if self.d is not None:
            q = q * self.read("d", factors["d"])
        return q.sum(0).reshape(*self.shape, -1)

    def product(self, factors: Factors) -> np.ndarray:
        """The approximation of the tables, shape (view, light, m)."""
        return self.in_out(factors) * self.half(factors)

    def gathered(self, name: str, tables: Sequence[np.ndarray], factors: Factors) -> list[np.ndarray]:
        """Transpose of how ``name``'s terms are read: values of pairs times the term's partner, summed per sample.

        Parameters
        ----------
        name : str
        tables : sequence of ndarray like the tables
        factors : dict of str to ndarray

        Returns
        -------
        list of ndarray, shape (term, n, m)
            One for each of the tables.
        """
        operator, other = getattr(self, name).T, {"p": "r", "r": "p", "q": "d", "d": "q"}[name]
        if name in "pr":
            partner = self.read(other, factors[other])
            return [np.stack([operator @ self._over_partner(name, t, p) for p in partner]) for t in tables]
        flat = [t.reshape(-1, t.shape[-1]) for t in tables]
        if self.d is None:
            return [(operator @ t)[None] for t in flat]
        partner = self.read(other, factors[other])
        return [np.stack([operator @ (t * p) for p in partner]) for t in flat]

    def _over_partner(self, name: str, values: np.ndarray, term: np.ndarray) -> np.ndarray:
        """Sum over views of values times R for P, over lights of values times P for R."""
        return np.einsum("vlm,vm->lm" if name == "p" else "vlm,lm->vm", values, term)


@dataclass(frozen=True)
class PairOperators(FactorOperators):
    """The same for listed pairs of directions: all operators have a row a pair, tables are (pair, m)."""

    def in_out(self, factors: Factors) -> np.ndarray:
        """``Σ_k P_k(l) R_k(v)``, shape (pair, m)."""
        return (self.read("p", factors["p"]) * self.read("r", factors["r"])).sum(0)

    def half(self, factors: Factors) -> np.ndarray:
        """``Σ_j Q_j(h) D_j(d)``, shape (pair, m)."""
        q = self.read("q", factors["q"])
        return (q if self.d is None else q * self.read("d", factors["d"])).sum(0)

    def _over_partner(self, name: str, values: np.ndarray, term: np.ndarray) -> np.ndarray:
        return values * term


def rank_terms(data: np.ndarray, weight: np.ndarray | None, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Non-negative ``Σ_k left_k right_k`` that approximates ``data`` in the least-squares sense.

    For one term this is the first singular pair, which is non-negative for non-negative data (Perron and Frobenius),
    by alternating projections. Several terms: hierarchical alternating least squares (Cichocki et al. 2007), since
    further singular vectors have both signs, which an 8-bit map cannot hold.

    Parameters
    ----------
    data : ndarray, shape (a, b, m)
        Non-negative; zero where ``weight`` is.
    weight : ndarray, shape (a, b), or None
        0 or 1: whether a sample is known. The same for all of the batch.
    terms : int

    Returns
    -------
    left, right : ndarray, shapes (terms, a, m), (terms, b, m)
    """
    a, b, m = data.shape
    left, right = np.zeros((terms, a, m), data.dtype), np.zeros((terms, b, m), data.dtype)
    known = np.ones((a, b), data.dtype) if weight is None else weight

    def rest(k: int) -> np.ndarray:
        others = [j for j in range(terms) if j != k and left[j].any()]
        if not others:
            return data
        return data - known[..., None] * np.einsum("kam,kbm->abm", left[others], right[others])

    def improve(k: int, residual: np.ndarray) -> None:
        left[k] = np.maximum(np.einsum("abm,bm->am", residual, right[k]), 0) / np.maximum(
            known @ right[k] ** 2, TINY
        )
        right[k] = np.maximum(np.einsum("abm,am->bm", residual, left[k]), 0) / np.maximum(
            known.T @ left[k] ** 2, TINY
        )

    for k in range(terms):
        residual = rest(k)
        right[k] = np.maximum(residual, 0).mean(0)
        for _ in range(RANK_ONE_STEPS):
            improve(k, residual)
    for _ in range(TERM_SWEEPS if terms > 1 else 0):
        for k in range(terms):
            improve(k, rest(k))
    return left, right


def sample_weights(values: np.ndarray, exponent: float) -> np.ndarray:
    """Weights of samples' squared errors, ``(values + WEIGHT_FLOOR)^−exponent``.

    Parameters
    ----------
    values : ndarray
        Of tables of mean 1, or what approximates them. Weights by the approximation keep the mean: where a single
        sample's value decides its weight, the high ones count less than the low ones beside them, and the whole turns
        out too dark.
    exponent : float
        0: absolute errors, ruled by highlights; 2: relative errors, ruled by shadows.
    """
    if exponent == 0:
        return np.ones_like(values)
    return (values + np.float32(WEIGHT_FLOOR)) ** np.float32(-exponent)


@dataclass(frozen=True)
class Samples:
    """Tables that factors are to approximate.

    Attributes
    ----------
    data : ndarray, shape (view, light, m), or (pair, m) for listed pairs
    operators : FactorOperators
    share : float
        What their squared errors count.
    """

    data: np.ndarray
    operators: FactorOperators
    share: float = 1.0


def refine(
    samples: Sequence[Samples], factors: Factors, sweeps: int, exponent: float = 0.0
) -> dict[str, np.ndarray]:
    """Sweeps of multiplicative updates towards the least weighted squared error of the product itself.

    Lee and Seung 2001, with the other factors and the reading of the maps as known linear operators: each update keeps
    factors non-negative, and the error, as it is weighted in that sweep, from growing.

    Parameters
    ----------
    samples : sequence of Samples
    factors : dict of str to ndarray
        "p", "q", "r" and perhaps "d", shape (term, n, m); not changed.
    sweeps : int
    exponent : float
        Of the weights, :func:`sample_weights` of the product before each sweep.

    Returns
    -------
    dict like ``factors``
    """
    factors = dict(factors)
    # Read again only when one of their factors has changed.
    in_out = [s.operators.in_out(factors) for s in samples]
    half = [s.operators.half(factors) for s in samples]
    for _ in range(sweeps):
        weights = [
            sample_weights(a * b, exponent) * np.float32(s.share)
            for s, a, b in zip(samples, in_out, half, strict=True)
        ]
        for name in [name for name in "prqd" if name in factors]:
            numerator: Any = 0
            denominator: Any = 0
            for s, weight, a, b in zip(samples, weights, in_out, half, strict=True):
                other = weight * (b if name in "pr" else a)
                above, below = s.operators.gathered(name, (other * s.data, other * a * b), factors)
                numerator, denominator = numerator + above, denominator + below
            factors[name] = factors[name] * (numerator / np.maximum(denominator, TINY))
            if name in "pr":
                in_out = [s.operators.in_out(factors) for s in samples]
            else:
                half = [s.operators.half(factors) for s in samples]
    return factors


def map_operators(views: np.ndarray, lights: np.ndarray, n: int, with_difference: bool) -> FactorOperators:
    """How n × n parabolic maps are read at all pairs of directions.

    Parameters
    ----------
    views, lights : ndarray, shape (…, 3)
    n : int
    with_difference : bool

    Returns
    -------
    FactorOperators
    """
    h, d = half_difference(lights[None], views[:, None])
    return FactorOperators(
        **_map_reading(lights, h.reshape(-1, 3), views, d.reshape(-1, 3), n, with_difference)
    )


def pair_map_operators(
    w_view: np.ndarray, w_light: np.ndarray, n: int, with_difference: bool
) -> PairOperators:
    """How n × n parabolic maps are read at listed pairs of directions, shapes (pair, 3)."""
    h, d = half_difference(w_light, w_view)
    return PairOperators(**_map_reading(w_light, h, w_view, d, n, with_difference))


def _map_reading(
    p: np.ndarray, q: np.ndarray, r: np.ndarray, d: np.ndarray, n: int, with_difference: bool
) -> dict[str, Any]:
    directions = {"p": p, "q": q, "r": r} | ({"d": d} if with_difference else {})
    return {name: sparse_operator(*bilinear_stencil(w, n), n * n) for name, w in directions.items()}
