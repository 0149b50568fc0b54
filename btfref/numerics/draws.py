"""Drawn interpolation: one neighbour of a lookup instead of all, by a number that is a hash.

Stochastic texture filtering (M. Fajardo, B. Wronski, M. Salvi, M. Pharr, "Stochastic Texture Filtering", 2023; M.
Pharr, B. Wronski, M. Salvi, M. Fajardo, "Filtering After Shading with Stochastic Texture Filtering", 2024): a neighbour
is drawn with the interpolation's own weights, so that the expectation over draws is the blended value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

#: The smallest normal float32: some ports flush what is smaller to 0.
LEAST = float(np.finfo(np.float32).tiny)


def chosen(index: np.ndarray, weight: np.ndarray, draw: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The drawn neighbour of a stencil, with the weight of all.

    Parameters
    ----------
    index : ndarray of int, shape (..., n)
    weight : ndarray, shape (..., n)
        Non-negative.
    draw : array_like, shape (...)
        In [0, 1): the k-th neighbour is drawn where the share of those before it is at most ``draw``. One without
        weight is never drawn.

    Returns
    -------
    index : ndarray of int, shape (..., 1)
    weight : ndarray, shape (..., 1)
        The sum of the weights, so that the mean over uniform draws is the sum over the stencil.
    """
    before = np.cumsum(weight, -1) - weight
    total = weight.sum(-1, keepdims=True)
    reached = (np.asarray(draw, weight.dtype)[..., None] * total >= before) & (weight > 0)
    reached[..., 0] |= ~reached.any(-1)
    last = weight.shape[-1] - 1 - np.argmax(reached[..., ::-1], -1)[..., None]
    return np.take_along_axis(index, last, -1), total


def hashed(words: ArrayLike) -> np.ndarray:
    """A number in [0, 1) of four words.

    The hash pcg4d (M. Jarzynski and M. Olano, "Hash Functions for GPU Rendering", JCGT 9(3), 2020): whole numbers
    alone, so that all evaluators find the same.

    Parameters
    ----------
    words : array_like of uint32, shape (..., 4)

    Returns
    -------
    ndarray of float64, shape (...)
        A multiple of 2⁻²⁴, which a float32 holds.
    """
    a, b, c, d = np.moveaxis(np.asarray(words, np.uint32), -1, 0)
    with np.errstate(over="ignore"):
        a, b, c, d = (x * np.uint32(1664525) + np.uint32(1013904223) for x in (a, b, c, d))
        for last in (False, True):
            a = a + b * d
            b = b + c * a
            c = c + a * b
            d = d + b * c
            if not last:
                a, b, c, d = (x ^ (x >> np.uint32(16)) for x in (a, b, c, d))
    return (a >> np.uint32(8)) * 2.0**-24


def of_lookups(uv: ArrayLike, w_view: ArrayLike) -> np.ndarray:
    """The draw of a lookup in the path tracer: the same for all lights.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
    w_view : array_like, shape (..., 3)
        Local frame. Both are rounded to float32; their bits are hashed, so that a neighbouring number is another draw.
        What is no normal number counts as 0, whose sign is lost.

    Returns
    -------
    ndarray of float64, shape (...)
    """
    uv, xy = np.broadcast_arrays(np.asarray(uv, np.float32), np.asarray(w_view, np.float32)[..., :2])
    numbers = np.concatenate([uv, xy], -1)
    return hashed(np.where(np.abs(numbers) >= LEAST, numbers, np.float32(0)).view(np.uint32))


def of_pixels(height: int, width: int, frame: int, seed: int = 0) -> np.ndarray:
    """The draws of a frame in real time, shape (height, width), row 0 at the top.

    Parameters
    ----------
    height, width : int
        Of the picture.
    frame : int
        Number of the frame, from 0.
    seed : int
    """
    row, column = np.mgrid[:height, :width]
    words = [column, row, np.full_like(row, frame), np.full_like(row, seed)]
    return hashed(np.stack(words, -1))
