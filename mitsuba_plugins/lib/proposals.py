"""What a method proposes light directions by, beside the guide: cosine lobes, and reflection at microfacets.

A proposal has ``pdf(w_light, active)``, the density with respect to solid angle in 1/sr, and
``sample(sample1, sample2)``, a direction of that density. Densities that reach below the horizon are folded: what falls
there is mirrored up, so that no sample is lost and the density integrates to 1 over the hemisphere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plugins.lib.analytic import safe_power

if TYPE_CHECKING:
    from btfref.types import JitArray
    from mitsuba_plugins.lib.guide import LightGuide
    from mitsuba_plugins.protocol import Proposal


#: Least share of cosine sampling beside lobes: lights below the outermost measured ones are held, which the lobes
#: themselves do not follow, and bounds the weight of a sample by 10 times that of cosine sampling.
COSINE_SHARE = 0.1


class Guided:
    """The guide at one view: tables and their weights."""

    def __init__(self, guide: LightGuide, tables: list[tuple[JitArray, JitArray]]) -> None:
        self._guide, self._tables = guide, tables

    def pdf(self, w_light: JitArray, active: JitArray) -> JitArray:
        """Density in 1/sr."""
        return self._guide.pdf(self._tables, w_light, active)

    def sample(self, sample1: JitArray, sample2: JitArray) -> JitArray:
        """A direction of that density."""
        return self._guide.sample(self._tables, sample1, sample2)


class Mixture:
    """Two proposals, the first one with a given share.

    Parameters
    ----------
    first, second
        Proposals.
    share : float or Float
        Of the first, in [0, 1].
    """

    def __init__(self, first: Proposal, second: Proposal, share: JitArray) -> None:
        self._first, self._second, self._share = first, second, mi.Float(share)

    def pdf(self, w_light: JitArray, active: JitArray) -> JitArray:
        """Density in 1/sr."""
        other = self._second.pdf(w_light, active)
        return dr.lerp(other, self._first.pdf(w_light, active), self._share)

    def sample(self, sample1: JitArray, sample2: JitArray) -> JitArray:
        """A direction of that density."""
        first = sample1 < self._share
        rest = dr.select(first, sample1 / self._share, (sample1 - self._share) / (1 - self._share))
        rest = dr.clip(rest, 0, dr.one_minus_epsilon(mi.Float))
        return dr.select(first, self._first.sample(rest, sample2), self._second.sample(rest, sample2))


class CosineLobes:
    """A mixture of lobes ``max(a · l, 0)^n`` and of the cosine.

    Parameters
    ----------
    diffuse : Float
        Amount of the cosine: its albedo.
    lobes : list of (Vector3f, Float, Float)
        Unit axis, exponent ≥ 0 and peak of each, ≥ 0.
    """

    def __init__(self, diffuse: JitArray, lobes: list[tuple[JitArray, JitArray, JitArray]]) -> None:
        amounts = []
        for axis, exponent, peak in lobes:
            # What is above the horizon of a lobe's integral 2π / (n + 1): exact for n = 1.
            share = dr.clip(dr.fma(0.5 * axis.z, dr.sqrt(exponent), 0.5), 0.02, 1)
            amounts.append(peak * share * (2 * np.pi) / (exponent + 1))
        total = sum(amounts, mi.Float(0))
        diffuse = dr.maximum(diffuse, COSINE_SHARE / (1 - COSINE_SHARE) * total)
        total = total + diffuse
        # Not a number where a view is missing: then there is nothing to sample by, and the value is none either.
        known = (total > 0) & dr.isfinite(total)
        scale = dr.select(known, 1 / dr.select(known, total, 1), 0)
        self._lobes = [
            (axis, exponent, dr.select(known, amount * scale, 0))
            for (axis, exponent, _), amount in zip(lobes, amounts, strict=True)
        ]
        self._cosine = dr.select(known, diffuse * scale, 1)

    def pdf(self, w_light: JitArray, active: JitArray) -> JitArray:
        """Density in 1/sr."""
        density = self._cosine * dr.inv_pi * w_light.z
        for axis, exponent, share in self._lobes:
            cosine, down = dr.dot(axis, w_light), 2 * axis.z * w_light.z
            both = safe_power(cosine, exponent) + safe_power(cosine - down, exponent)
            density = dr.fma(share * (exponent + 1) * (0.5 / np.pi), both, density)
        return dr.select(active & (w_light.z > 0), density, 0)

    def sample(self, sample1: JitArray, sample2: JitArray) -> JitArray:
        """A direction of that density."""
        axis, exponent, cumulative = mi.Vector3f(0, 0, 1), mi.Float(1), self._cosine
        for following, n, share in self._lobes:
            # A lobe without a share is never chosen: its interval is empty.
            chosen = (sample1 >= cumulative) & (share > 0)
            axis, exponent = dr.select(chosen, following, axis), dr.select(chosen, n, exponent)
            cumulative = cumulative + share
        # The cosine's density is that of exponent 1 about the normal.
        log = dr.log2(dr.maximum(1 - sample2.x, 2.0**-24)) / (exponent + 1)
        cosine = dr.minimum(dr.exp2(log), 1)
        sine = dr.sqrt(dr.maximum(1 - cosine * cosine, 0))
        s, c = dr.sincos(sample2.y * (2 * np.pi))
        w = mi.Frame3f(axis).to_world(mi.Vector3f(sine * c, sine * s, cosine))
        return folded(w)


def folded(w: JitArray) -> JitArray:
    """A direction, mirrored up where it lies below the horizon; never on it."""
    return mi.Vector3f(w.x, w.y, dr.maximum(dr.abs(w.z), 1e-7))
