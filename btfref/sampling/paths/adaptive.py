"""Synthesis to a target error: a pilot says where samples are needed, independent ones make the estimate.

1. Two independent pilots of few samples give each texel of each view the variance s² of one sample and the mean
   m, both averaged over lights and channels (a path serves all lights).
2. Numbers of samples n are fixed from it: for the whole, the least total for which ``√mean(s²/n) ≤ E · mean(m)``
   is ``n ∝ s`` (Neyman's allocation); for one texel, ``√(s²/n) ≤ T · max(m, FLOOR · mean(m))``. What is dark,
   occluded or free of noise gets the least number, nothing is left to the pilot alone. What an allocation will
   give is predicted from the other pilot than the one that made it: where a few samples missed a highlight, too
   few samples would be given *and* too small an error be expected.
3. The estimate is made of new samples only. Given the pilot it is an ordinary mean of a fixed number of
   samples: no bias by stopping, and its variance is the usual one.

With the surface estimator a unit is a pass of `SURFACE_POINTS` points per texel, and all texels of a view get
the same number of passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts

#: Samples of each pilot, per texel and view.
PILOT = 8

#: Least number of samples of a texel: four strata of two, so that the variance has four degrees of freedom.
LEAST = 8

#: Surface points per texel of the tile in one pass of the surface estimator, the pilot included.
SURFACE_POINTS = 16

#: A texel is judged against its own mean, or this share of the whole's where it is darker.
FLOOR = 0.1

#: Samples beyond those that the pilot asks for to keep a texel's own limit: its s² comes from sixteen samples, and
#: what too small a one costs is exactly what the limit forbids.
MARGIN = 1.5

#: Classes of s per factor of e in the search for the allocation: steps of 1.6 %.
_CLASSES = 64


@dataclass(frozen=True)
class Plan:
    """Numbers of samples as a function of the pilot.

    Attributes
    ----------
    scale : float
        n / s for the whole's sake.
    mean : float
        Mean value of the whole.
    texel_error : float or None
        T.
    most : int
        Largest number of samples (of passes, when `whole_views`).
    whole_views : bool
        Whether a view's texels get the same number.
    """

    scale: float
    mean: float
    texel_error: float | None
    most: int
    whole_views: bool

    def counts(self, pilot: np.ndarray) -> np.ndarray:
        """Samples of each texel of a view; passes where these are of whole views.

        Parameters
        ----------
        pilot : ndarray (rows, columns, 3)
            s² of both pilots and their mean m.

        Returns
        -------
        ndarray (rows, columns) of int
        """
        pilot = np.asarray(pilot, np.float64)
        spread, least = self.demand(pilot[..., :2].mean(-1), pilot[..., 2])
        return self.rounded(np.maximum(self.scale * np.sqrt(spread), least)).reshape(pilot.shape[:2])

    def demand(self, spread: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variance of one sample, and the number of samples for the texel's own sake; (cells,) each."""
        # A texel whose few samples saw nothing unusual has neighbours that did.
        around = sum(np.roll(spread, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
        smooth = np.maximum(spread, around)
        limit = np.maximum(mean, FLOOR * self.mean)
        if self.texel_error is None or self.mean <= 0:
            least = np.zeros_like(spread)
        else:
            least = MARGIN * smooth / (self.texel_error * limit) ** 2
        if self.whole_views:
            return np.full(spread.size, spread.mean()), np.full(spread.size, least.max())
        return smooth.ravel(), least.ravel()

    def rounded(self, wanted: np.ndarray) -> np.ndarray:
        """Numbers that there are: passes, or 8, 12, 16, 24, … samples."""
        if self.whole_views:
            return np.clip(np.ceil(wanted), 1, self.most).astype(np.int64)
        wanted = np.clip(wanted, LEAST, self.most)
        power = 2 ** np.floor(np.log2(wanted / LEAST) + 1e-9)
        ratio = wanted / (LEAST * power)
        up = np.where(ratio <= 1 + 1e-9, 1.0, np.where(ratio <= 1.5, 1.5, 2.0))
        return np.minimum((LEAST * power * up).astype(np.int64), self.most)


def make_plan(
    pilots: Callable[[], Iterable[np.ndarray]],
    *,
    target: float,
    texel_error: float | None,
    most: int,
    whole_views: bool,
) -> Plan:
    """Fix the numbers of samples from the pilot of all views.

    Parameters
    ----------
    pilots : callable
        ``pilots()`` yields the pilot of every view, (rows, columns, 3) each; it is called twice.
    target : float
        E, relative standard error of the whole.
    texel_error : float or None
    most : int
    whole_views : bool

    Returns
    -------
    Plan
    """
    total, count = 0.0, 0
    for pilot in pilots():
        total, count = total + float(pilot[..., 2].sum(dtype=np.float64)), count + pilot[..., 2].size
    mean = total / count
    plan = Plan(0.0, mean, texel_error, most, whole_views)
    if mean <= 0:
        return plan
    # All that matters of a texel is its s, what it needs for itself, and what the other pilot says of it: classes
    # of the first two, with sums of the third, hold any number of texels.
    sums: dict[tuple[int, int], float] = {}
    for pilot in pilots():
        pilot = np.asarray(pilot, np.float64)
        for made, judged in ((0, 1), (1, 0)):
            spread, least = plan.demand(pilot[..., made], pilot[..., 2])
            s_class = np.round(_CLASSES * np.log(np.maximum(spread, 1e-30))).astype(np.int64)
            keys = np.stack([s_class, plan.rounded(least)], 1)
            keys, index = np.unique(keys, axis=0, return_inverse=True)
            for key, value in zip(
                map(tuple, keys), np.bincount(index.ravel(), pilot[..., judged].ravel()), strict=True
            ):
                sums[key] = sums.get(key, 0.0) + 0.5 * value
    s, own = np.array(list(sums), np.float64).T
    s = np.exp(0.5 * s / _CLASSES)
    variance = np.array(list(sums.values()))
    goal = (target * mean) ** 2 * count

    def predicted(scale: float) -> float:
        return (variance / plan.rounded(np.maximum(scale * s, own))).sum()

    low, high = -80.0, 80.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if predicted(np.exp(middle)) > goal else (low, middle)
    return Plan(float(np.exp(high)), mean, texel_error, most, whole_views)


def texel_means(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Variance and mean of texels over lights and channels: (lights, …, 3) twice to (…, 2) float32."""
    return np.stack([a.mean(axis=(0, -1), dtype=np.float64) for a in (variance, mean)], axis=-1).astype(
        np.float32
    )


def pilot_map(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], samples: int
) -> np.ndarray:
    """The map of a view's pilots from two pairs (mean, variance of the mean), each (lights, …, 3)."""
    one, two = texel_means(*first), texel_means(*second)
    mean = 0.5 * (one[..., 1] + two[..., 1])
    return np.stack([samples * one[..., 0], samples * two[..., 0], mean], -1)


def summary(store: BTFStore) -> Facts | None:
    """What a synthesis to a target error has reached so far.

    Parameters
    ----------
    store : BTFStore

    Returns
    -------
    dict or None
        Relative standard error of the whole and of the worst texel, share of texels (of views) above their
        limit, and samples; None for other stores, and before anything is there.
    """
    if store.maps("reached") is None:
        return None
    parameters = store.attributes["parameters"]
    seen = [view for view in range(len(store.views)) if np.isfinite(store.read_map("reached", view)[0, 0, 0])]
    if not seen:
        return None
    variance = mean = worst = 0.0
    above = count = total = 0
    least, most = np.iinfo(np.int64).max, 0
    means = [np.nanmean(store.read_map("reached", view)[..., 1], dtype=np.float64) for view in seen]
    dark = max(FLOOR * float(np.mean(means)), 1e-30)
    for view in seen:
        spread, value = store.read_map("reached", view).astype(np.float64).transpose(2, 0, 1)
        there = np.isfinite(spread)
        samples = store.read_map("samples", view)[there]
        spread, value = spread[there], value[there]
        relative = np.sqrt(spread) / np.maximum(value, dark)
        variance, mean, count = variance + spread.sum(), mean + value.sum(), count + spread.size
        worst = max(worst, float(relative.max()))
        if parameters["texel_error"] is not None:
            above += int((relative > parameters["texel_error"]).sum())
        total += int(samples.sum(dtype=np.int64))
        least, most = min(least, int(samples.min())), max(most, int(samples.max()))
    return {
        "target": parameters["target_error"],
        "reached": float(np.sqrt(variance / count) / max(mean / count, 1e-30)),
        "texel_target": parameters["texel_error"],
        "texel_worst": worst,
        "texels_above": above / count if parameters["texel_error"] is not None else None,
        "samples": {"mean": total / count, "least": least, "most": most},
    }
