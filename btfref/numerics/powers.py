"""Powers of cosine lobes that cannot overflow: the definition that all evaluators share.

Meseth, Müller and Klein (2004), section 5.3, report white pixels from ``(t · l)^n``, whose stored ``t`` and ``n``
overflow while rendering. Here the power is taken in the log domain and saturates at a number that every floating-point
type of interest holds, so that no stored parameter can overflow. Ports: ``mitsuba_plugins/powers.py``,
``shaders/lib/numbers/powers.glsl``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from btfref.precision import real

#: Bases below the smallest positive half count as zero, in every type: flushing of subnormal numbers then does not
#: decide the result.
FLOOR = 2.0**-24

#: Powers saturate at 2^15, exact in a half and half of its range.
LIMIT_LOG2 = 15.0

#: Exponents of two below this give 0: the smallest normal float32.
LOWEST_LOG2 = -126.0


def safe_power(base: ArrayLike, exponent: ArrayLike) -> np.ndarray:
    """``base`` to the power ``exponent``, saturated; computed in the type of the arguments.

    Parameters
    ----------
    base : array_like of float16, float32 or float64
        Any finite number; negative ones, and those below ``2^-24``, count as 0.
    exponent : array_like
        Any finite number.

    Returns
    -------
    ndarray
        In [0, 2^15]; 0 where the base counts as 0.
    """
    base, exponent = np.asarray(base), np.asarray(exponent)
    kind = np.result_type(base, exponent)
    counts = base >= kind.type(FLOOR)
    return _from_log(np.log2(np.where(counts, base, 1)), exponent, counts, kind)


def lobe_power(t: ArrayLike, light: ArrayLike, n: ArrayLike) -> np.ndarray:
    """``(t · l)^n`` of a lobe as the paper stores it, ``t`` of any length; eq. 1.

    The axis is scaled by its largest component first, so that neither the product nor the power can overflow.

    Parameters
    ----------
    t, light : array_like, shape (..., 3)
        Any finite vectors; ``light`` a unit vector.
    n : array_like, shape (...)

    Returns
    -------
    ndarray, shape (...)
        In [0, 2^15], in the type of the arguments.
    """
    t, light, n = np.asarray(t), np.asarray(light), np.asarray(n)
    kind = np.result_type(t, light, n)
    scale = np.abs(t).max(-1)
    counts = scale >= kind.type(FLOOR)
    scale = np.where(counts, scale, kind.type(1))
    axis = np.where(counts[..., None], t, 0) / scale[..., None]
    cosine = (axis * light).sum(-1, dtype=kind)
    # The logarithm of the product is the sum of two, each of which is finite.
    counts &= cosine >= kind.type(FLOOR)
    log = np.log2(scale) + np.log2(np.where(counts, cosine, kind.type(1)))
    return _from_log(log, n, counts, kind)


def unit_lobe(axis: ArrayLike, light: ArrayLike, n: ArrayLike) -> np.ndarray:
    """``(axis · l)^n`` of unit vectors, from the square of their distance.

    Near the axis ``axis · l = 1 − |axis − l|² / 2`` keeps the digits that the product loses and a large exponent
    would multiply.

    Parameters
    ----------
    axis, light : array_like, shape (..., 3)
        Unit vectors.
    n : array_like, shape (...)

    Returns
    -------
    ndarray of float64, shape (...)
        In [0, 1]; 0 where the cosine is not positive.
    """
    d = real(axis) - real(light)
    h = 0.5 * np.einsum("...i,...i->...", d, d)
    counts = 1 - h >= FLOOR
    log = np.log1p(-np.where(counts, h, 0)) / math.log(2)
    return _from_log(log, real(n), counts, log.dtype)


def _from_log(log: np.ndarray, exponent: np.ndarray, counts: np.ndarray, kind: np.dtype) -> np.ndarray:
    # An infinite product is as good as any other beyond the limits.
    with np.errstate(over="ignore"):
        product = np.asarray(log * exponent, kind)
    product = np.clip(product, kind.type(LOWEST_LOG2), kind.type(LIMIT_LOG2))
    return np.where(counts & (product > LOWEST_LOG2), np.exp2(product), kind.type(0))
