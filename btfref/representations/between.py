"""How wrong a fit is between its samples: at random directions and texels, where renders look.

The error at the samples, which every fit states, says nothing of what a method does between them. The yardstick here is
the data's own interpolation, what :mod:`btfref.representations.tabulated.raw` returns. On coarse grids that smears
highlights and is no truth itself; ``btfref bench between`` measures both against path-traced values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.representations.lookup import CHUNK
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike

    from btfref.registry import Method
    from btfref.representations.protocol import Representation
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress


#: Random lookups: 16 of them lie above the 99.9th percentile.
LOOKUPS = 1 << 14

#: Random texels and views whose directional albedo is measured, and the rule over the lights: 13 degrees between nodes
#: of one polar angle, which a lobe of cos¹⁰⁰ fills.
ALBEDOS, ALBEDO_RULE = 128, (8, 28)


def fit(
    method: Method, btf: BTFBlocks, *, seed: int = 0, progress: Progress | None = None, **parameters: Any
) -> Representation:
    """Fit a method, and say in its file how wrong it is between the samples.

    Parameters
    ----------
    method : btfref.registry.Method
    btf : BTFBlocks
    seed, progress, **parameters
        Of the method's ``fit``.

    Returns
    -------
    Representation
        ``meta["fit"]["between_samples"]`` holds what :func:`measure` finds; all else is as the method made it.
    """
    with reproducible():
        made = method.fit(btf, seed=seed, progress=progress, **parameters)
    facts = dict(made.meta.get("fit", {})) | {"between_samples": measure(made, btf)}
    return method.representation.from_arrays(made.arrays(), {**made.meta, "fit": facts})


class Evaluates(Protocol):
    """What is measured: anything with the ``evaluate`` of a representation."""

    def evaluate(self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.Representation.evaluate`."""


def measure(representation: Evaluates, btf: BTFBlocks, *, seed: int = 0) -> dict[str, float]:
    """Figures of a representation at random directions, uniform on the hemisphere, and at random texels.

    Parameters
    ----------
    representation : Representation
        Or anything with its ``evaluate``.
    btf : BTFBlocks
        What it was fitted to.
    seed : int
        Of the lookups: equal seeds, equal lookups.

    Returns
    -------
    dict of str to float
        ``peak`` and ``peak_p999``: largest value and 99.9th percentile of |B|, over the data's largest value;
        ``mean_ratio``: mean of B over that of the data's interpolation; ``rms_to_data``: RMS difference to that
        interpolation over its RMS; ``albedo``: the largest directional albedo, ∫ B over the lights, of a texel, view
        and channel, ``data_albedo``, that of the interpolation at the same places, which coarse grids take above 1 by
        themselves, and ``albedo_excess``, the one over the other or over 1, whichever is more;
        ``negative_fraction``: share of negative values. NaN where data without light leave no quotient.
    """
    rng = np.random.default_rng(seed)
    with reproducible():
        uv, texel = _texels(rng, LOOKUPS, btf)
        w_light, w_view = _uniform(rng, LOOKUPS), _uniform(rng, LOOKUPS)
        found = representation.evaluate(uv, w_light, w_view)
        lookups = texel, w_light, w_view
        uv, texel = _texels(rng, ALBEDOS, btf)
        w_view = _uniform(rng, ALBEDOS)
        lights, weight = gauss_hemisphere(*ALBEDO_RULE)
        w_light = _turned(lights, 2 * np.pi * rng.random(ALBEDOS))
        albedo = weight @ representation.evaluate(uv[:, None], w_light, w_view[:, None])
        albedos = (
            np.repeat(texel, len(lights)),
            w_light.reshape(-1, 3),
            np.repeat(w_view, len(lights), 0),
        )
        # All of them in one pass over the data.
        everything = [np.concatenate(pair) for pair in zip(lookups, albedos, strict=True)]
        data, largest = _from_data(btf, *everything)
        raw = data[:LOOKUPS]
        data_albedo = weight @ data[LOOKUPS:].reshape(ALBEDOS, -1, 3)
    size = np.abs(found)
    return {
        "peak": _over(size.max(), largest),
        "peak_p999": _over(np.quantile(size, 0.999), largest),
        "mean_ratio": _over(found.mean(), raw.mean()),
        "rms_to_data": _over(np.sqrt(np.mean((found - raw) ** 2)), np.sqrt(np.mean(raw**2))),
        "albedo": float(albedo.max()),
        "data_albedo": float(data_albedo.max()),
        "albedo_excess": float(albedo.max() / max(data_albedo.max(), 1.0)),
        "negative_fraction": float(np.mean(found < 0)),
    }


def interpolated(btf: BTFBlocks, texel: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
    """The data of some texels, interpolated over directions as by all tabulated methods.

    Parameters
    ----------
    btf : BTFBlocks
    texel : ndarray of int, shape (n,)
        Flat indices.
    w_light, w_view : ndarray, shape (n, 3)

    Returns
    -------
    ndarray of float64, shape (n, 3)
    """
    return _from_data(btf, texel, w_light, w_view)[0]


def _from_data(
    btf: BTFBlocks, texel: np.ndarray, w_light: np.ndarray, w_view: np.ndarray
) -> tuple[np.ndarray, float]:
    """:func:`interpolated`, and the largest value of all, in one pass over the views."""
    (view, view_weight), (light, light_weight) = (
        btf.views.stencil(w_view),
        btf.lights.stencil(w_light, hold=False),
    )
    found = np.zeros((*view.shape, light.shape[1], 3))
    largest = -np.inf
    for index, (peak, values) in enumerate(
        over_blocks(btf, _of_view, (view, light, texel), range(len(btf.views)))
    ):
        largest = max(largest, peak)
        found[np.nonzero(view == index)] = values
    result = np.zeros((len(texel), 3))
    for start in range(0, len(texel), CHUNK):
        part = slice(start, start + CHUNK)
        result[part] = np.einsum("nv,nl,nvlc->nc", view_weight[part], light_weight[part], found[part])
    return result, largest


def _of_view(
    btf: BTFBlocks, lookups: tuple[np.ndarray, np.ndarray, np.ndarray], index: int
) -> Iterator[tuple[float, np.ndarray]]:
    """The largest value of a view, and those that lookups need of it, (lookups, lights, 3)."""
    view, light, texel = lookups
    values = btf.view(index)
    lookup, _ = np.nonzero(view == index)
    flat = values.reshape(len(values), -1, 3)
    yield float(np.max(values)), flat[light[lookup], texel[lookup, None]]


def _texels(rng: np.random.Generator, n: int, btf: BTFBlocks) -> tuple[np.ndarray, np.ndarray]:
    """Random texels' centres and flat indices."""
    rows, columns = btf.texels
    row, column = rng.integers(0, rows, n), rng.integers(0, columns, n)
    return np.stack([(column + 0.5) / columns, (row + 0.5) / rows], -1), row * columns + column


def _uniform(rng: np.random.Generator, n: int) -> np.ndarray:
    """Directions of the upper hemisphere, uniform in solid angle, shape (n, 3)."""
    z, phi = 1 - rng.random(n), 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


def _turned(w: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Directions turned about the normal, shapes (n, 3), (m,) -> (m, n, 3): a rule's nodes fall elsewhere each time."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y, z = w.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, np.broadcast_to(z, (len(angle), len(z)))], -1)


def _over(value: float, whole: float) -> float:
    return float(value / whole) if whole > 0 else float("nan")
