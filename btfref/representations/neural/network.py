"""The network: code of directions, layers with gains and biases of each texel, and their derivatives.

One definition for all precisions: :mod:`btfref.representations.neural.definition` evaluates it in float64, the fit
trains it in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.sphere.halfway import half_difference

if TYPE_CHECKING:
    from collections.abc import Mapping

#: Numbers that code a pair of directions: light, view, half and difference vector.
CODE = 12

#: Slope of the hidden units below zero; a power of two, which no port rounds.
SLOPE = 0.125

#: Exponents of two are held within these: B is from 1e-6 to 1e6 times its scale and the light's cosine.
LOWEST, HIGHEST = -20.0, 20.0

#: Names of the matrices, from the code to the colours.
LAYERS = ("layer_1", "layer_2", "layer_3")


def channels(hidden: int) -> int:
    """Numbers of a texel: gains and biases of both hidden layers, and the biases of the colours."""
    return 4 * hidden + 3


def code(w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
    """What the first layer reads of a pair of directions.

    Parameters
    ----------
    w_light, w_view : ndarray, shape (n, 3)
        Held at the outermost measured cosines.

    Returns
    -------
    ndarray, shape (n, CODE)
        Light, view, half vector, and the light in the half vector's frame.
    """
    half, difference = half_difference(w_light, w_view)
    return np.concatenate([w_light, w_view, half, difference], -1)


def split(latent: np.ndarray) -> tuple[np.ndarray, ...]:
    """Gains and biases of the first hidden layer, of the second one, and biases of the colours."""
    hidden = (latent.shape[-1] - 3) // 4
    return tuple(np.split(latent, [hidden, 2 * hidden, 3 * hidden, 4 * hidden], -1))


def rectified(x: np.ndarray) -> np.ndarray:
    """Hidden units: x where it is positive, a fraction of it elsewhere."""
    return np.maximum(x, x * x.dtype.type(SLOPE))


def _rectify_slope(by_x: np.ndarray, x: np.ndarray) -> None:
    """Multiply a derivative by that of :func:`rectified`, of which ``x`` is the result; both are powers of two."""
    slope = (x > 0) * x.dtype.type(1 - SLOPE)
    slope += x.dtype.type(SLOPE)
    by_x *= slope


def _over_pairs(items: np.ndarray) -> np.ndarray:
    """Sum of (T, P, n) over the pairs; a product with ones, which adds whole rows at once."""
    return (np.ones((1, items.shape[1]), items.dtype) @ items)[:, 0]


def exponents(latent: np.ndarray, codes: np.ndarray, layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """Logarithms to base 2 of B over its scale and the light's cosine, not yet held.

    Parameters
    ----------
    latent : ndarray, shape (n, channels)
    codes : ndarray, shape (n, CODE)
    layers : mapping
        The matrices of :data:`LAYERS`.

    Returns
    -------
    ndarray, shape (n, 3)
    """
    gain_1, bias_1, gain_2, bias_2, colour = split(latent)
    x = rectified(gain_1 * (codes @ layers["layer_1"]) + bias_1)
    x = rectified(gain_2 * (x @ layers["layer_2"]) + bias_2)
    return x @ layers["layer_3"] + colour


def values(y: np.ndarray, cosine: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """B of exponents: ``scale · cos θ_light · 2^y``, shapes (..., 3), (...), (3,) -> (..., 3)."""
    return np.exp2(np.clip(y, LOWEST, HIGHEST)) * (cosine[..., None] * scale)


@dataclass
class Tape:
    """What :func:`forward` leaves for :func:`backward`: T texels times P pairs of directions."""

    latent: np.ndarray
    codes: np.ndarray
    first: np.ndarray
    x_1: np.ndarray
    second: np.ndarray
    x_2: np.ndarray


def forward(
    latent: np.ndarray, codes: np.ndarray, layers: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, Tape]:
    """:func:`exponents` of all texels times all pairs of directions.

    Parameters
    ----------
    latent : ndarray, shape (T, channels)
    codes : ndarray, shape (P, CODE)
    layers : mapping

    Returns
    -------
    y : ndarray, shape (T, P, 3)
    tape : Tape
    """
    gain_1, bias_1, gain_2, bias_2, colour = split(latent)
    shape = (len(latent), len(codes), gain_1.shape[-1])
    # The directions' part of the first layer is that of all texels.
    first = codes @ layers["layer_1"]
    x_1 = first * gain_1[:, None]
    x_1 += bias_1[:, None]
    x_1 = rectified(x_1)
    second = (x_1.reshape(-1, shape[2]) @ layers["layer_2"]).reshape(shape)
    x_2 = second * gain_2[:, None]
    x_2 += bias_2[:, None]
    x_2 = rectified(x_2)
    y = (x_2.reshape(-1, shape[2]) @ layers["layer_3"]).reshape(*shape[:2], 3) + colour[:, None]
    return y, Tape(latent, codes, first, x_1, second, x_2)


def backward(
    tape: Tape, slope: np.ndarray, layers: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Derivatives of a loss by the numbers of the texels and the matrices.

    Parameters
    ----------
    tape : Tape
    slope : ndarray, shape (T, P, 3)
        Of the loss by ``y``.
    layers : mapping

    Returns
    -------
    latent : ndarray, shape (T, channels)
    layers : dict of str to ndarray
    """
    gain_1, _, gain_2, _, _ = split(tape.latent)
    shape = tape.x_1.shape
    found, flat = {}, slope.reshape(-1, 3)
    found["layer_3"] = tape.x_2.reshape(-1, shape[2]).T @ flat
    by_x = (flat @ layers["layer_3"].T).reshape(shape)
    _rectify_slope(by_x, tape.x_2)
    parts = [_over_pairs(slope), _over_pairs(by_x), np.einsum("tph,tph->th", by_x, tape.second)]
    by_x *= gain_2[:, None]
    flat = by_x.reshape(-1, shape[2])
    found["layer_2"] = tape.x_1.reshape(-1, shape[2]).T @ flat
    by_x = (flat @ layers["layer_2"].T).reshape(shape)
    _rectify_slope(by_x, tape.x_1)
    parts += [_over_pairs(by_x), np.einsum("tph,ph->th", by_x, tape.first)]
    found["layer_1"] = tape.codes.T @ np.einsum("tph,th->ph", by_x, gain_1)
    return np.concatenate(parts[::-1], -1), found
