"""Real spherical harmonics: values, projection, rotation, windows.

Orthonormal on the sphere, without the Condon–Shortley phase; coefficient ``l (l + 1) + m`` of band l has cos mφ for
m > 0 and sin |m|φ for m < 0. "Order n" are the n bands l = 0 … n − 1, n² coefficients.

Sources: recurrences of fully normalized Legendre functions after S. A. Holmes, W. E. Featherstone, "A unified approach
to the Clenshaw summation and the recursive computation of very high degree and order normalised associated Legendre
functions", Journal of Geodesy 76, 2002, eq. 11; rotations about x by a constant matrix as in R. Green, "Spherical
Harmonic Lighting: The Gritty Details", GDC 2003 (which has it for a few bands only); windows as in P.-P. Sloan, "Stupid
Spherical Harmonics (SH) Tricks", GDC 2008.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError

#: Windows by name; each takes l/n in [0, 1).
WINDOWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": np.ones_like,
    "hanning": lambda x: 0.5 * (1 + np.cos(np.pi * x)),
    "lanczos": np.sinc,
}


def checked_order(order: object) -> int:
    """``order`` as an int of at least 1.

    Raises
    ------
    InputError
    """
    if isinstance(order, bool) or not isinstance(order, int | np.integer) or not 1 <= order <= 64:
        raise InputError("no such order of spherical harmonics", field="order", got=order, expected="1 … 64")
    return int(order)


def bands(order: int) -> np.ndarray:
    """Band l of every coefficient, shape (order²,)."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


def values(w: ArrayLike, order: int) -> np.ndarray:
    """The harmonics at directions.

    Parameters
    ----------
    w : array_like, shape (..., 3)
        Unit vectors.
    order : int

    Returns
    -------
    ndarray of float64, shape (..., order²)
    """
    order = checked_order(order)
    x, y, z = np.moveaxis(np.asarray(w, float), -1, 0)
    result = np.zeros((*x.shape, order * order))
    cosine, sine = np.ones_like(x), np.zeros_like(x)
    first = np.sqrt(0.25 / np.pi)
    for m in range(order):
        if m:
            # sin^m θ times cos mφ and sin mφ; what is left of the Legendre function is a polynomial of z.
            cosine, sine = x * cosine - y * sine, y * cosine + x * sine
            first *= np.sqrt((2 * m + 1) / (2 * m))
        before, now = np.zeros_like(z), np.full_like(z, first)
        for band in range(m, order):
            at = band * (band + 1)
            if m == 0:
                result[..., at] = now
            else:
                result[..., at + m] = np.sqrt(2) * now * cosine
                result[..., at - m] = np.sqrt(2) * now * sine
            up = band + 1
            scale = np.sqrt((4 * up * up - 1) / (up * up - m * m))
            back = np.sqrt((band * band - m * m) / (4 * band * band - 1)) if band > m else 0.0
            before, now = now, scale * (z * now - back * before)
    return result


def project(samples: ArrayLike, w: ArrayLike, weights: ArrayLike, order: int) -> np.ndarray:
    """Coefficients of a function that is known at the nodes of a quadrature.

    Parameters
    ----------
    samples : array_like, shape (n, ...)
    w : array_like, shape (n, 3)
        Unit vectors.
    weights : array_like, shape (n,)
        Solid angles in sr; those of :attr:`btfref.numerics.sphere.directions.DirectionSet.quadrature_weights`
        integrate over the upper hemisphere.
    order : int

    Returns
    -------
    ndarray of float64, shape (order², ...)
    """
    samples = np.asarray(samples, float)
    weighted = values(w, order) * np.asarray(weights, float)[:, None]
    return np.tensordot(weighted, samples, (0, 0))


def sphere_rule(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature of the sphere that is exact for products of two harmonics of ``order``.

    Returns
    -------
    w : ndarray, shape (n, 3)
    weight : ndarray, shape (n,)
        Sum 4π.
    """
    node, weight = np.polynomial.legendre.leggauss(order + 1)
    n_phi = 2 * order + 1
    phi = np.tile(np.arange(n_phi) * (2 * np.pi / n_phi), len(node))
    z = np.repeat(node, n_phi)
    r = np.sqrt(1 - z * z)
    w = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    return w, np.repeat(weight, n_phi) * (2 * np.pi / n_phi)


@cache
def quarter_turn(order: int) -> np.ndarray:
    """What a quarter turn about x makes of the harmonics: ``y_j(Rx(90°) w) = Σ_i X_ij y_i(w)``; (order², order²)."""
    w, weight = sphere_rule(order)
    x, y, z = w.T
    own = values(w, order)
    matrix = (own * weight[:, None]).T @ values(np.stack([x, -z, y], -1), order)
    # Bands do not mix, and sums of some hundred products leave 1e-15 where there is nothing.
    matrix[bands(order)[:, None] != bands(order)] = 0
    # The nearest orthogonal matrix takes the last rounding out.
    left, _, right = np.linalg.svd(matrix)
    matrix = left @ right
    matrix[np.abs(matrix) < 1e-14] = 0
    matrix.setflags(write=False)
    return matrix


def euler(to_world: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines and sines of (α, β, γ) with ``R = Rz(α) Ry(β) Rz(γ)``, and whether R mirrors.

    Parameters
    ----------
    to_world : array_like, shape (..., 3, 3)
        Orthogonal. A mirroring one is taken as ``R · diag(1, 1, −1)``.

    Returns
    -------
    cosine, sine : ndarray, shape (..., 3)
        On the unit circle whatever R rounds to; where the axis does not turn, α is 0 and γ has all of the angle.
    mirrored : ndarray of bool, shape (...)
    """
    r = np.array(to_world, float)
    mirrored = np.linalg.det(r) < 0
    r[..., 2] *= np.where(mirrored, -1.0, 1.0)[..., None]
    a = _unit(r[..., 0, 2], r[..., 1, 2])
    b = _unit(r[..., 2, 2], np.hypot(r[..., 0, 2], r[..., 1, 2]))
    # The y row of Rz(−α) R is that of Ry(β) Rz(γ), which has no β: as good at the poles as elsewhere.
    c = _unit(a[0] * r[..., 1, 1] - a[1] * r[..., 0, 1], a[0] * r[..., 1, 0] - a[1] * r[..., 0, 0])
    cosine, sine = (np.stack([a[k], b[k], c[k]], -1) for k in range(2))
    return cosine, sine, mirrored


def _unit(cosine: np.ndarray, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.hypot(cosine, sine)
    there = length > 0
    safe = np.where(there, length, 1)
    return np.where(there, cosine / safe, 1.0), np.where(there, sine / safe, 0.0)


def _about_z(coefficients: np.ndarray, cosine: np.ndarray, sine: np.ndarray, order: int) -> np.ndarray:
    """Coefficients of L(Rz(α) w) from those of L; (..., order², k) with (...) angles."""
    result = coefficients.copy()
    c, s = np.ones_like(cosine), np.zeros_like(sine)
    for m in range(1, order):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        band = np.arange(m, order)
        plus, minus = band * (band + 1) + m, band * (band + 1) - m
        a, b = coefficients[..., plus, :], coefficients[..., minus, :]
        cc, ss = c[..., None, None], s[..., None, None]
        result[..., plus, :] = cc * a + ss * b
        result[..., minus, :] = cc * b - ss * a
    return result


def mirror_signs(order: int) -> np.ndarray:
    """Sign of every harmonic under z → −z: (−1)^(l + m), shape (order²,)."""
    band = bands(order)
    m = np.arange(order * order) - band * (band + 1)
    return np.where((band + m) % 2 == 0, 1.0, -1.0)


def rotate(coefficients: ArrayLike, to_world: ArrayLike, order: int) -> np.ndarray:
    """Coefficients of ``w ↦ L(R w)`` from those of L.

    Parameters
    ----------
    coefficients : array_like, shape (order²,) or (order², k), or with leading shape (...) of the rotations
    to_world : array_like, shape (..., 3, 3)
        Orthogonal: rotations, or rotations that mirror.
    order : int

    Returns
    -------
    ndarray of float64, shape (..., order²) or (..., order², k)
    """
    order = checked_order(order)
    coefficients, to_world = np.asarray(coefficients, float), np.asarray(to_world, float)
    single = coefficients.ndim == 1
    if single:
        coefficients = coefficients[:, None]
    shape = to_world.shape[:-2]
    a = np.broadcast_to(coefficients, (*shape, *coefficients.shape[-2:]))
    cosine, sine, mirrored = euler(to_world)
    turn = quarter_turn(order)
    a = _about_z(a, cosine[..., 0], sine[..., 0], order)
    a = _about_z(turn.T @ a, cosine[..., 1], sine[..., 1], order)
    a = _about_z(turn @ a, cosine[..., 2], sine[..., 2], order)
    signs = np.where(mirrored[..., None], mirror_signs(order), 1.0)
    a = a * signs[..., None]
    return a[..., 0] if single else a


def rotation_matrix(to_world: ArrayLike, order: int) -> np.ndarray:
    """Matrix of :func:`rotate`, shape (..., order², order²): block diagonal, orthogonal."""
    return rotate(np.eye(checked_order(order) ** 2), to_world, order)


def window(name: str | None, order: int) -> np.ndarray:
    """Factor of every coefficient.

    Parameters
    ----------
    name : {"none", "hanning", "lanczos"} or None
    order : int

    Returns
    -------
    ndarray of float64, shape (order²,)

    Raises
    ------
    InputError
        For an unknown name.
    """
    name = name or "none"
    if name not in WINDOWS:
        raise InputError("unknown window", field="window", got=repr(name), expected=", ".join(WINDOWS))
    return WINDOWS[name](bands(checked_order(order)) / order)


def ringing(coefficients: ArrayLike, order: int) -> float:
    """Depth of the negative lobes of a function that should have none, relative to its largest value.

    Parameters
    ----------
    coefficients : array_like, shape (order²,) or (order², k)
    order : int

    Returns
    -------
    float
        0 where the sum of the harmonics is nowhere negative (on a grid of four samples a wavelength).
    """
    w, _ = sphere_rule(max(16, 4 * order))
    sampled = values(w, order) @ np.asarray(coefficients, float)
    peak = np.abs(sampled).max()
    return float(max(0.0, -sampled.min() / peak)) if peak > 0 else 0.0
