"""A pilot that finds out where direct light varies inside texels: there points are needed most."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.sampling.surface.points import texel_of

if TYPE_CHECKING:
    from btfref.sampling.surface.lobes import BroadLobes
    from btfref.sampling.surface.points import Points
    from btfref.sampling.surface.walks import Surface

#: Pairs of directions of the pilot, and the most evaluations of a BSDF at once.
PAIRS, TOGETHER = 64, 1 << 22

#: Seed of the choice of pairs: the same for every part of a BTF.
_SEED = 2003


def contrast(
    surface: Surface,
    points: Points,
    lobes: BroadLobes,
    directions: np.ndarray,
    visible: np.ndarray,
    texels: tuple[int, int],
) -> np.ndarray:
    """Spread of direct light inside texels, as the density of points feels it.

    Parameters
    ----------
    surface : Surface
        Centroids of the small triangles.
    points : Points
        The same in NumPy; ``weight`` holds areas.
    lobes : BroadLobes
    directions : ndarray (n, 3)
        Above the horizon; views and lights are drawn among them.
    visible : ndarray (n, T) bool
    texels : tuple of int
        Rows and columns.

    Returns
    -------
    ndarray (T,)
        ``√mean ((n·v)/v_z)² V (L − L̄)²`` over pairs, with L̄ the mean over two by two texels: with points drawn
        in proportion the variance of the sum over all texels is least (Neyman's allocation).
    """
    n, count = len(directions), len(points.weight)
    rng = np.random.default_rng(_SEED)
    pairs = rng.integers(0, n, (PAIRS, 2))
    groups = -(-texels[0] // 2), -(-texels[1] // 2)
    result = np.zeros(count)
    step = max(1, TOGETHER // count)
    for first in range(0, PAIRS, step):
        some = pairs[first : first + step]
        radiance = _direct(surface, lobes, directions, some)
        for (view, light), value in zip(some, radiance, strict=True):
            w = directions[view]
            scale = np.where(visible[view], np.abs(points.n @ w) / w[2], 0.0)
            group = texel_of(points.p, w, groups)
            share = scale * points.weight
            value = np.where(visible[light], value, 0.0)
            size = groups[0] * groups[1]
            total, sums = (np.bincount(group, a, size) for a in (share, share * value))
            mean = sums / np.maximum(total, 1e-30)
            result += (scale * (value - mean[group])) ** 2
    return np.sqrt(result / PAIRS)


def _direct(surface: Surface, lobes: BroadLobes, directions: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Mean over channels of BSDF times cosine at all records for pairs (view, light): (pairs, records)."""
    import drjit as dr
    import mitsuba as mi

    n_records = dr.width(surface.number)
    lane = dr.arange(mi.UInt32, n_records * len(pairs))
    records = dr.opaque(mi.UInt32, n_records)
    si, bsdf, _, _ = surface.interaction(lane % records)
    view, light = (
        dr.gather(mi.Vector3f, to_device(mi.Float, directions[index].ravel()), lane // records)
        for index in pairs.T
    )
    si.wi = si.to_local(view)
    value = dr.mean(bsdf.eval(lobes.full, si, si.to_local(light)))
    return value.numpy().reshape(len(pairs), n_records).astype(np.float64)
