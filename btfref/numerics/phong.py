"""A Phong model of a table over direction pairs, by batched Levenberg–Marquardt.

Source: Ma et al. 2005, eq. 5: ``μ'(l, v) = k_a + k_d (n · l) + k_s (n · h)^α``, n the macro normal, h the half vector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.numerics.powers import safe_power
from btfref.numerics.solvers.levenberg import Samples, backend, fit_batch
from btfref.precision import real
from btfref.types import JitArray

#: Exponents that the fits start from: one lane each, the best wins.
STARTS = (1.0, 4.0, 16.0, 64.0, 256.0)

#: Bounds of the exponent. Measured directions 15° apart do not resolve a narrower lobe than the upper one.
EXPONENTS = (0.25, 512.0)

#: Bound of the coefficients, relative to the largest value of the table: ambient and specular terms may cancel.
BOUND = 100.0


def phong(parameters: ArrayLike, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
    """The model.

    Parameters
    ----------
    parameters : array_like, shape (4,)
        k_a, k_d, k_s, α.
    w_light, w_view : ndarray, shape (..., 3)
        Unit vectors above the horizon.

    Returns
    -------
    ndarray of float64, shape (...)
    """
    ambient, diffuse, specular, exponent = (float(p) for p in np.asarray(parameters))
    cosine = half_cosine(w_light, w_view)
    return ambient + diffuse * w_light[..., 2] + specular * safe_power(cosine, exponent)


def half_cosine(w_light: ArrayLike, w_view: ArrayLike) -> np.ndarray:
    """Cosine between the normal and the half vector, n · h, of unit vectors, shape (..., 3), (..., 3) -> (...)."""
    half = real(w_light) + real(w_view)
    return half[..., 2] / np.sqrt((half**2).sum(-1))


def fit_phong(table: ArrayLike, views: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, float]:
    """The best Phong model of a table.

    Parameters
    ----------
    table : ndarray, shape (n_views, n_lights)
    views, lights : ndarray, shape (n, 3)
        Unit vectors.

    Returns
    -------
    parameters : ndarray of float32, shape (4,)
        k_a, k_d, k_s, α.
    rms : float
        Root of the mean squared misfit over all pairs.
    """
    module = backend()
    import drjit as dr

    table = np.asarray(table, float)
    scale = max(float(np.abs(table).max()), 1e-30)
    values = module.Float((table / scale).astype(np.float32).ravel())
    w_view, w_light = np.broadcast_arrays(np.asarray(views)[:, None], np.asarray(lights)[None])
    cosine = module.Float(np.ascontiguousarray(w_light[..., 2], np.float32).ravel())
    half = module.Float(half_cosine(w_light, w_view).astype(np.float32).ravel())

    def model(p: list[JitArray], _: JitArray) -> tuple[Samples, list[JitArray]]:
        ambient, diffuse, specular, log_exponent = p
        exponent = dr.exp(log_exponent)

        def samples(step: JitArray) -> list[tuple[JitArray, list[JitArray]]]:
            light = dr.gather(module.Float, cosine, step)
            log = dr.log(dr.maximum(dr.gather(module.Float, half, step), 1e-6))
            power = dr.exp(exponent * log)
            value = dr.fma(specular, power, dr.fma(diffuse, light, ambient))
            return [
                (value - dr.gather(module.Float, values, step), [module.Float(1), light, power, power * log])
            ]

        return samples, [module.Float(1), module.Float(1), module.Float(1), specular * exponent]

    start = np.array([_linear_start(table / scale, w_light, w_view, exponent) for exponent in STARTS])
    low, high = np.log(EXPONENTS)
    fits = fit_batch(model, start, [-BOUND, -BOUND, -BOUND, low], [BOUND, BOUND, BOUND, high], table.size)
    best = fits.parameters[np.argmin(fits.cost)].astype(float)
    best[:3] *= scale
    best[3] = np.exp(best[3])
    best = best.astype(np.float32)
    misfit = phong(best, w_light, w_view) - table
    return best, float(np.sqrt((misfit**2).mean()))


def _linear_start(table: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, exponent: float) -> list[float]:
    """Coefficients that are best for a given exponent, and its logarithm."""
    columns = [np.ones(table.size), w_light[..., 2].ravel(), half_cosine(w_light, w_view).ravel() ** exponent]
    coefficients, *_ = np.linalg.lstsq(np.stack(columns, 1), table.ravel(), rcond=1e-6)
    return [*np.clip(coefficients, -BOUND, BOUND), np.log(exponent)]
