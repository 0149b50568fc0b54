"""Where the fit of lobes starts: principal directions of the data.

Source: Meseth, Müller, Klein 2004, section 4.1: directions found with a high-pass filter initialise the optimization.
Matching pursuit over a dictionary of lobes at the measured lights (Mallat and Zhang 1993) is the other way offered: on
the checker its starts end in minima whose mean cost is 14 % lower.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet


#: Exponents tried at a direction; those of a start only have to lie in the right valley.
EXPONENTS = (1.5, 5.0, 16.0, 50.0)

#: Factor of the parabolic coordinates of an axis that leans away from the normal.
TILT = 1.2

#: Fits whose starts are found at a time: their products with the dictionary stay in the cache.
BLOCK = 2048

#: Exponent of the cosine that weights the neighbourhood which the high-pass filter subtracts: half a weight at 24°.
SMOOTHING = 8.0


def exponent_limit(lights: DirectionSet) -> float:
    """Largest exponent that the measured lights can tell from a spike.

    A lobe midway between two lights still has half of its peak at both. A sharper one could hide between samples with
    any peak: what the paper saw as white pixels.

    Parameters
    ----------
    lights : DirectionSet

    Returns
    -------
    float
    """
    cosine = lights.vectors @ lights.vectors.T
    np.fill_diagonal(cosine, -1)
    spacing = np.arccos(np.clip(cosine.max(1), -1, 1)).max()
    return float(max(np.log(0.5) / np.log(max(np.cos(spacing / 2), 1e-6)), 2.0))


def lobe_starts(data: np.ndarray, lights: np.ndarray, n_lobes: int, *, high_pass: bool = False) -> np.ndarray:
    """First guess of lobes, one after the other from what the ones before leave.

    Parameters
    ----------
    data : ndarray of float32, shape (N, n_lights)
    lights : ndarray, shape (n_lights, 3)
    n_lobes : int
    high_pass : bool
        True: a lobe lies along the light with the largest high-passed residual. False: along the light, and with the
        exponent, that remove most of the residual.

    Returns
    -------
    ndarray of float32, shape (N, 4 n_lobes)
        Parabolic axis (s, t), natural logarithm of the exponent, peak.
    """
    cosine = np.maximum(lights @ lights.T, 0)
    smooth = cosine**SMOOTHING
    sharpen = (np.eye(len(lights)) - smooth / smooth.sum(1, keepdims=True)).astype(np.float32)
    shapes = np.stack([cosine**e for e in EXPONENTS])
    length = np.sqrt((shapes * shapes).sum(2))
    # Of length 1: what a shape removes is the square of its product with the data.
    shapes, length = (shapes / length[..., None]).astype(np.float32), length.astype(np.float32)
    axis = (lights[:, :2] / (1 + lights[:, 2:])).astype(np.float32)
    result = np.zeros((len(data), 4 * n_lobes), np.float32)
    for first in range(0, len(data), BLOCK):
        part = slice(first, first + BLOCK)
        rest = np.array(data[part], np.float32)
        row = np.arange(len(rest))
        # A lobe of no height has no slope in its other parameters: every lobe starts with some.
        least = 0.02 * np.maximum(rest.max(1), 0)
        for j in range(n_lobes):
            if high_pass:
                towards = np.argmax(rest @ sharpen.T, 1)
                gain = np.einsum("ekl,kl->ke", shapes[:, towards], rest).T
                best = np.argmax(gain, 0)
                gain = gain[best, row]
            else:
                gain = rest @ shapes.reshape(-1, len(lights)).T
                best, towards = np.divmod(np.argmax(gain, 1), len(lights))
                gain = gain[row, best * len(lights) + towards]
            gain = np.maximum(gain, 0)
            rest -= gain[:, None] * shapes[best, towards]
            height = np.maximum(gain / length[best, towards], least)
            exponent = np.log(np.array(EXPONENTS))[best]
            result[part, 4 * j : 4 * j + 4] = np.stack([*axis[towards].T, exponent, height], 1)
    return result


def tilted_starts(data: np.ndarray, lights: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Another guess from lobes that were found: the highest one leans away from the normal, the rest start anew.

    A highlight at the outermost lights that is sharper than exponents may be is met best by the flank of a lobe whose
    axis lies beyond them, which optimization from a lobe on the highlight does not find.

    Parameters
    ----------
    data : ndarray of float32, shape (N, n_lights)
    lights : ndarray, shape (n_lights, 3)
    parameters : ndarray of float32, shape (N, 4 n_lobes)

    Returns
    -------
    ndarray of float32, shape (N, 4 n_lobes)
    """
    row = np.arange(len(data))
    lobes = parameters.reshape(len(data), -1, 4)
    s, t, log_exponent, peak = lobes[row, lobes[..., 3].argmax(1)].T
    brightest = lights[data.argmax(1)]

    def values(s: np.ndarray, t: np.ndarray, lights: np.ndarray) -> np.ndarray:
        cosine = (2 * (s * lights[..., 0] + t * lights[..., 1]) + 2 * lights[..., 2]) / (1 + s * s + t * t)
        return np.maximum(cosine - lights[..., 2], 1e-3) ** np.exp(log_exponent)

    leaning = values(TILT * s, TILT * t, brightest)
    # The value at the brightest light stays; the peak is bounded by what the solver allows.
    height = peak * values(s, t, brightest) / np.maximum(leaning, 1e-3)
    rest = data - (height * values(TILT * s, TILT * t, lights[:, None])).T
    first = np.stack([TILT * s, TILT * t, log_exponent, height], 1)
    further = lobe_starts(rest, lights, lobes.shape[1] - 1)
    return np.concatenate([first, further], 1).astype(np.float32)
