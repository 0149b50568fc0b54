"""Held-out directions: fit to a part of the directions, measure at the rest.

Every second azimuth of every ring is left out, for views and for lights. Of what is left a method is fitted; the
error at pairs whose view and light were both left out is its error of interpolation *and* compression where no
sample was, which the error at its own samples hides. The tabulated BTF, interpolated, is what the same samples give
without compression.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts


#: Pairs of directions that are measured at most; texels are all taken.
PAIRS = 600


def split(directions: DirectionSet) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the directions that a fit sees, and of those held out.

    Parameters
    ----------
    directions : DirectionSet
        On rings; each keeps every second direction, so that it stays a ring where its count is even.

    Returns
    -------
    kept, held_out : ndarray of int
    """
    if directions.rings is None:
        index = np.arange(len(directions))
        return index[index % 2 == 0], index[index % 2 == 1]
    kept = np.zeros(len(directions), bool)
    for _, _, count, first in directions.rings.astype(int):
        kept[first : first + count : 2 if count % 2 == 0 else 1] = True
    return np.flatnonzero(kept), np.flatnonzero(~kept)


def held_out_error(
    fit: Callable[[SampledBTF], Representation], btf: SampledBTF, *, texels: int, seed: int = 0
) -> Facts:
    """Errors of a fit at the samples that it saw, and at those that it did not.

    Parameters
    ----------
    fit : callable
        ``SampledBTF -> Representation``.
    btf : SampledBTF
    texels : int
        Rows and columns that are taken, at most: every n-th, so that the tile stays a tile.
    seed : int
        Of the choice of pairs.

    Returns
    -------
    dict
        ``seen`` and ``held_out``, each ``rmse`` over the RMS of all values and ``mae``, the mean absolute error over
        their mean (highlights decide the one, what is left the other); ``views``, ``lights``: numbers kept and held
        out.
    """
    from btfref.numerics.sphere.directions import directions

    rows, columns = (slice(None, None, max(1, n // texels)) for n in btf.values.shape[2:4])
    values = btf.values[:, :, rows, columns]
    parts = {"views": split(btf.views), "lights": split(btf.lights)}
    (views, other_views), (lights, other_lights) = parts.values()
    part = replace(
        btf,
        values=np.ascontiguousarray(values[views][:, lights]),
        views=directions(btf.views.vectors[views]),
        lights=directions(btf.lights.vectors[lights]),
        variance=None,
    )
    representation = fit(part)
    rng, found = np.random.default_rng(seed), {}
    square, mean = np.sqrt(np.mean(np.square(values, dtype=np.float64))), np.mean(values, dtype=np.float64)
    for name, (v, light) in {"seen": (views, lights), "held_out": (other_views, other_lights)}.items():
        v, light = (a.ravel() for a in np.meshgrid(v, light, indexing="ij"))
        chosen = rng.permutation(len(v))[:PAIRS]
        error = _error(representation, btf, values, v[chosen], light[chosen])
        found[name] = {
            "rmse": float(np.sqrt(np.mean(error**2)) / square),
            "mae": float(np.mean(np.abs(error)) / mean),
        }
    return {**found, **{name: [len(a), len(b)] for name, (a, b) in parts.items()}}


def _error(
    representation: Representation, btf: SampledBTF, values: np.ndarray, views: np.ndarray, lights: np.ndarray
) -> np.ndarray:
    """Value − sample at texel centres; (pairs, texels, 3)."""
    n_rows, n_columns = values.shape[2:4]
    v, u = np.meshgrid(
        (np.arange(n_rows) + 0.5) / n_rows, (np.arange(n_columns) + 0.5) / n_columns, indexing="ij"
    )
    uv = np.stack([u, v], -1).reshape(1, -1, 2)
    w_light, w_view = btf.lights.vectors[lights][:, None], btf.views.vectors[views][:, None]
    value = representation.evaluate(uv, w_light, w_view)
    return value - values[views, lights].reshape(len(views), -1, 3).astype(np.float64)
