"""Products of non-negative factors of the light, half, view and difference directions, fitted to tables.

Source: F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture Functions",
Eurographics 2003, eq. 3: ``f(l, v) ≈ (Σ_k P_k(l) R_k(v)) · (Σ_j Q_j(h) D_j(d))``. Arrays have the batch of tables last,
as the values of a BTF have their texels: tables are (view, light, m), factors (term, sample, m).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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


def sample_weights(data: np.ndarray, exponent: float) -> np.ndarray:
    """Weights of samples' squared errors, ``(data + WEIGHT_FLOOR)^−exponent``.

    Parameters
    ----------
    data : ndarray
        Tables of mean 1.
    exponent : float
        0: absolute errors, ruled by highlights; 2: relative errors, ruled by shadows.
    """
    return (data + np.float32(WEIGHT_FLOOR)) ** np.float32(-exponent)


def refine(
    data: np.ndarray,
    factors: Factors,
    operators: FactorOperators,
    sweeps: int,
    weight: np.ndarray | float = 1,
) -> dict[str, np.ndarray]:
    """Sweeps of multiplicative updates towards the least weighted squared error of the product itself.

    Lee and Seung 2001, with the other factors and the reading of the maps as known linear operators: each update keeps
    factors non-negative and the error from growing.

    Parameters
    ----------
    data : ndarray, shape (view, light, m)
    factors : dict of str to ndarray
        "p", "q", "r" and perhaps "d", shape (term, n, m); not changed.
    operators : FactorOperators
    sweeps : int
    weight : ndarray like ``data``, or 1

    Returns
    -------
    dict like ``factors``
    """
    factors = dict(factors)

    def update(name: str, numerator: Iterable[np.ndarray], denominator: Iterable[np.ndarray]) -> None:
        operator = getattr(operators, name).T
        factors[name] = factors[name] * np.stack(
            [
                (operator @ n) / np.maximum(operator @ d, TINY)
                for n, d in zip(numerator, denominator, strict=True)
            ]
        )

    data = weight * data
    in_out = operators.in_out(factors)
    for _ in range(sweeps):
        half = operators.half(factors)
        x, y = data * half, weight * half * half
        r = operators.read("r", factors["r"])
        update("p", np.einsum("vlm,kvm->klm", x, r), np.einsum("vlm,kvm->klm", y * in_out, r))
        in_out = operators.in_out(factors)
        p = operators.read("p", factors["p"])
        update("r", np.einsum("vlm,klm->kvm", x, p), np.einsum("vlm,klm->kvm", y * in_out, p))
        in_out = operators.in_out(factors)
        x, y = data * in_out, weight * in_out * in_out
        names = "q" if operators.d is None else "qd"
        for name, other in zip(names, names[::-1], strict=True):
            a, b = x.reshape(-1, x.shape[-1]), (y * operators.half(factors)).reshape(-1, x.shape[-1])
            if operators.d is None:
                update(name, [a], [b])
            else:
                values = operators.read(other, factors[other])
                update(name, a * values, b * values)
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
    directions = {"p": lights, "q": h.reshape(-1, 3), "r": views, "d": d.reshape(-1, 3)}
    if not with_difference:
        del directions["d"]
    return FactorOperators(
        **{name: sparse_operator(*bilinear_stencil(w, n), n * n) for name, w in directions.items()}
    )
