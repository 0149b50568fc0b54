"""Errors of linear radiance between a test and a reference, in float64.

Every function takes the test first and the reference second, arrays of one shape, and averages over all
entries.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.numerics.colour import encode_srgb

#: Added to the squared reference in relMSE: (test - reference)² / (reference² + ε).
RELMSE_EPSILON = 1e-2
#: Added to the denominator of SMAPE, so that two black pixels differ by 0.
SMAPE_EPSILON = 1e-6
#: The relative error's denominator is at least this times the largest reference value.
FLOOR = 1e-3

#: Name → percentile of the relative error.
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def paired(test: ArrayLike, reference: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Both arrays as float64 after the check that they have one shape and are not empty.

    Raises
    ------
    InputError
        Different shapes, or nothing to compare.
    """
    test, reference = np.asarray(test), np.asarray(reference)
    if test.shape != reference.shape:
        raise InputError(
            "test and reference differ in shape", field="shape", got=test.shape, expected=reference.shape
        )
    if test.size == 0:
        raise InputError("nothing to compare", field="shape", got=test.shape)
    return test.astype(np.float64), reference.astype(np.float64)


def bias(test: ArrayLike, reference: ArrayLike) -> float:
    """Mean of test - reference, in the unit of the input."""
    t, r = paired(test, reference)
    return float(np.mean(t - r))


def mae(test: ArrayLike, reference: ArrayLike) -> float:
    """Mean absolute error, in the unit of the input."""
    t, r = paired(test, reference)
    return float(np.mean(np.abs(t - r)))


def rmse(test: ArrayLike, reference: ArrayLike) -> float:
    """Root of the mean squared error, in the unit of the input."""
    t, r = paired(test, reference)
    return float(np.sqrt(np.mean((t - r) ** 2)))


def nrmse(test: ArrayLike, reference: ArrayLike) -> float:
    """RMSE divided by the mean absolute reference; against black, infinite for an error and 0 for none."""
    return _ratio(rmse(test, reference), float(np.mean(np.abs(paired(test, reference)[1]))))


def relative_l2(test: ArrayLike, reference: ArrayLike) -> float:
    """RMSE divided by the root mean square of the reference; against black, infinite for an error and 0 for none.

    Unlike :func:`nrmse` it is not larger for the same share of misplaced light where that light is a highlight.
    """
    return _ratio(rmse(test, reference), float(np.sqrt(np.mean(paired(test, reference)[1] ** 2))))


def bias_fraction(test: ArrayLike, reference: ArrayLike) -> float:
    """Absolute bias divided by the mean absolute reference."""
    return _ratio(abs(bias(test, reference)), float(np.mean(np.abs(paired(test, reference)[1]))))


def relmse(test: ArrayLike, reference: ArrayLike, *, epsilon: float = RELMSE_EPSILON) -> float:
    """Relative mean squared error, mean of (t - r)² / (r² + ε).

    Parameters
    ----------
    test, reference : array
        Radiance.
    epsilon : float, optional
        In squared units of the input. Projects differ in this constant and in its place: quote it with
        the number.

    Returns
    -------
    float
    """
    t, r = paired(test, reference)
    return float(np.mean((t - r) ** 2 / (r**2 + epsilon)))


def smape(test: ArrayLike, reference: ArrayLike, *, epsilon: float = SMAPE_EPSILON) -> float:
    """Symmetric mean absolute percentage error in [0, 2], mean of 2|t - r| / (|t| + |r| + ε)."""
    t, r = paired(test, reference)
    return float(np.mean(2 * np.abs(t - r) / (np.abs(t) + np.abs(r) + epsilon)))


def psnr(test: ArrayLike, reference: ArrayLike, *, peak: float) -> float:
    """Peak signal-to-noise ratio in dB, 20 log10(peak / RMSE); infinite for equal input.

    Parameters
    ----------
    test, reference : array
        Radiance.
    peak : float
        The signal's largest value. There is no usual one for radiance: quote it with the number.

    Returns
    -------
    float

    Raises
    ------
    InputError
        `peak` is not positive.
    """
    if not peak > 0:
        raise InputError("the peak of a PSNR must be positive", field="peak", got=peak)
    error = rmse(test, reference)
    return float("inf") if error == 0 else float(20 * np.log10(peak / error))


def relative_error(
    test: ArrayLike, reference: ArrayLike, *, floor: float = FLOOR, largest: float | None = None
) -> np.ndarray:
    """Relative error of colours, ‖t - r‖ / max(‖r‖, floor · largest), ‖·‖ the largest absolute channel.

    Channels of one colour are sums over the same texels, directions and weights, whose rounding is a share of the
    terms, not of what is left where terms of both signs cancel: a channel that passes through zero beside a highlight
    rounds by as much as the others.

    Parameters
    ----------
    test, reference : (..., C) array
        Radiance.
    floor : float, optional
        Fraction of `largest` below which an error counts as absolute.
    largest : float, optional
        Default: the largest absolute reference value.

    Returns
    -------
    (...) float64 array
        Infinite where an error stands against a reference that is black everywhere.
    """
    t, r = paired(test, reference)
    largest = float(np.max(np.abs(r))) if largest is None else float(largest)
    error, scale = np.abs(t - r).max(-1), np.maximum(np.abs(r).max(-1), floor * largest)
    return np.where(
        scale > 0,
        error / np.where(scale > 0, scale, 1.0),
        np.where(error > 0, np.inf, 0.0),
    )


def code_error(test: ArrayLike, reference: ArrayLike) -> np.ndarray:
    """Absolute differences in steps of 8-bit sRGB codes, both clipped to [0, 1]; same shape."""
    t, r = (encode_srgb(np.clip(np.nan_to_num(x), 0.0, 1.0)) for x in paired(test, reference))
    return 255 * np.abs(t - r)


def lost_negative(test: ArrayLike, reference: ArrayLike) -> float:
    """Largest negative part of the reference that the test lacks, over the largest absolute reference value.

    A renderer that clamps in silence hides what a lossy method undershoots, and with it part of its error.
    """
    t, r = paired(test, reference)
    lost = np.maximum(-r, 0) - np.maximum(-t, 0)
    return _ratio(float(np.max(np.maximum(lost, 0))), float(np.max(np.abs(r))))


def percentiles(error: ArrayLike) -> dict[str, float]:
    """Percentiles p50, p99, p999 and max of an error: the smallest entry with that share at or below it.

    Parameters
    ----------
    error : array
        Not empty.

    Returns
    -------
    dict of str to float
        No interpolation between entries: with fewer than 1000 entries p999 is the maximum.
    """
    ordered = np.sort(np.asarray(error, np.float64), axis=None)
    if ordered.size == 0:
        raise InputError("no entries", field="error", got=ordered.shape)
    rank = [max(int(np.ceil(ordered.size * share / 100 - 1e-9)), 1) - 1 for share in PERCENTILES.values()]
    return {name: float(ordered[i]) for name, i in zip(PERCENTILES, rank, strict=True)}


def ssim_map(test: ArrayLike, reference: ArrayLike, *, data_range: float = 1.0) -> np.ndarray:
    """Structural similarity per pixel and channel (Wang, Bovik, Sheikh and Simoncelli 2004, eq. 13).

    Gaussian window of 11 × 11 pixels with a standard deviation of 1.5, K1 = 0.01, K2 = 0.03, population
    variances.

    Parameters
    ----------
    test, reference : (H, W, C) array
        Made for display-encoded values, not for radiance.
    data_range : float, optional
        Range of the values.

    Returns
    -------
    (H, W, C) float64 array
        At most 1. The five pixels along each border see a mirrored picture.

    Raises
    ------
    InputError
        Shapes differ or are not (H, W, C).
    """
    t, r = paired(test, reference)
    if t.ndim != 3:
        raise InputError("SSIM needs a picture", field="shape", got=t.shape, expected="(H, W, C)")
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    mean_t, mean_r = _window_mean(t), _window_mean(r)
    var_t, var_r = _window_mean(t * t) - mean_t**2, _window_mean(r * r) - mean_r**2
    covariance = _window_mean(t * r) - mean_t * mean_r
    return ((2 * mean_t * mean_r + c1) * (2 * covariance + c2)) / (
        (mean_t**2 + mean_r**2 + c1) * (var_t + var_r + c2)
    )


def _window_mean(x: np.ndarray) -> np.ndarray:
    """Mean under SSIM's Gaussian window along the first two axes, mirrored at the borders."""
    offsets = np.arange(-5, 6)
    weights = np.exp(-0.5 * (offsets / 1.5) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        size = x.shape[axis]
        padding = [(5, 5) if k == axis else (0, 0) for k in range(x.ndim)]
        padded = np.moveaxis(np.pad(x, padding, mode="symmetric"), axis, 0)
        x = np.moveaxis(sum(w * padded[k : k + size] for k, w in enumerate(weights)), 0, axis)
    return x


def _ratio(value: float, scale: float) -> float:
    if scale > 0:
        return value / scale
    return float("inf") if value > 0 else 0.0
