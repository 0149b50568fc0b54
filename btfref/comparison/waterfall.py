"""The error waterfall: which stage between the truth and the screen is to blame, and by how much.

Pictures along the chain differ by one stage each. With e_k the difference that stage k makes, the error of the last
picture is Σ e_k, and its mean square is Σ ⟨e_k, e_k⟩ + 2 Σ_{j<k} ⟨e_j, e_k⟩: stages *add up* when the second sum, their
covariances, is nothing, which is so for independent errors, and not where one stage undoes what another did (a
compression that smooths away the noise of the samples), which the correlation says.

Pictures that carry Monte Carlo noise come as independent batches. A product of differences from two batches that
share no random number is free of noise on average (see `significance.mse_interval_from_halves`). Stages and covariances
are estimated from one pair of batches and the whole from another pair: their agreement tests the estimates, and is no
identity.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.colour import delta_e00
from btfref.comparison.significance import Interval, interval, rmse_interval
from btfref.errors import InputError
from btfref.gates.verdicts import GateResult, Measured, judge
from btfref.images.display import Display
from btfref.types import Facts

if TYPE_CHECKING:
    from btfref.comparison.parts import StagePart

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
    def mean(self) -> np.ndarray:
        """Mean over the batches, float64 (H, W, 3)."""
        return np.asarray(np.mean(self.batches, axis=0, dtype=np.float64))


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

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {
            key: value.to_dict() if isinstance(value, Interval) else value
            for key, value in vars(self).items()
        }


@dataclass(frozen=True)
class Product:
    """What two stages have in common.

    Parameters
    ----------
    stages : (str, str)
    mse : Interval
        Twice their mean product: what it adds to the mean square of the whole.
    correlation : float or None
        None where a stage has no error to speak of.
    """

    stages: tuple[str, str]
    mse: Interval
    correlation: float | None

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {"stages": list(self.stages), "mse": self.mse.to_dict(), "correlation": self.correlation}


@dataclass(frozen=True)
class Waterfall:
    """Stages, what they add up to, and whether that is the whole.

    Parameters
    ----------
    stages : tuple of Stage
    total : Interval
        Mean square of the last picture's error, from batches that the stages did not use.
    unexplained : Interval
        Total − Σ of the stages' mean squares: what covariances of stages must explain.
    covariance : Interval
        Sum of the products of all pairs of stages, from the stages' own batches.
    closure : Interval
        Total − stages − covariances: 0 up to noise.
    products : tuple of Product
        The largest first.
    parts : tuple of btfref.comparison.parts.StagePart
        Shares of stages that are known by themselves.
    mean : float
        Mean of the first picture where it counts.
    pixels : int
        That count.
    gates : tuple of GateResult
    """

    stages: tuple[Stage, ...]
    total: Interval
    unexplained: Interval
    covariance: Interval
    closure: Interval
    products: tuple[Product, ...] = ()
    parts: tuple[StagePart, ...] = ()
    mean: float = 0.0
    pixels: int = 0
    gates: tuple[GateResult, ...] = ()

    @property
    def additive(self) -> bool:
        """Whether the stages alone explain the total within the interval."""
        return self.unexplained.low <= 0 <= self.unexplained.high

    @property
    def explained(self) -> bool:
        """Whether stages and covariances explain the total as far as noise lets tell: its gate passed."""
        return all(gate.passed for gate in self.gates)

    @property
    def explanation(self) -> str:
        """How the stages make up the total, in shares of its mean square."""
        whole = self.total.estimate
        if not whole > 0:
            return "No error of the whole is left above the noise."
        alone = sum(stage.mse.estimate for stage in self.stages) / whole
        shared = [x / whole for x in (self.covariance.estimate, self.covariance.low, self.covariance.high)]
        found = alone + shared[0]
        half = 0.5 * (self.closure.high - self.closure.low) / whole
        text = f"The stages alone are {_percent(alone)} of the whole's mean square"
        text += " and add up to it within the interval" if self.additive else ""
        text += f"; their covariances are {_percent(shared[0], sign=True)}"
        if shared[2] > shared[1]:
            text += f" ({_percent(shared[1], sign=True)} to {_percent(shared[2], sign=True)})"
        named = [
            p
            for p in self.products
            if abs(p.mse.estimate) >= MENTION * whole and (p.mse.low > 0 or p.mse.high < 0)
        ]
        if named:
            text += ": " + "; ".join(_pair(p, whole) for p in named)
        apart = f" ± {100 * half:.2g}" if half > 0 else ""
        return f"{text}. Together {_percent(found)}{apart} of the whole, which is measured apart."

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {
            "stages": [stage.to_dict() for stage in self.stages],
            "total": rmse_interval(self.total).to_dict(),
            "total_mse": self.total.to_dict(),
            "unexplained": self.unexplained.to_dict(),
            "covariance": self.covariance.to_dict(),
            "closure": self.closure.to_dict(),
            "additive": self.additive,
            "explained": self.explained,
            "explanation": self.explanation,
            "products": [product.to_dict() for product in self.products],
            "parts": [part.to_dict() for part in self.parts],
            "mean": self.mean,
            "pixels": self.pixels,
            "gates": [gate.to_dict() for gate in self.gates],
        }


def _percent(share: float, *, sign: bool = False) -> str:
    """A share for a reader: two digits, and whole numbers from ten on."""
    digits = 0 if abs(share) >= 0.1 else 1
    return f"{100 * share:{'+' if sign else ''}.{digits}f} %"


def _pair(product: Product, whole: float) -> str:
    a, b = product.stages
    verb = "undo" if product.mse.estimate < 0 else "add to"
    known = "" if product.correlation is None else f"correlation {product.correlation:.2f}, "
    return f"{a} and {b} {verb} each other ({known}{_percent(product.mse.estimate / whole, sign=True)})"


def waterfall(
    pictures: Iterable[Picture], mask: ArrayLike, display: Display, *, parts: Iterable[StagePart] = ()
) -> Waterfall:
    """Errors of the stages between pictures.

    Parameters
    ----------
    pictures : sequence of Picture
        The truth first; at least two.
    mask : (H, W) bool array
        Pixels that count; at least one.
    display : btfref.comparison.Display
        For ΔE00.
    parts : sequence of btfref.comparison.parts.StagePart
        Shares of stages, to be told beside them.

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
    quarters = np.array([_quarters(v) for v in values])
    steps = np.diff(quarters, axis=0)
    first, second = (_Pair(steps, *chosen) for chosen in ((0, 1), (2, 3)))
    n = len(steps)
    every, own = np.ones((n, n)), np.eye(n)
    stages = []
    for k in range(n):
        so_far = np.arange(n) <= k
        mse = _form(first, np.diag(own[k]))
        colours = [_delta_e00(values[k + 1], values[other], display) for other in (k, 0)]
        found = rmse_interval(_form(first, np.outer(so_far, so_far)))
        stages.append(Stage(pictures[k + 1].name, mse, rmse_interval(mse), found, *colours))
    total, whole = _form(second, every), _form(first, every)
    closure = _difference(total, whole)
    # Without noise, float64 sums of some thousand products.
    floor = 1e-12 * max(total.estimate, sum(stage.mse.estimate for stage in stages))
    z = abs(closure.estimate) / max(closure.standard_error, floor, 1e-300)
    return Waterfall(
        tuple(stages),
        total,
        _difference(total, _form(first, own)),
        _form(first, every - own),
        closure,
        _products(stages, first),
        tuple(parts),
        float(values[0].mean()),
        int(np.count_nonzero(mask)),
        tuple(judge("waterfall.closure", {"z": Measured(z)})),
    )


def _quarters(batches: np.ndarray) -> np.ndarray:
    """Four independent pictures; one without noise is its own."""
    return np.stack([batches[i::4].mean(0) if len(batches) > 1 else batches[0] for i in range(4)])


class _Pair:
    """Two of four batches whose product is taken; all six pairs say how much it varies.

    Half sums and differences of a pair estimate the variance of its own product; where a few pixels hold most of the
    noise that estimate has few degrees of freedom, and two batches that agree by chance would pass for certain.
    """

    def __init__(self, steps: np.ndarray, i: int, j: int) -> None:
        self.half, self.difference = self._halves(steps, i, j)
        self._steps = steps

    @staticmethod
    def _halves(steps: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        return 0.5 * (steps[:, i] + steps[:, j]), steps[:, i] - steps[:, j]

    def spreads(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Half sums and differences of every pair."""
        for i, j in combinations(range(4), 2):
            yield self._halves(self._steps, i, j)


def _form(pair: _Pair, weights: np.ndarray) -> Interval:
    """Mean of a quadratic form Σ w_jk e_j e_k of the stages and its interval.

    With S the half sums and D the differences of two batches, S·wS − D·wD / 4 is x·wy of the batches x and y: free of
    noise on average. (S·wD)² estimates its variance, stages that share a noisy picture included. Channels of a pixel
    share their paths, so that their products are summed before they are squared.

    Parameters
    ----------
    pair : _Pair
        Of stages, each shape (stages, pixels, 3).
    weights : array, shape (stages, stages)
        Symmetric.

    Returns
    -------
    Interval
    """
    weights = np.asarray(weights, float)

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sum(a * np.tensordot(weights, b, 1), (0, 2))

    mean = product(pair.half, pair.half) - product(pair.difference, pair.difference) / 4
    square = np.mean([np.sum(product(s, d) ** 2) for s, d in pair.spreads()])
    count = pair.half[0].size
    return interval(mean.sum() / count, np.sqrt(square) / count, confidence=CONFIDENCE)


def _difference(a: Interval, b: Interval) -> Interval:
    """Interval of the difference of two independent estimates."""
    error = float(np.hypot(a.standard_error, b.standard_error))
    return interval(a.estimate - b.estimate, error, confidence=CONFIDENCE)


def _products(stages: Sequence[Stage], pair: _Pair) -> tuple[Product, ...]:
    """Pairs of stages by the size of their mean product."""
    found, n = [], len(stages)
    for j in range(n):
        for k in range(j + 1, n):
            weights = np.zeros((n, n))
            weights[[j, k], [k, j]] = 1
            mse = _form(pair, weights)
            a, b = (stages[i].mse for i in (j, k))
            # A stage that may be nothing but noise has no direction.
            known = a.low > 0 and b.low > 0
            correlation = (
                float(np.clip(mse.estimate / 2 / np.sqrt(a.estimate * b.estimate), -1, 1)) if known else None
            )
            found.append(Product((stages[j].name, stages[k].name), mse, correlation))
    return tuple(sorted(found, key=lambda p: -abs(p.mse.estimate)))


def _delta_e00(test: np.ndarray, reference: np.ndarray, display: Display) -> Interval:
    """Mean ΔE00 with the bias of noise taken out by the jackknife over batches (Quenouille 1956), and its interval.

    The bias of a mean of n batches falls as 1/n where differences exceed the noise, which is what the jackknife
    removes to first order; in pixels where nothing but noise differs it removes about half.
    """
    n = max(len(test), len(reference))

    def mean(batches: np.ndarray, left_out: int | None) -> np.ndarray:
        if len(batches) == 1:
            return batches[0]
        return np.delete(batches, left_out, 0).mean(0) if left_out is not None else batches.mean(0)

    def value(left_out: int | None) -> float:
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
