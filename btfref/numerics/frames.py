"""Tangent frames, identical to Mitsuba's shading frame (``SurfaceInteraction.initialize_sh_frame``)."""

from __future__ import annotations

import numpy as np


def shading_frame(normal, dp_du):
    """Orthonormal frame from a shading normal and the tangent ∂p/∂u.

    Parameters
    ----------
    normal : array_like, shape (..., 3)
        Unit shading normal n.
    dp_du : array_like, shape (..., 3)
        Derivative of the position with respect to u; any length, not parallel to the normal.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Rows s, t, n with ``s = normalize(dp_du − n (n · dp_du))`` and ``t = n × s``: the matrix takes world vectors
        to the local frame.
    """
    normal, dp_du = np.asarray(normal, float), np.asarray(dp_du, float)
    s = dp_du - normal * (normal * dp_du).sum(-1, keepdims=True)
    s = s / np.linalg.norm(s, axis=-1, keepdims=True)
    return np.stack([s, np.cross(normal, s), normal], -2)


def nearest_rotation(linear):
    """The rotation nearest to a linear map of texture coordinates (its polar factor).

    By this angle local directions turn about the normal to reach the frame of a transformed texture.

    Parameters
    ----------
    linear : array_like, shape (2, 2)
        With a positive determinant.

    Returns
    -------
    tuple of float
        Cosine and sine of the angle.
    """
    (a, b), (c, d) = np.asarray(linear, float).tolist()
    cosine, sine = a + d, c - b
    length = float(np.hypot(cosine, sine))
    return (cosine / length, sine / length) if length > 0 else (1.0, 0.0)
