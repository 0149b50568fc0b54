"""An environment for prefiltered lobes: what is small and bright becomes directional lights, the rest is filtered.

A lobe that the horizon cuts is looked up as two others with the same integral and centroid
(:func:`btfref.rendering.environment_light.prefilter.clipped_lobes`): good for light that is broad, and tens of
percent off for a small one near the horizon, such as the sun. So radiance above a threshold is taken out, as P.
Debevec did with the sun ("Rendering Synthetic Objects into Real Scenes", SIGGRAPH 1998; "A Median Cut Algorithm for
Light Probe Sampling", SIGGRAPH 2006 posters), and lights through the representation itself. Nothing is lost: each
cell's power is what stays plus what is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.numerics.solvers.threads import one_blas_thread
from btfref.rendering.environment_light import prefilter
from btfref.rendering.environment_light.light_set import LightSet, divided
from btfref.scene.environment import cell_angles

if TYPE_CHECKING:
    from btfref.scene.environment import Environment


#: Estimated relative error at which the search ends: half of what an image may be off.
TARGET = 0.02

#: Most directional lights; beyond, a frame costs as much as one without prefiltered maps.
MOST = 128

#: Receivers of the error estimate.
RECEIVERS = 256

#: Exponents of their lobes lie between 1 and this, evenly in the logarithm: as narrow as measured directions resolve.
LARGEST = 32

#: Thresholds tried: the brightest cell's radiance halved, down to the mean.
OCTAVES = 24

#: Cells whose kernels are made at a time: they stay in the cache.
BLOCK = 1024


@dataclass(frozen=True)
class Cells:
    """Small lights, as :meth:`btfref.scene.environment.Environment.cells` gives them, without the picture.

    Parameters
    ----------
    w, power : ndarray, shape (n, 3)
    """

    w: np.ndarray
    power: np.ndarray

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """``w`` and ``power``."""
        return self.w, self.power


@dataclass(frozen=True)
class SplitLight:
    """An environment in two parts.

    Parameters
    ----------
    rest : Cells
        To be filtered.
    lights : LightSet
        Perhaps none; ``error`` is the estimate for both parts together.
    """

    rest: Cells
    lights: LightSet


def split_light(
    environment: Environment, edge: float, *, cosine: bool, target: float = TARGET, most: int = MOST
) -> SplitLight:
    """Take out of an environment what prefiltered lobes cannot show.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    edge : float
        Smallest measured cosine of the light; see :func:`btfref.rendering.environment_light.prefilter.moment_maps`.
    cosine : bool
        Whether lobes multiply the light's cosine; see `prefilter.clipped_lobes`.
    target : float
        Estimated relative RMSE over receivers that is good enough.
    most : int
        Lights.

    Returns
    -------
    SplitLight
        With the fewest octaves of radiance taken out that leave half the target for the rest, or the best there is; and
        then with the fewest lights, in powers of two, that reach the target.
    """
    whole = unsplit(environment)
    w, power = whole.rest.cells()
    lit = power.any(1)
    luminance = power @ LUMINANCE
    if not lit.any():
        return replace(whole, lights=replace(whole.lights, error=0.0))
    radiance = luminance / cell_angles()
    kept = _kept(radiance, luminance.sum() / (4 * np.pi))
    receivers = _Receivers(edge, cosine)
    true, shown = receivers.seen(w[lit], (luminance[:, None] * kept)[lit])
    truth = true[:, 0]

    def error(difference: np.ndarray) -> float:
        return float(np.sqrt(np.mean(difference**2)) / max(truth.mean(), 1e-300))

    errors = [error(d) for d in (shown - true).T]
    if errors[0] <= target:
        return replace(whole, lights=replace(whole.lights, error=errors[0]))
    enough = np.flatnonzero(np.array(errors) <= target / 2)
    level = int(enough[0] if len(enough) else np.argmin(errors))
    rest = power * kept[:, level, None]
    taken = power - rest
    some = taken.any(1)
    n = 1
    while True:
        lights = LightSet(*divided(w[some], taken[some], n), 0.0)
        lit_by = receivers.seen(lights.w, (lights.power @ LUMINANCE)[:, None])[0][:, 0]
        found = error(shown[:, level] + lit_by - truth)
        if found <= target or n >= most or len(lights) >= some.sum():
            return SplitLight(Cells(w, rest), replace(lights, error=found))
        n *= 2


def unsplit(environment: Environment) -> SplitLight:
    """All of an environment is filtered; no error is estimated."""
    return SplitLight(Cells(*environment.cells()), LightSet(np.zeros((0, 3)), np.zeros((0, 3)), None))


def _kept(radiance: np.ndarray, mean: float) -> np.ndarray:
    """Share of each cell that stays for each threshold, shape (n, levels); everything stays at the first."""
    thresholds = np.array([np.inf, *radiance.max() * 0.5 ** np.arange(1, OCTAVES)])
    thresholds = thresholds[thresholds > mean]
    return np.minimum(1, thresholds / np.maximum(radiance, 1e-30)[:, None])


class _Receivers:
    """Random lobes over random surfaces: what they see of lights, and what the filtered maps show.

    Nothing diffuse, which would hide their error: a metal has no such part. The maps' own resolution is left out: it is
    a tenth of what the horizon costs.
    """

    def __init__(self, edge: float, cosine: bool) -> None:
        rng = np.random.default_rng(0)
        normal, axis = rng.normal(size=(2, RECEIVERS, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        height = np.einsum("ni,ni->n", axis, normal)
        axis *= np.where(height < 0, -1, 1)[:, None]
        self.edge, self.cosine = edge, cosine
        self.normal, self.axis, self.height = normal, axis, np.abs(height)
        self.exponent = LARGEST ** rng.random(RECEIVERS)
        clipped = prefilter.clipped_lobes(edge, cosine=cosine)
        outwards = axis - self.height[:, None] * normal
        out = np.linalg.norm(outwards, axis=1, keepdims=True)
        outwards /= out
        frame = np.stack([outwards, np.cross(normal, outwards), normal], -1)
        local = np.concatenate([out, np.zeros_like(out), self.height[:, None]], 1)
        self.share, axes, position = prefilter.stand_ins(clipped, local, self.exponent)
        self.moved = [np.einsum("nij,nj->ni", frame, one) for one in axes]
        self.low, self.between = prefilter.between(position, prefilter.SLICES)

    def seen(self, w: np.ndarray, luminance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What receivers see of lights, and what maps show of them; (n, 3), (n, k) -> two of (RECEIVERS, k)."""
        true, shown = np.zeros((2, RECEIVERS, luminance.shape[1]))
        single = [a.astype(np.float32) for a in (self.normal, self.axis, *self.moved)]
        exponents = prefilter.exponents().astype(np.float32)
        low, high = exponents[self.low, None], exponents[self.low + 1, None]
        f = self.between[:, None]
        # Shares are of lobes whose integral over the sphere is 2π / (n + 1), which is π after this scale.
        scale = (self.exponent[:, None] + 1) / 2
        with np.errstate(under="ignore"), one_blas_thread():
            for first in range(0, len(w), BLOCK):
                part = slice(first, first + BLOCK)
                some = luminance[part]
                z, along, *moved = (a @ w[part].T.astype(np.float32) for a in single)
                true[...] += scale * (self._lobe(z, along) @ some)
                for logs in map(_log, moved):
                    mean = (1 - f) * (low + 1) * (np.exp(low * logs) @ some)
                    mean += f * (high + 1) * (np.exp(high * logs) @ some)
                    shown[...] += self.share[:, None] / 4 * mean
        return true, shown

    def _lobe(self, z: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Lobes of lights at heights ``z`` above the receivers' horizons, held and faded below the edge."""
        radius = np.sqrt(max(1 - self.edge**2, 0))
        below = z < self.edge
        a = np.where(below, radius / np.sqrt(np.maximum(1 - z * z, 1e-12)), 1)
        cosine = a * along + np.where(below, self.edge - a * z, 0) * self.height[:, None].astype(np.float32)
        fade = np.where(below, np.maximum(z, 0) / max(self.edge, 1e-30), 1)
        if self.cosine:
            fade = fade * np.maximum(z, self.edge)
        return fade * np.exp(self.exponent[:, None].astype(np.float32) * _log(cosine))


def _log(cosine: np.ndarray) -> np.ndarray:
    """Logarithms of cosines for powers of them, at least 1: far faster than powers. What is not positive is nothing."""
    return np.log(np.maximum(cosine, np.float32(1e-30)))
