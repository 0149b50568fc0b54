"""What maps reflect: the largest albedo of a representation, and what of it is too much, with derivatives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere.quadrature import gauss_hemisphere

if TYPE_CHECKING:
    from btfref.refining.variables import Variables
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray

#: Texels, views and rule over the lights of the check.
TEXELS, VIEWS, RULE = 64, 6, (5, 12)

#: Pairs of a place and a view at which a step looks.
PLACES = 128

#: Share of the limit that albedos may have for nothing.
FREE = 0.97

#: What the mean square of the excess over the limit counts, in losses of the start.
WEIGHT = 300.0


def largest_albedo(representation: Representation, seed: int = 0) -> float:
    """Largest ``∫ B dω_light`` of some texels and views, by quadrature over the lights; 1 is a white surface."""
    rng = np.random.default_rng([seed, 7])
    light, weight = gauss_hemisphere(*RULE)
    uv = rng.random((TEXELS, 1, 1, 2))
    value = representation.evaluate(uv, light[None, None], _views(rng, VIEWS)[None, :, None])
    return float(np.einsum("tvlc,l->tvc", value, weight).max())


def excess(variables: Variables, limit: float, rng: np.random.Generator) -> JitArray:
    """Mean square of what albedos at random places and views are above a limit, relative to it.

    Parameters
    ----------
    variables : Variables
        Of the maps as they are put.
    limit : float
    rng : numpy.random.Generator

    Returns
    -------
    Float
        With derivatives by the variables.
    """
    import drjit as dr
    import mitsuba as mi

    light, weight = gauss_hemisphere(*RULE)
    n = len(light)
    uv, view = rng.random((PLACES, 2)), _views(rng, PLACES)
    at = to_device(mi.Point2f, np.repeat(uv, n, 0).T)
    w_light = to_device(mi.Vector3f, np.tile(light, (PLACES, 1)).T)
    w_view = to_device(mi.Vector3f, np.repeat(view, n, 0).T)
    value = variables.evaluator.evaluate(at, w_light, w_view, mi.Bool(True))
    share = to_device(mi.Float, np.tile(weight, PLACES))
    over = [dr.maximum(dr.block_sum(c * share, n) * (1 / limit) - FREE, 0) for c in value]
    return dr.mean(sum(dr.square(c) for c in over))


def _views(rng: np.random.Generator, n: int) -> np.ndarray:
    """Random views that are not next to the horizon, shape (n, 3)."""
    z, phi = rng.uniform(0.1, 1, n), rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
