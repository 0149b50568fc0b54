"""Is a difference noise? Tests and intervals for pictures that carry Monte Carlo noise.

Variances are always variances *of the mean* (of what a pixel holds), and pixels are taken as independent:
render with a box filter. A difference test can only find a difference; that two pictures agree is shown by an
equivalence test, which a noisy reference cannot pass.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.metrics import paired
from btfref.errors import InputError
from btfref.types import Facts


def sidak(significance: float, n_tests: int) -> float:
    """Level of each of several independent tests, so that all together err with `significance` (Šidák 1967).

    Parameters
    ----------
    significance : float
        In (0, 1).
    n_tests : int
        At least 1.

    Returns
    -------
    float
    """
    if not 0 < significance < 1 or n_tests < 1:
        raise InputError("no such test", field="significance, n_tests", got=(significance, n_tests))
    return float(-np.expm1(np.log1p(-significance) / n_tests))


def welch_test(
    mean_a: ArrayLike,
    variance_a: ArrayLike,
    mean_b: ArrayLike,
    variance_b: ArrayLike,
    *,
    n_a: ArrayLike | None = None,
    n_b: ArrayLike | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided test that two means are equal, entry by entry (Welch 1947; without sample counts a z-test).

    Parameters
    ----------
    mean_a, mean_b : array
        Means of one shape.
    variance_a, variance_b : array or float
        Variances of those means, ≥ 0; 0 for an exact value.
    n_a, n_b : int or array, optional
        Samples behind each mean. Without them the variances count as known.

    Returns
    -------
    statistic, p_value : float64 arrays
        Where both variances are 0: p = 1 for equal values, 0 for different ones.
    """
    from scipy import special

    a, b = paired(mean_a, mean_b)
    va, vb = (np.broadcast_to(np.asarray(v, np.float64), a.shape) for v in (variance_a, variance_b))
    if not ((va >= 0).all() and (vb >= 0).all()):
        raise InputError("variances must be non-negative numbers", field="variance")
    total, difference = va + vb, a - b
    exact = total == 0
    statistic = np.where(
        exact,
        np.where(difference == 0, 0.0, np.copysign(np.inf, difference)),
        difference / np.sqrt(np.where(exact, 1.0, total)),
    )
    p_value = 2 * special.ndtr(-np.abs(statistic))
    if n_a is not None or n_b is not None:
        spread = sum(
            v**2 / (np.asarray(n, np.float64) - 1) for v, n in ((va, n_a), (vb, n_b)) if n is not None
        )
        freedom = np.where(spread > 0, total**2 / np.where(spread > 0, spread, 1.0), np.inf)
        finite = np.isfinite(freedom)
        student = 2 * special.stdtr(np.where(finite, freedom, 1.0), -np.abs(statistic))
        p_value = np.where(finite & ~exact, student, p_value)
    return statistic, p_value


@dataclass(frozen=True)
class Difference:
    """Outcome of many tests of equality taken together.

    Parameters
    ----------
    n_tests, rejected : int
        Entries tested, entries rejected at `level`.
    significance, level : float
        Of the family, and of each test after Šidák.
    smallest_p : float
        Smallest p-value.
    """

    n_tests: int
    rejected: int
    significance: float
    level: float
    smallest_p: float

    @property
    def rejected_fraction(self) -> float:
        """Share of rejected entries."""
        return self.rejected / self.n_tests

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return asdict(self) | {"rejected_fraction": self.rejected_fraction}


def difference_test(p_values: ArrayLike, *, significance: float) -> Difference:
    """Count the entries whose equality is rejected at the Šidák-corrected level.

    Parameters
    ----------
    p_values : array
        From `welch_test`.
    significance : float
        Chance of one or more rejections when all are equal.

    Returns
    -------
    Difference
    """
    p = np.asarray(p_values, np.float64)
    level = sidak(significance, p.size)
    return Difference(p.size, int(np.count_nonzero(p < level)), float(significance), level, float(p.min()))


@dataclass(frozen=True)
class Interval:
    """An estimate with its standard error and a two-sided confidence interval.

    Parameters
    ----------
    estimate, standard_error, low, high : float
    confidence : float
        Coverage of [low, high].
    """

    estimate: float
    standard_error: float
    low: float
    high: float
    confidence: float

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return asdict(self)


def interval(
    estimate: float, standard_error: float, *, confidence: float = 0.99, freedom: float | None = None
) -> Interval:
    """Confidence interval of a normal (or, with degrees of freedom, Student-distributed) estimate.

    Returns
    -------
    Interval
    """
    from scipy import special

    upper = 0.5 + 0.5 * confidence
    quantile = special.ndtri(upper) if freedom is None else special.stdtrit(freedom, upper)
    half = float(quantile) * float(standard_error)
    return Interval(
        float(estimate), float(standard_error), estimate - half, estimate + half, float(confidence)
    )


def bias_interval(
    difference: ArrayLike, variance: ArrayLike, *, confidence: float = 0.99, correlated: int = 1
) -> Interval:
    """Mean of a difference and its interval.

    Parameters
    ----------
    difference : array
        Test - reference.
    variance : array or float
        Variance of each entry of it, the sum of both pictures' variances.
    confidence : float, optional
    correlated : int, optional
        Entries that may share their random numbers, such as a pixel's three channels: the variance of their sum is at
        most this many times that of independent ones (Cauchy-Schwarz), and that is what counts.

    Returns
    -------
    Interval
    """
    d, v = _with_variance(difference, variance)
    return interval(d.mean(), np.sqrt(correlated * v.sum()) / d.size, confidence=confidence)


def mse_interval(
    difference: ArrayLike, variance: ArrayLike, *, confidence: float = 0.99, correlated: int = 1
) -> Interval:
    """Mean squared error with the noise taken out, and its interval: mean of d² - v.

    For d normal with mean b and known variance v, d² - v is an unbiased estimate of b² and 4 d² v - 2 v²
    one of its variance 4 b² v + 2 v².

    Parameters
    ----------
    difference, variance : array
        As in `bias_interval`.
    confidence : float, optional
    correlated : int, optional
        As in `bias_interval`.

    Returns
    -------
    Interval
        The estimate and the lower end may be negative: that is what keeps it unbiased.
    """
    d, v = _with_variance(difference, variance)
    spread = max(float(np.sum(4 * d**2 * v - 2 * v**2)), float(np.sum(2 * v**2)))
    return interval(np.mean(d**2 - v), np.sqrt(correlated * spread) / d.size, confidence=confidence)


def mse_interval_from_halves(
    difference_1: ArrayLike, difference_2: ArrayLike, *, confidence: float = 0.99
) -> Interval:
    """Mean squared error with the noise taken out, from two independent halves: mean of (X1 - R1)(X2 - R2).

    No variances are needed. With S and D the half sum and the difference of both entries, independent for
    normal noise, the product is S² - D²/4, and S² D² is an unbiased estimate of its variance.

    Parameters
    ----------
    difference_1, difference_2 : array
        Test - reference of each half; the halves share no random number.
    confidence : float, optional

    Returns
    -------
    Interval
        The estimate may be negative.
    """
    d1, d2 = paired(difference_1, difference_2)
    spread = np.sum((0.5 * (d1 + d2)) ** 2 * (d1 - d2) ** 2)
    return interval(np.mean(d1 * d2), np.sqrt(spread) / d1.size, confidence=confidence)


def rmse_interval(mse: Interval) -> Interval:
    """The interval of an RMSE from that of its square; negative ends become 0.

    Parameters
    ----------
    mse : Interval

    Returns
    -------
    Interval
        Its standard error is that of the root by linear propagation, at most half the width of [low, high].
    """
    estimate, low, high = (float(np.sqrt(max(x, 0.0))) for x in (mse.estimate, mse.low, mse.high))
    width = 0.5 * (high - low)
    error = min(mse.standard_error / (2 * estimate), width) if estimate > 0 else width
    return Interval(estimate, error, low, high, mse.confidence)


@dataclass(frozen=True)
class Equivalence:
    """Outcome of two one-sided tests.

    Parameters
    ----------
    outcome : {"pass", "fail", "inconclusive"}
        Interval inside ± tolerance; interval wholly outside; neither, so that more samples are needed.
    interval : Interval
    tolerance : float
    bounds : (float, float) or None
        Of several quantities, between which the largest surely lies; None for one, whose interval tells.
    """

    outcome: str
    interval: Interval
    tolerance: float
    bounds: tuple[float, float] | None = None

    @property
    def passed(self) -> bool:
        """True for the outcome ``"pass"`` alone."""
        return self.outcome == "pass"

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {"outcome": self.outcome, "tolerance": self.tolerance, **self.interval.to_dict()}


def equivalence_test(measured: Interval, *, tolerance: float) -> Equivalence:
    """Two one-sided tests (Schuirmann 1987) of whether a quantity is surely within ± tolerance.

    Parameters
    ----------
    measured : Interval
        A 99 % interval makes each one-sided test one of level 0.5 %.
    tolerance : float
        Positive.

    Returns
    -------
    Equivalence

    Raises
    ------
    InputError
        The tolerance is not positive, or the interval not finite.
    """
    if not tolerance > 0:
        raise InputError("must be positive", field="tolerance", got=tolerance)
    if not np.isfinite([measured.low, measured.high]).all():
        raise InputError("no finite interval", field="interval", got=(measured.low, measured.high))
    if -tolerance < measured.low and measured.high < tolerance:
        outcome = "pass"
    elif measured.low > tolerance or measured.high < -tolerance:
        outcome = "fail"
    else:
        outcome = "inconclusive"
    return Equivalence(outcome, measured, float(tolerance))


def tile_means(
    image: ArrayLike, variance: ArrayLike, mask: np.ndarray, *, size: int = 8, least: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the mean over square tiles: less noise, and a bias of a region shows.

    Parameters
    ----------
    image, variance : (H, W, C) array
        Values and their variances of the mean.
    mask : (H, W) bool array
        Pixels that count.
    size : int, optional
        Edge of a tile in pixels; tiles at the right and lower border may be smaller.
    least : int, optional
        Counted pixels that a tile needs.

    Returns
    -------
    means, variances : (n, C) float64 arrays
        Tiles with fewer counted pixels than ``least`` are left out.
    """
    x, v = paired(image, variance)
    height, width, channels = x.shape
    across = -(-width // size)
    label = (np.arange(height)[:, None] // size) * across + np.arange(width) // size
    label, n = label[mask], -(-height // size) * across
    count = np.bincount(label, minlength=n)
    used = count >= least

    def total(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(label, values[mask][:, c], n) for c in range(channels)], -1)[used]

    count = count[used, None]
    return total(x) / count, total(v) / count**2


def tile_equivalence(
    difference: ArrayLike,
    variance: ArrayLike,
    mask: np.ndarray,
    *,
    tolerance: float,
    significance: float = 0.01,
    size: int = 8,
) -> Equivalence | None:
    """Whether the mean difference of every tile is surely within ± tolerance.

    Parameters
    ----------
    difference, variance : (H, W, C) array
        Test - reference and its variance.
    mask : (H, W) bool array
        Pixels that count.
    tolerance : float
        Positive.
    significance : float
        Of all tiles and channels together (Šidák-corrected).
    size : int
        Edge of a tile in pixels.

    Returns
    -------
    Equivalence or None
        Of the tile with the largest mean difference; "pass" when all intervals lie inside, "fail" when one lies wholly
        outside. None without a tile of which a quarter counts.
    """
    mean, spread = tile_means(difference, variance, mask, size=size, least=size * size // 4)
    if not mean.size:
        return None
    half = tile_half_widths(variance, mask, significance=significance, size=size)
    confidence = 1 - sidak(significance, mean.size)
    low, high = (float((np.abs(mean) + sign * half).max()) for sign in (-1, 1))
    if low > tolerance:
        outcome = "fail"
    else:
        outcome = "pass" if high < tolerance else "inconclusive"
    place = np.unravel_index(np.abs(mean).argmax(), mean.shape)
    worst = interval(float(mean[place]), float(np.sqrt(spread[place])), confidence=confidence)
    return Equivalence(outcome, worst, float(tolerance), (low, high))


def tile_half_widths(
    variance: ArrayLike, mask: np.ndarray, *, significance: float = 0.01, size: int = 8
) -> np.ndarray:
    """Half widths of the intervals of `tile_equivalence`.

    Parameters
    ----------
    variance, mask, significance, size
        As there.

    Returns
    -------
    (n, C) float64 array
        Tiles of which a quarter counts.
    """
    _, spread = tile_means(variance, variance, mask, size=size, least=size * size // 4)
    if not spread.size:
        return spread
    # A normal interval's half width is the same multiple of the standard error for all.
    return interval(0.0, 1.0, confidence=1 - sidak(significance, spread.size)).high * np.sqrt(spread)


def _with_variance(difference: ArrayLike, variance: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    difference = np.asarray(difference, np.float64)
    d, v = paired(difference, np.broadcast_to(np.asarray(variance, np.float64), difference.shape))
    if not (v >= 0).all():
        raise InputError("variances must be non-negative numbers", field="variance")
    return d, v
