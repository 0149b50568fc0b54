"""How far answers are from noisy true values, with the noise of these taken out.

Squares: the truth's variance is subtracted from the mean squared difference, which leaves that of the answers without
bias (of logarithms to first order). Absolute values have no such estimate: from the truth's two halves q₁ and q₂,
sign(v − q₁) · (v − q₂) is too small in the mean and |v − q| too large, so the two enclose the error; without halves the
noise's own mean, E|ε| = √(2σ²/π), is what |v − q| may be too large by. Colours: ΔE00² is a quadratic form of small
differences, so that of the halves, over 4, is the noise's share. Intervals are normal, over the random choice of rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.colour import ciede2000, lab
from btfref.comparison.significance import interval, rmse_interval

if TYPE_CHECKING:
    from btfref.comparison.significance import Interval
    from btfref.types import Facts

#: Of all intervals.
CONFIDENCE = 0.99

#: Quantile of log(1 + B) of the true values that counts as its peak: the largest is mostly noise.
PEAK = 0.999


def accuracy(
    value: ArrayLike,
    truth: ArrayLike,
    variance: ArrayLike,
    halves: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    shared: int = 1,
) -> Facts:
    """Errors of answers to rows.

    Parameters
    ----------
    value, truth : array_like, shape (n, 3)
        Answers, and means of independent samples; 1/sr.
    variance : array_like, shape (n, 3)
        Of those means.
    halves : two of array_like, shape (n, 3), optional
        Independent means whose mean `truth` is.
    shared : int
        So many rows in turn share what is random of them: intervals are over the choice of such groups.

    Returns
    -------
    dict
        ``rmse`` and ``mae`` in 1/sr, ``nrmse``: the RMSE over the true values' root mean square, ``psnr_log`` in dB, of
        log(1 + B) with its 99.9 % quantile as the peak, ``delta_e00``: the root mean square, B times π as colours, with
        halves only, and ``bias``: mean difference over the true mean. Each is [estimate, low, high] of the 99 %
        interval. ``noise``: root mean square of the truth's standard errors, 1/sr; ``rows``.
    """
    v, q, s = (np.asarray(a, np.float64) for a in (value, truth, variance))
    n = len(v)
    difference = v - q
    square = _mean((difference**2 - s).mean(-1), shared)
    energy = max(float((q**2 - s).mean()), 1e-300)
    rmse = _root(square)
    found: Facts = {
        "rmse": rmse,
        "nrmse": [x / np.sqrt(energy) for x in rmse],
        "mae": _absolute(v, q, s, halves, shared),
        "psnr_log": _psnr(v, q, s, shared),
        "bias": [x / max(float(q.mean()), 1e-300) for x in _listed(_mean(difference.mean(-1), shared))],
        "noise": float(np.sqrt(s.mean())),
        "rows": n,
    }
    if halves is not None:
        shown, *both = (lab(np.clip(np.pi * np.asarray(a, np.float64), 0, 1)) for a in (v, *halves))
        true = lab(np.clip(np.pi * q, 0, 1))
        found["delta_e00"] = _root(_mean(ciede2000(true, shown) ** 2 - ciede2000(*both) ** 2 / 4, shared))
    return found


def _mean(values: np.ndarray, shared: int) -> Interval:
    mean, starts = values.mean(), np.arange(0, len(values), shared)
    # What groups are off together; the last one may be smaller.
    off = np.add.reduceat(values - mean, starts)
    n = len(starts)
    error = np.sqrt(n / (n - 1) * (off**2).sum()) / len(values) if n > 1 else np.inf
    return interval(mean, error, confidence=CONFIDENCE)


def _listed(found: Interval) -> list[float]:
    return [found.estimate, found.low, found.high]


def _root(square: Interval) -> list[float]:
    return _listed(rmse_interval(square))


def _absolute(
    v: np.ndarray, q: np.ndarray, s: np.ndarray, halves: tuple[ArrayLike, ArrayLike] | None, shared: int
) -> list[float]:
    """[middle, low, high] of the mean absolute error."""
    above = np.abs(v - q).mean(-1)
    if halves is None:
        below = above - np.sqrt(2 * s / np.pi).mean(-1)
    else:
        a, b = (v - np.asarray(half, np.float64) for half in halves)
        below = 0.5 * (np.sign(a) * b + np.sign(b) * a).mean(-1)
    low, high = _mean(below, shared), _mean(above, shared)
    middle = 0.5 * (max(low.estimate, 0.0) + high.estimate)
    return [middle, max(low.low, 0.0), high.high]


def _psnr(v: np.ndarray, q: np.ndarray, s: np.ndarray, shared: int) -> list[float]:
    """[estimate, low, high] of the PSNR of log(1 + B); what is negative counts as 0."""
    shown, true = np.log1p(np.maximum(v, 0)), np.log1p(np.maximum(q, 0))
    square = _mean(((shown - true) ** 2 - s / (1 + np.maximum(q, 0)) ** 2).mean(-1), shared)
    peak = max(float(np.quantile(true, PEAK)), 1e-300)
    return [
        float(20 * np.log10(peak) - 10 * np.log10(max(x, 1e-30)))
        for x in (square.estimate, square.high, square.low)
    ]
