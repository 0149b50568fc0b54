"""Colour models of Bonn's DFMF files, undone as the data's owners do it (btflib, ``undecorrelate``).

Where public readers disagree the owners' definition counts: chroma of model 11 is U · (Y + ε), not U · Y + ε, and
nothing is clipped, so that reflectance above 1 survives.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

#: Added before a logarithm was taken.
EPSILON = 1e-5

NAMES = {
    0: "RGB",
    1: "YUV",
    2: "Lab",
    3: "PCA",
    4: "YCoCg",
    5: "spectral",
    6: "spectral, linear",
    9: "log Y, U, V",
    10: "log Y, log U, log V",
    11: "log Y, U/Y, V/Y",
    12: "log RGB",
}

#: Models of any number of channels; the others need three.
ANY_CHANNELS = (0, 5, 6, 12)

YUV_TO_RGB = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
_YCOCG_TO_RGB = np.array([[1, 1, -1], [1, 0, 1], [1, -1, -1]])


def undo(values: np.ndarray, model: int, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Channels before they were decorrelated.

    Parameters
    ----------
    values : ndarray of float32, shape (..., channels)
        As factored; may be overwritten.
    model : int
        Key of `NAMES`.
    mean, matrix : ndarray, shapes (3,) and (3, 3)
        Of the principal component analysis of colours (model 3).

    Returns
    -------
    ndarray of float32, same shape
        Infinite where an exponential overflows.
    """
    dtype = values.dtype.type
    if model == 0:
        return values
    if model == 2:
        from btfref.numerics.colour import rgb_from_lab_d50

        return rgb_from_lab_d50(values).astype(dtype)
    if model == 3:
        return values @ matrix.astype(dtype) + mean.astype(dtype)
    if model == 4:
        return values @ _YCOCG_TO_RGB.T.astype(dtype)
    if model in (5, 6):
        return _spectral(values, model)
    if model == 12:
        return np.exp(values) - dtype(EPSILON)
    if model in (9, 10, 11):
        luma = np.exp(values[..., :1])
        chroma = values[..., 1:]
        if model == 10:
            chroma = np.sign(chroma) * np.exp(np.abs(chroma)) * dtype(EPSILON)
        if model == 11:
            chroma = chroma * luma  # luma is still Y + ε
        values = np.concatenate([luma - dtype(EPSILON), chroma], -1)
    return values @ YUV_TO_RGB.T.astype(dtype)


def _spectral(values: np.ndarray, model: int) -> np.ndarray:
    """The first channel is the sum; the others are shares of it (5) or their deviation from equal shares (6)."""
    total, rest, n = values[..., :1], values[..., 1:], values.shape[-1]
    if model == 5:
        return np.concatenate([(1 - rest.sum(-1, keepdims=True)) * total, rest * total], -1)
    # As the owners' code has it: total · n for all, the first less the others' means.
    total = total * n
    return np.concatenate([total - rest.sum(-1, keepdims=True) / n, total + rest * total], -1)


def log_yuv(rgb: ArrayLike) -> np.ndarray:
    """Model 11 of linear colours: log(Y + ε), U / (Y + ε), V / (Y + ε); float32, same shape.

    Raises
    ------
    ValueError
        Where Y ≤ −ε: such colours have no logarithm.
    """
    yuv = np.asarray(rgb, np.float32) @ np.linalg.inv(YUV_TO_RGB).T.astype(np.float32)
    luma = yuv[..., :1] + np.float32(EPSILON)
    if not (luma > 0).all():
        raise ValueError("luminance that is not positive")
    return np.concatenate([np.log(luma), yuv[..., 1:] / luma], -1)
