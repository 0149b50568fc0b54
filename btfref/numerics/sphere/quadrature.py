"""Quadrature over the upper hemisphere with the nodes that a direction set prescribes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

#: Highest degree of the polynomials in (x, y, z) that the weights integrate exactly, where positive weights allow it.
MAXIMUM_DEGREE = 6

#: Points of the dense rule that gives each sample its share of the hemisphere.
DENSE_THETA, DENSE_PHI = 96, 256


def gauss_hemisphere(n_theta: int, n_phi: int) -> tuple[np.ndarray, np.ndarray]:
    """Product rule over the upper hemisphere: Gauss–Legendre in cos θ, equal steps in φ.

    Parameters
    ----------
    n_theta, n_phi : int

    Returns
    -------
    w : ndarray, shape (n_theta * n_phi, 3)
    weight : ndarray, shape (n_theta * n_phi,)
        Solid angles in sr, sum 2π. Exact for polynomials in (x, y, z) of degree < min(2 n_theta, n_phi).
    """
    node, weight = np.polynomial.legendre.leggauss(n_theta)
    z = np.repeat((node + 1) / 2, n_phi)
    phi = np.tile((np.arange(n_phi) + 0.5) * (2 * np.pi / n_phi), n_theta)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1), np.repeat(weight / 2, n_phi) * (
        2 * np.pi / n_phi
    )


def _monomials(w: ArrayLike, degree: int) -> np.ndarray:
    """Monomials x^i y^j z^k with k ≤ 1 + parity of all degrees up to ``degree``; (n, 3) -> (m, n)."""
    x, y, z = np.asarray(w).T
    # z² = 1 − x² − y² on the sphere, so powers of z above one add nothing.
    return np.stack(
        [
            x**i * y**j * z**k
            for k in (0, 1)
            for i in range(degree + 1)
            for j in range(degree + 1)
            if i + j + k <= degree
        ]
    )


def hemisphere_weights(
    vectors: np.ndarray, stencil: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Positive quadrature weights over the hemisphere for any direction set.

    Each sample first gets the solid angle over which the interpolation gives it weight. That rule is then corrected
    by the smallest relative change which makes it exact for all polynomials in (x, y, z) up to the highest degree
    (at most 6) that leaves every weight positive: cosines, in particular, from degree 1 on.

    Parameters
    ----------
    vectors : ndarray, shape (n, 3)
    stencil : callable
        ``w -> (index, weight)`` of the set's interpolation.

    Returns
    -------
    ndarray, shape (n,)
        Weights in sr; their sum is 2π.
    """
    dense, dense_weight = gauss_hemisphere(DENSE_THETA, DENSE_PHI)
    index, share = stencil(dense)
    area = np.bincount(index.ravel(), (share * dense_weight[:, None]).ravel(), minlength=len(vectors))
    area = np.maximum(area, 1e-9 * area.mean())
    area *= 2 * np.pi / area.sum()
    for degree in range(MAXIMUM_DEGREE, 0, -1):
        basis = _monomials(vectors, degree)
        target = _monomials(dense, degree) @ dense_weight
        normal = (basis * area) @ basis.T
        multiplier = np.linalg.lstsq(normal, target - basis @ area, rcond=1e-12)[0]
        weight = area * (1 + basis.T @ multiplier)
        if weight.min() > 0.05 * area.min() and np.abs(basis @ weight - target).max() < 1e-10:
            return weight
    return area
