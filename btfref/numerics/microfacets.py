"""Ashikhmin's distribution-based BRDF over parabolic tables of normal distributions, and what bounds its albedo.

Source: M. Ashikhmin, "Distribution-based BRDFs", 2006, as in Menzel and Guthe 2009, eq. 1 and 2:
``ρ = c_d/π + c_s p(h) F(k1·h) / (k1·n + k2·n − (k1·n)(k2·n))``, ``F(u) = r0 + (1 − r0)(1 − u)^5``.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from btfref.numerics.sphere.parabolic import (
    bilinear_stencil,
    solid_angle_density,
    square_to_hemisphere,
    texel_centres,
)

#: Points per side of a texel of a distribution over which its share of the albedo is integrated.
_FINE = 4

#: View directions at which the albedo is bounded: polar angles, azimuths. Views behind the shading normal count too.
_N_THETA, _N_PHI = 28, 24

#: What the albedo may exceed the largest of these by: it is smooth in the view, and the grid leaves 2 % (measured).
_MARGIN = 1.05


def geometry_factor(cos_light: ArrayLike, cos_view: ArrayLike) -> np.ndarray:
    """``k1·n / (k1·n + k2·n − (k1·n)(k2·n))`` in [0, 1]: light's cosine over the denominator of the BRDF.

    Parameters
    ----------
    cos_light : array_like
        k1·n; 0 where not positive.
    cos_view : array_like
        k2·n, held at 0: a shading normal may turn away from a viewer who sees the point.

    Returns
    -------
    ndarray
        Without a singularity: for k1·n > 0 the denominator is at least k1·n.
    """
    light, view = np.maximum(cos_light, 0), np.maximum(cos_view, 0)
    # In this form no rounding takes it below the light's cosine, nor the factor beyond 1.
    denominator = light + view * (1 - light)
    return np.where(light > 0, light / np.where(light > 0, denominator, 1), 0.0)


def schlick(u: np.ndarray, r0: np.ndarray | float) -> np.ndarray:
    """Schlick's Fresnel term ``r0 + (1 − r0)(1 − u)^5`` of the cosine u in [0, 1]."""
    return r0 + (1 - r0) * fifth_power(u)


def fifth_power(u: ArrayLike) -> np.ndarray:
    """``(1 − u)^5`` for u held in [0, 1]."""
    v = 1 - np.clip(u, 0, 1)
    square = v * v
    return square * square * v


def specular_albedo_bound(ndf: ArrayLike, r0: ArrayLike) -> np.ndarray:
    """Upper bound, over all views, of the albedo of ``p(h) F(k1·h) k1·n / D``.

    Parameters
    ----------
    ndf : ndarray, shape (m, n, n, channels)
        Parabolic tables of p, non-negative.
    r0 : ndarray, shape (k,)
        Reflectances at normal incidence in [0, 1].

    Returns
    -------
    ndarray, shape (m, k)
        The largest of the channels. Since ``dω_l = 4 (k2·h) dω_h``, the albedo is ``4 ∫ p F g (k2·h) dω_h``: linear in
        the texels of p and in r0. A mirror-like p of integral 1 has up to 4 for r0 = 1.
    """
    ndf, r0 = np.asarray(ndf, float), np.asarray(r0, float)
    m, n, _, channels = ndf.shape
    table = np.moveaxis(ndf.reshape(m, n * n, channels), 1, 0).reshape(n * n, -1)
    constant, at_grazing = (operator @ table for operator in _albedo_operators(n))
    result = np.stack([(r * constant + (1 - r) * at_grazing).max(0) for r in r0], -1)
    return _MARGIN * result.reshape(m, channels, -1).max(1)


@lru_cache(maxsize=8)
def _albedo_operators(n: int) -> np.ndarray:
    """Albedo of each view for a unit value in each texel of an n × n table, two of shape (views, n²).

    For F = 1, and for F = (1 − u)^5.
    """
    fine = n * _FINE
    st = texel_centres(fine).reshape(-1, 2)
    st = st[(st * st).sum(-1) < 1]
    h = square_to_hemisphere(st)
    solid_angle = solid_angle_density(st) * (2 / fine) ** 2
    solid_angle *= 2 * np.pi / solid_angle.sum()
    texel, share = bilinear_stencil(h, n)
    theta = (np.arange(_N_THETA) + 0.5) * (np.pi / 2 / (_N_THETA - 4))
    phi = np.arange(_N_PHI) * (2 * np.pi / _N_PHI)
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    views = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    result = np.zeros((2, len(views), n * n))
    for row, view in enumerate(views):
        cosine = np.maximum(h @ view, 0)
        factor = geometry_factor(2 * cosine * h[:, 2] - view[2], view[2])
        amount = 4 * cosine * factor * solid_angle
        for operator, values in zip(result, (amount, amount * fifth_power(cosine)), strict=True):
            operator[row] = np.bincount(texel.ravel(), (share * values[:, None]).ravel(), minlength=n * n)
    return result


def isotropic_ndf(roughness: float, n: int = 32) -> np.ndarray:
    """Table of an isotropic GGX distribution times cos θ, whose integral is 1, shape (n, n).

    Parameters
    ----------
    roughness : float
        GGX α in (0, 1].
    n : int
    """
    from btfref.numerics.sphere.parabolic import texel_directions, texel_solid_angles

    z = np.maximum(texel_directions(n)[..., 2], 0)
    a2 = roughness * roughness
    p = z * a2 / (np.pi * (z * z * (a2 - 1) + 1) ** 2)
    total = (p * texel_solid_angles(n)).sum()
    return p / total
