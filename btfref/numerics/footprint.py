"""Level of detail from what a pixel sees of a texture: its footprint, or the distance alone.

The footprint of a pixel that subtends the angle α at distance d is a disk of diameter αd across the ray, which the
surface stretches by 1/cos θ along the ray's projection. Its map to texels is an ellipse (P. S. Heckbert, "Survey of
Texture Mapping", IEEE CG&A 1986). As in anisotropic filtering, lookups at the level of the shorter axis are spread
along the longer one, up to `ANISOTROPY` of them; beyond that, the level gives way.

λ is where the variances of two filters agree. A pixel of W texels has W²/12, and the finest level's bilinear filter
adds 1/6. Level λ has (4^λ − 1)/4 from the binomial kernels (1 3 3 1)/8, of variance 3/4 each, and 4^λ/6 from its own
bilinear filter. Hence ``λ = ½ log2(1 + W²/5)``. For large W that is log2 W − 1.16: with log2 W itself, a
level would blur five times as much as the pixel, in variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

#: How a renderer chooses λ. "distance" is log2 of the distance (Ma et al. 2005, section 3.4).
MODES = ("auto", "distance", "none")

#: Most lookups along the footprint's longer axis: odd, so that one is in its middle.
ANISOTROPY = 7.0

#: W² at which the level's own blur equals that of a pixel: see above.
BLUR = 5.0

#: Squared lengths below this count as this.
TINY = 1e-30


def cone_footprint(
    gradient_u: ArrayLike, gradient_v: ArrayLike, w_view: ArrayLike, normal: ArrayLike, width: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Footprint of a pixel on a plane.

    Parameters
    ----------
    gradient_u, gradient_v : array_like, shape (..., 3)
        Gradients of the texel coordinates (u · columns, v · rows) in the tangent plane, texels per unit length.
    w_view : array_like, shape (..., 3)
        Unit vector towards the viewer.
    normal : array_like, shape (..., 3)
        Unit geometric normal.
    width : array_like, shape (...)
        Of the pixel at the surface, across the ray.

    Returns
    -------
    lod, step, ratio
        See :func:`ellipse_footprint`.
    """
    u, v, w, n = (np.asarray(a, float) for a in (gradient_u, gradient_v, w_view, normal))
    dot = lambda a, b: (a * b).sum(-1)  # noqa: E731
    # A disk on the plane, and what the slant adds along the ray's projection.
    stretch = 1 / np.maximum(dot(w, n) ** 2, TINY)
    square = np.asarray(width, float) ** 2
    uu = dot(u, u) + dot(u, w) ** 2 * stretch
    uv = dot(u, v) + dot(u, w) * dot(v, w) * stretch
    vv = dot(v, v) + dot(v, w) ** 2 * stretch
    return ellipse_footprint(square * uu, square * uv, square * vv)


def ellipse_footprint(
    uu: ArrayLike, uv: ArrayLike, vv: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level of detail and lookups for an elliptic footprint.

    Parameters
    ----------
    uu, uv, vv : array_like, shape (...)
        Entries of the symmetric matrix whose eigenvalues are the squared axes in texels.

    Returns
    -------
    lod : ndarray of float64, shape (...)
        ≥ 0, not clamped above.
    step : ndarray of float64, shape (..., 2)
        Between lookups along the longer axis, in texels.
    ratio : ndarray of float64, shape (...)
        Of the footprint's length to a step, 1 to `ANISOTROPY`; see :func:`probe_weight`.
    """
    uu, uv, vv = (np.asarray(a, float) for a in (uu, uv, vv))
    difference = 0.5 * (uu - vv)
    longer = np.maximum(0.5 * (uu + vv) + np.sqrt(difference**2 + uv**2), TINY)
    shorter = np.maximum(uu * vv - uv * uv, TINY) / longer
    ratio = np.sqrt(np.clip(longer / np.maximum(shorter, TINY), 1, ANISOTROPY**2))
    square = longer / ratio**2
    axis = np.where((uu >= vv)[..., None], np.stack([longer - vv, uv], -1), np.stack([uv, longer - uu], -1))
    axis = axis / np.sqrt(np.maximum((axis**2).sum(-1, keepdims=True), TINY))
    return 0.5 * np.log2(1 + square / BLUR), np.sqrt(square)[..., None] * axis, ratio


def probe_weight(j: float, ratio: np.ndarray) -> np.ndarray:
    """Weight of the lookup ``j`` steps from the middle; the weights of all whole j sum to 1, continuously in ratio."""
    return np.clip(0.5 * ratio + 0.5 - abs(j), 0, 1) / ratio
