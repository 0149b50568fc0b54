"""Random lookups that cover the hard places: grazing, poles, seams and exact sample directions."""

from __future__ import annotations

import numpy as np

from btfref.representations.protocol import Spreads


def hemisphere(rng, n):
    """Uniform directions on the upper hemisphere, float32, shape (n, 3)."""
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2])
    return unit(w)


def unit(w):
    """Normalised in float64, then rounded to float32: what a port receives."""
    return (w / np.linalg.norm(w, axis=-1, keepdims=True)).astype(np.float32)


def probe_points(rng, n, views, lights):
    """``(uv, w_light, w_view)`` float32: a tenth each grazing, at the pole, at samples, midway and on seams.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
    views, lights : DirectionSet
    """
    uv = rng.uniform(-2, 3, (n, 2))
    result = []
    for directions in (lights, views):
        w = hemisphere(rng, n).astype(float)
        kind = rng.integers(0, 10, n)
        grazing, pole, sample, middle, seam = (kind == k for k in range(5))
        w[grazing, 2] *= 10 ** rng.uniform(-6, -1, grazing.sum())
        w[pole, :2] *= 10 ** rng.uniform(-7, -2, (pole.sum(), 1))
        pick = rng.integers(0, len(directions), (2, n))
        w[sample] = directions.vectors[pick[0, sample]]
        w[middle] = directions.vectors[pick[0, middle]] + 0.999 * directions.vectors[pick[1, middle]]
        w[seam, 1] = 0
        result.append(unit(w))
    seam = rng.integers(0, 10, n) == 0
    uv[seam] = np.round(uv[seam])
    return uv.astype(np.float32), *result


def hit_allowance(representation, value, reference, points):
    """Differences within the stated tolerance of a hit, for methods with geometry; None for the others.

    Where ``value`` and ``reference`` agree to float32 anyway nothing is needed, and nothing is allowed.
    """
    if not isinstance(representation, Spreads):
        return None
    scale = np.maximum(np.abs(reference), 1e-3 * np.abs(reference).max())
    differs = (np.abs(np.reshape(value, reference.shape) - reference) > 1e-6 * scale).any(-1)
    result = np.zeros_like(reference)
    result[differs] = representation.spread(*(a[differs] for a in points))
    return result
