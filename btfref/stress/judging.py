"""What stress checks find, and how the value of a port is judged against the definition."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.comparison import agreement
from btfref.conventions import valid_directions
from btfref.gates.tolerances import tolerance, tolerance_of
from btfref.representations.protocol import Spreads

if TYPE_CHECKING:
    from btfref.comparison import Comparison
    from btfref.representations.protocol import Representation
    from btfref.stress.lookups import Lookups
    from btfref.types import Facts

#: Random points of the box of rounded arguments among which a differing value is looked for.
NEIGHBOURS = 256

#: Relative differences up to which nothing is allowed for a hit.
HIT = 1e-6

#: Share of the lookups in which rounding may be asked for; more are a fault.
FEW = 0.1

#: Of these evaluated in one call: single lookups cost a call each, and little else.
TOGETHER = 1 << 13


@dataclass(frozen=True)
class Finding:
    """One check of one evaluator of one method on some data.

    Attributes
    ----------
    check, method, evaluator, data : str
    cases : int
        Lookups, or comparisons, that were judged.
    worst : float
        Largest error, in the unit of ``bound``.
    bound : float
        What it must not exceed.
    failures : int
        Cases beyond it.
    explained : int
        Cases beyond it whose value the definition takes within the rounding of the arguments.
    where : str
        What the worst case was.
    reproducer : str
        A command that shows the first failure, or the worst case; "" where the check is its own.
    detail : dict
        Further numbers: distribution of the error in units in the last place, relative error.
    """

    check: str
    method: str
    evaluator: str
    data: str
    cases: int
    worst: float
    bound: float
    failures: int
    explained: int = 0
    where: str = ""
    reproducer: str = ""
    detail: Facts | None = None

    @property
    def passed(self) -> bool:
        """Whether no case failed."""
        return not self.failures

    def to_dict(self) -> Facts:
        """JSON-able."""
        return asdict(self) | {"passed": self.passed}


def limit_finding(
    check: str,
    method: str,
    data: str,
    worst: float,
    key: str,
    *,
    evaluator: str = "definition",
    cases: int = 1,
    where: str = "",
    detail: Facts | None = None,
) -> Finding:
    """A finding of one number with an upper limit in ``tolerances.toml``, the method's own if it has one; NaN fails."""
    bound = tolerance_of(method, key)
    return Finding(
        check,
        method,
        evaluator,
        data,
        cases,
        float(worst),
        bound,
        int(not worst <= bound),
        0,
        where,
        "",
        detail,
    )


def judge_values(
    value: np.ndarray, reference: np.ndarray, representation: Representation, lookups: Lookups, gate: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compare a port's values with the definition's.

    A value passes when it is finite and within the gate's relative ``max`` of the definition, or of a value that the
    definition takes at arguments moved by their rounding; and where the definition is exactly 0 because a direction is
    none, exactly 0.

    Parameters
    ----------
    value, reference : ndarray, shape (n, 3)
    representation : Representation
    lookups : Lookups
    gate : str
        Table of ``tolerances.toml`` with ``floor``, ``max`` and ``argument_ulps``.

    Returns
    -------
    failed, explained : ndarray of bool, shape (n,)
    error : ndarray, shape (n,)
        Largest error of a channel, relative to the largest channel; infinite where the value is not finite.
    ulps : ndarray, shape (n,)
        The same in units in the last place of a float32 of the largest channel.
    """
    value = np.asarray(value, float)
    finite = np.isfinite(value).all(-1)
    safe = np.where(finite[:, None], value, 0)
    largest = np.abs(reference).max(initial=0)
    # A black BTF has no scale: any value but 0 is then an error of more than any bound.
    size = np.abs(reference).max(-1, keepdims=True)
    scale = np.maximum(size, max(tolerance(f"{gate}.floor") * largest, np.finfo(float).tiny))
    difference = np.abs(safe - reference)
    with np.errstate(over="ignore"):
        error = np.where(finite, (difference / scale).max(-1), np.inf)
        ulps = difference / np.spacing(np.maximum(size, 2.0**-126).astype(np.float32))
    ulps = np.where(finite, ulps.max(-1), np.inf)
    invalid = ~valid_lookups(lookups)
    beyond = error > tolerance(f"{gate}.max")
    explained = np.zeros(len(value), bool)
    ask = np.flatnonzero(beyond & finite & ~invalid)
    if len(ask):
        asked = lookups[ask]
        ulps_off = tolerance(f"{gate}.argument_ulps")
        low, high = rounded_range(representation, asked.points, ulps_off, lod=asked.lod)
        slack = tolerance(f"{gate}.max") * scale[ask]
        explained[ask] = ((safe[ask] >= low - slack) & (safe[ask] <= high + slack)).all(-1)
    failed = (beyond & ~explained) | (invalid & (value != 0).any(-1))
    return failed, explained, error, ulps


def port_agreement(
    value: np.ndarray,
    representation: Representation,
    points: tuple[np.ndarray, np.ndarray, np.ndarray],
    lod: ArrayLike = 0.0,
    *,
    gate: str = "probe.agreement",
    reference: np.ndarray | None = None,
) -> Comparison:
    """A port's values against the definition's, by the distribution of their relative error.

    Where the method has geometry, differences within the stated tolerance of a hit are allowed; but where a port and
    the definition agree to float32 anyway nothing is needed, and nothing is allowed. Of the few values over the limit
    of the 99.9th percentile, what the definition shows too at arguments off by their rounding does not count.

    Parameters
    ----------
    value : ndarray, shape (n, 3)
    representation : Representation
    points : tuple of ndarray
        ``uv``, ``w_light``, ``w_view``.
    lod : array_like
    gate : str
        Key of ``tolerances.toml``.
    reference : ndarray, shape (n, 3), optional
        The definition's values, where they are known: several ports may be judged by one evaluation.

    Returns
    -------
    Comparison
    """
    if reference is None:
        reference = representation.evaluate(*points, lod=lod)
    value = np.reshape(value, reference.shape)
    allowance = np.zeros_like(reference, float)
    if isinstance(representation, Spreads):
        differs = _error(value, reference, gate) > HIT
        allowance[differs] = representation.spread(*(a[differs] for a in points))
    allowance += _moved_by_rounding(value, reference, allowance, representation, points, lod, gate)
    return agreement(value, reference, gate=gate, allowance=allowance)


def _error(value: np.ndarray, reference: np.ndarray, gate: str) -> np.ndarray:
    """Largest error of a channel, relative to the largest channel; NaN where the value is."""
    size = np.abs(reference).max(-1)
    # A black BTF has no scale: any value but 0 is then an error of more than any bound.
    scale = np.maximum(size, max(tolerance(f"{gate}.floor") * size.max(initial=0), np.finfo(float).tiny))
    with np.errstate(over="ignore"):
        return np.abs(value - reference).max(-1) / scale


def _moved_by_rounding(
    value: np.ndarray,
    reference: np.ndarray,
    allowance: np.ndarray,
    representation: Representation,
    points: tuple[np.ndarray, np.ndarray, np.ndarray],
    lod: ArrayLike,
    gate: str,
) -> np.ndarray:
    """What of a port's differences the definition shows too, at arguments that are off by their rounding.

    Asked where few values are over the limit of the 99.9th percentile; where many are, no rounding is to blame.

    Returns
    -------
    ndarray, shape (n, 3)
        Beyond ``allowance``.
    """
    moved = np.zeros_like(reference, float)
    shape = reference.shape[:-1]
    uv, w_light, w_view = (np.broadcast_to(a, (*shape, np.shape(a)[-1])) for a in points)
    beyond = _error(reference + np.maximum(np.abs(value - reference) - allowance, 0), reference, gate)
    ask = (beyond > tolerance(f"{gate}.p999")) & np.isfinite(beyond) & np.isfinite(uv).all(-1)
    ask &= valid_directions(w_light) & valid_directions(w_view)
    if not 0 < np.count_nonzero(ask) <= FEW * ask.size:
        return moved
    at = uv[ask], w_light[ask], w_view[ask]
    low, high = rounded_range(
        representation, at, tolerance(f"{gate}.argument_ulps"), lod=np.broadcast_to(lod, shape)[ask]
    )
    outside = np.maximum(np.maximum(low - value[ask], value[ask] - high), 0)
    moved[ask] = np.maximum(np.abs(value - reference)[ask] - outside - allowance[ask], 0)
    return moved


def valid_lookups(lookups: Lookups) -> np.ndarray:
    """Where both directions of a lookup count, shape (n,)."""
    return valid_directions(lookups.w_light) & valid_directions(lookups.w_view)


def rounded_range(
    representation: Representation,
    points: tuple[np.ndarray, np.ndarray, np.ndarray],
    ulps: float,
    *,
    lod: ArrayLike = 0.0,
    neighbours: int = NEIGHBOURS,
) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest value of the definition at arguments that are off by their rounding.

    Directions move by ``ulps`` roundoffs of 1 along each axis, coordinates by as many of themselves or of a tile,
    whichever is more; random points of that box are looked at, a fixed number of them.

    Returns
    -------
    low, high : ndarray, shape (n, 3)
    """
    rng = np.random.default_rng(0)
    step = ulps * float(np.finfo(np.float32).eps) / 2
    uv, w_light, w_view = (np.asarray(a, float) for a in points)
    uv = np.where(np.isfinite(uv), uv, 0.0)
    # A tile far out is a tile: its own rounding is in the argument already, which is exact.
    low = high = representation.evaluate(uv, w_light, w_view, lod=lod)
    together = max(1, TOGETHER // max(1, len(uv)))
    for first in range(0, neighbours, together):
        # Sizes over many decades: next to the horizon a change of the last digit turns a ray as far as one of the
        # first.
        moved = [
            [
                a + step * 10 ** rng.uniform(-8, 0, a.shape) * rng.choice([-1.0, 1.0], a.shape)
                for a in (uv - np.floor(uv), w_light, w_view)
            ]
            for _ in range(first, min(first + together, neighbours))
        ]
        near = [np.stack(a) for a in zip(*moved, strict=True)]
        for w in near[1:]:
            w[..., 2] = np.maximum(w[..., 2], 2.0**-126)
        value = representation.evaluate(*near, lod=lod)
        low, high = np.minimum(low, value.min(0)), np.maximum(high, value.max(0))
    return low, high
