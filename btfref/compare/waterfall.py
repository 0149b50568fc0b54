"""The error waterfall: which stage between the truth and the screen is to blame, and by how much.

Pictures along the chain differ by one stage each. With e_k the difference that stage k makes, the error of the last
picture is Σ e_k, and its mean square is Σ ⟨e_k, e_k⟩ + 2 Σ_{j<k} ⟨e_j, e_k⟩: stages *add up* when the second sum is
nothing, which is so for independent errors, and not where one stage undoes what another did (a compression that
smooths away the noise of the samples), which the correlation says.

Pictures that carry Monte Carlo noise come as independent batches. A product of differences from two batches that
share no random number is free of noise on average (see `significance.mse_interval_from_halves`). The stages are
estimated from one pair of batches and the whole from another pair: their agreement tests the estimates, and is no
identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from btfref.compare.colour import delta_e00
from btfref.compare.gates import Measured, judge
from btfref.compare.significance import Interval, interval, rmse_interval
from btfref.errors import InputError

#: Of every interval.
CONFIDENCE = 0.99

#: Share of the total mean square below which a product of two stages needs no mention.
MENTION = 0.05


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture of the chain.

    Parameters
    ----------
    name : str
        The stage that leads to it; for the first, what it shows.
    batches : ndarray, shape (n, H, W, 3)
        One picture without noise, or at least four independent ones.
    """

    name: str
    batches: np.ndarray

    @property
    def mean(self):
        """Mean over the batches, float64 (H, W, 3)."""
        return np.mean(self.batches, axis=0, dtype=np.float64)


@dataclass(frozen=True)
class Stage:
    """What one stage does to the picture.

    Parameters
    ----------
    name : str
    mse : Interval
        Mean square of the stage's own error, noise taken out.
    rmse, rmse_so_far : Interval
        Root of it, and of the error of the picture after the stage against the first picture.
    delta_e00, delta_e00_so_far : Interval
        Mean CIEDE2000 under the display, likewise.
    """

    name: str
    mse: Interval
    rmse: Interval
    rmse_so_far: Interval
    delta_e00: Interval
    delta_e00_so_far: Interval

    def to_dict(self):
        """JSON-able form."""
        return {
            key: value.to_dict() if isinstance(value, Interval) else value
            for key, value in vars(self).items()
        }


@dataclass(frozen=True)
class Waterfall:
    """Stages, what they add up to, and whether that is the whole.

    Parameters
    ----------
    stages : tuple of Stage
    total : Interval
        Mean square of the last picture's error, from batches that the stages did not use.
    unexplained : Interval
        Total − Σ of the stages' mean squares: what products of stages must explain.
    closure : Interval
        The same less the products: 0 up to noise.
    products : tuple of (str, str, float, float)
        Two stages, twice their mean product as a share of the total, and their correlation; the largest first.
    mean : float
        Mean of the first picture where it counts.
    pixels : int
        That count.
    gates : tuple of GateResult
    """

    stages: tuple
    total: Interval
    unexplained: Interval
    closure: Interval
    products: tuple = ()
    mean: float = 0.0
    pixels: int = 0
    gates: tuple = field(default=())

    @property
    def additive(self):
        """Whether the stages alone explain the total within the interval."""
        return self.unexplained.low <= 0 <= self.unexplained.high

    @property
    def explanation(self):
        """One sentence on how the stages make up the total."""
        if self.additive:
            return "The stages' mean squares add up to the total within its interval."
        share = self.unexplained.estimate / self.total.estimate if self.total.estimate > 0 else np.inf
        named = [p for p in self.products if abs(p[2]) >= MENTION] or list(self.products[:1])
        words = "; ".join(
            f"{a} and {b} {'undo' if r < 0 else 'add to'} each other (correlation {r:.2f}, {100 * s:+.0f} % of the "
            "total)"
            for a, b, s, r in named
        )
        return f"The stages alone miss {100 * share:+.0f} % of the total: {words}."

    def to_dict(self):
        """JSON-able form."""
        return {
            "stages": [stage.to_dict() for stage in self.stages],
            "total": rmse_interval(self.total).to_dict(),
            "total_mse": self.total.to_dict(),
            "unexplained": self.unexplained.to_dict(),
            "closure": self.closure.to_dict(),
            "additive": self.additive,
            "explanation": self.explanation,
            "products": [
                {"stages": [a, b], "share": share, "correlation": correlation}
                for a, b, share, correlation in self.products
            ],
            "mean": self.mean,
            "pixels": self.pixels,
            "gates": [gate.to_dict() for gate in self.gates],
        }


def waterfall(pictures, mask, display):
    """Errors of the stages between pictures.

    Parameters
    ----------
    pictures : sequence of Picture
        The truth first; at least two.
    mask : (H, W) bool array
        Pixels that count; at least one.
    display : btfref.compare.Display
        For ΔE00.

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        Pictures of different shapes, two or three batches, no pixel, or values that are not finite.
    """
    pictures, mask = list(pictures), np.asarray(mask, bool)
    shapes = {picture.batches.shape[1:] for picture in pictures}
    if len(pictures) < 2 or shapes != {(*mask.shape, 3)}:
        raise InputError(
            "pictures of one shape are needed", field="pictures", got=shapes, expected=mask.shape
        )
    if not mask.any():
        raise InputError("no pixel counts", field="mask")
    for picture in pictures:
        if len(picture.batches) in (2, 3):
            raise InputError("one batch or four are needed", field=picture.name, got=len(picture.batches))
    values = [np.asarray(p.batches[:, mask], np.float64) for p in pictures]
    if not all(np.isfinite(v).all() for v in values):
        raise InputError("a picture of the chain is not finite", field="pictures")
    pairs = [_pairs(v) for v in values]
    # Half sums and differences of the two batches of a pair, by pair and picture.
    half = np.array([[0.5 * (a + b) for a, b in pair] for pair in pairs])
    spread = np.array([[a - b for a, b in pair] for pair in pairs])
    step, noise = np.diff(half, axis=0), np.diff(spread, axis=0)
    stages = []
    for k in range(1, len(pictures)):
        mse = _mse(step[k - 1, 0], noise[k - 1, 0])
        so_far = _mse(half[k, 0] - half[0, 0], spread[k, 0] - spread[0, 0])
        colours = [_delta_e00(values[k], values[other], display) for other in (k - 1, 0)]
        stages.append(Stage(pictures[k].name, mse, rmse_interval(mse), rmse_interval(so_far), *colours))
    total = _mse(half[-1, 1] - half[0, 1], spread[-1, 1] - spread[0, 1])
    alone = _mse(step[:, 0], noise[:, 0])
    whole = _mse(half[-1, 0] - half[0, 0], spread[-1, 0] - spread[0, 0])
    closure = _difference(total, whole)
    unexplained = _difference(total, alone)
    error = closure.standard_error
    # Without noise, float64 sums of some thousand products.
    floor = 1e-12 * max(total.estimate, alone.estimate)
    gates = judge("waterfall.closure", {"z": Measured(abs(closure.estimate) / max(error, floor, 1e-300))})
    return Waterfall(
        tuple(stages),
        total,
        unexplained,
        closure,
        _products(stages, step[:, 0], noise[:, 0], total.estimate),
        float(values[0].mean()),
        int(np.count_nonzero(mask)),
        tuple(gates),
    )


def _pairs(batches):
    """Two pairs of independent halves; a picture without noise is its own."""
    if len(batches) == 1:
        return [(batches[0], batches[0])] * 2
    quarters = [batches[i::4].mean(0) for i in range(4)]
    return [(quarters[0], quarters[1]), (quarters[2], quarters[3])]


def _mse(step, noise):
    """Mean of S² − D²/4 and its interval; leading axes before (pixels, 3) are summed.

    S, the half sum, and D, the difference of two batches, are independent for normal noise and D/2 has the noise of S,
    so that (Σ S D)² estimates the variance of each entry, stages that share a noisy picture included.
    """
    size = step.shape[-2] * step.shape[-1]
    product = (step**2 - noise**2 / 4).reshape(-1, size).sum(0)
    spread = (step * noise).reshape(-1, size).sum(0)
    return interval(product.mean(), np.sqrt(np.sum(spread**2)) / size, confidence=CONFIDENCE)


def _difference(a, b):
    """Interval of the difference of two independent estimates."""
    error = float(np.hypot(a.standard_error, b.standard_error))
    return interval(a.estimate - b.estimate, error, confidence=CONFIDENCE)


def _products(stages, step, noise, total):
    """Pairs of stages by the size of their mean product."""
    found = []
    for j in range(len(stages)):
        for k in range(j + 1, len(stages)):
            mean = float(np.mean(step[j] * step[k] - noise[j] * noise[k] / 4))
            scale = np.sqrt(max(stages[j].mse.estimate, 0) * max(stages[k].mse.estimate, 0))
            correlation = float(np.clip(mean / scale, -1, 1)) if scale > 0 else 0.0
            found.append(
                (stages[j].name, stages[k].name, 2 * mean / total if total > 0 else 0.0, correlation)
            )
    return tuple(sorted(found, key=lambda p: -abs(p[2])))


def _delta_e00(test, reference, display):
    """Mean ΔE00 with the bias of noise taken out by the jackknife over batches (Quenouille 1956), and its interval.

    The bias of a mean of n batches falls as 1/n where differences exceed the noise, which is what the jackknife
    removes to first order; in pixels where nothing but noise differs it removes about half.
    """
    n = max(len(test), len(reference))

    def mean(batches, left_out):
        if len(batches) == 1:
            return batches[0]
        return np.delete(batches, left_out, 0).mean(0) if left_out is not None else batches.mean(0)

    def value(left_out):
        return float(np.mean(delta_e00(mean(test, left_out), mean(reference, left_out), display)))

    whole = value(None)
    if n == 1:
        return interval(whole, 0.0, confidence=CONFIDENCE)
    parts = np.array([value(i) for i in range(n)])
    error = np.sqrt((n - 1) / n * np.sum((parts - parts.mean()) ** 2))
    found = interval(n * whole - (n - 1) * parts.mean(), error, confidence=CONFIDENCE, freedom=n - 1)
    return Interval(
        found.estimate, found.standard_error, max(found.low, 0.0), max(found.high, whole), CONFIDENCE
    )
