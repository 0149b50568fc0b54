"""FLIP, the error that a person sees when flipping between two pictures, through the authors' library."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.metrics import paired
from btfref.conventions import LUMINANCE
from btfref.errors import InputError
from btfref.types import Facts

#: Pixels per degree of visual angle: 0.7 m from a 0.7 m wide display of 3840 pixels, the authors' default.
PIXELS_PER_DEGREE = 67.02064
TONEMAPPERS = ("aces", "hable", "reinhard")

#: Hill's fit of the ACES curve as FLIP uses it: (a x² + b x) / (c x² + d x + e), input scaled by 0.6.
_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)


def aces(x: ArrayLike) -> np.ndarray:
    """Tone mapping of linear values ≥ 0 to [0, 1] used by HDR-FLIP (Andersson et al. 2021, section 3)."""
    a, b, c, d, e = _ACES
    x = np.asarray(x, np.float64)
    return np.clip((a * x * x + b * x) / (c * x * x + d * x + e), 0.0, 1.0)


def exposure_range(
    reference: ArrayLike, mask: np.ndarray | None = None, *, widest: float = 6.0
) -> tuple[float, float, int]:
    """Start and stop exposure of HDR-FLIP, from the reference alone.

    The rule of Andersson et al. 2021: the brightest pixel, and the median pixel, come to 0.85 after ACES tone
    mapping. The median is taken over lit pixels, since a black background would drive it, and the exposure,
    to absurdity.

    Parameters
    ----------
    reference : (H, W, 3) array
        Linear radiance.
    mask : (H, W) bool array, optional
        Pixels that count.
    widest : float, optional
        Stops between start and stop at most.

    Returns
    -------
    (float, float, int)
        Start and stop in stops, rounded to 1/8, and the number of exposures.
    """
    y = np.maximum(np.nan_to_num(np.asarray(reference, np.float64), posinf=0.0, neginf=0.0), 0.0) @ LUMINANCE
    lit = y[y > 0] if mask is None else y[(y > 0) & mask]
    if lit.size == 0:
        return 0.0, 0.0, 2
    a, b, c, d, e = _ACES
    k2, k1, k0 = a - 0.85 * c, b - 0.85 * d, -0.85 * e
    target = (-k1 + math.sqrt(k1 * k1 - 4 * k2 * k0)) / (2 * k2)
    start = round(8 * math.log2(target / float(lit.max()))) / 8
    stop = min(round(8 * math.log2(target / float(np.median(lit)))) / 8, start + widest)
    return start, max(start, stop), max(2, math.ceil(stop - start))


def flip_map(
    test: ArrayLike,
    reference: ArrayLike,
    *,
    start: float | None = None,
    stop: float | None = None,
    exposures: int | None = None,
    tonemapper: str = "aces",
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> tuple[np.ndarray, Facts]:
    """HDR-FLIP error per pixel (Andersson et al. 2021).

    Parameters
    ----------
    test, reference : (H, W, 3) array
        Linear Rec. 709 radiance, finite; negative values are taken as 0, all that a display could show.
    start, stop : float, optional
        Exposure range in stops; default: `exposure_range` of the reference.
    exposures : int, optional
        Number of exposures, at least 2; default: one a stop.
    tonemapper : {"aces", "hable", "reinhard"}, optional
    pixels_per_degree : float, optional
        Viewing distance.

    Returns
    -------
    map : (H, W) float32 array
        In [0, 1].
    settings : dict
        All that decides the result.

    Raises
    ------
    InputError
        Wrong shapes, non-finite values or settings out of range. (The library would end the process.)
    """
    t, r = paired(test, reference)
    if t.ndim != 3 or t.shape[-1] != 3:
        raise InputError("FLIP needs pictures", field="shape", got=t.shape, expected="(H, W, 3)")
    if not (np.isfinite(t).all() and np.isfinite(r).all()):
        raise InputError("FLIP needs finite values")
    if str(tonemapper).lower() not in TONEMAPPERS:
        raise InputError("unknown tone mapper", field="tonemapper", got=tonemapper, expected=TONEMAPPERS)
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise InputError("must be positive", field="pixels_per_degree", got=pixels_per_degree)
    auto = exposure_range(r)
    start = auto[0] if start is None else float(start)
    stop = max(auto[1], start) if stop is None else float(stop)
    if not (math.isfinite(start) and math.isfinite(stop) and start <= stop):
        raise InputError("start and stop exposure are no range", field="start, stop", got=(start, stop))
    exposures = max(2, math.ceil(stop - start)) if exposures is None else int(exposures)
    if exposures < 2:
        raise InputError("at least two exposures", field="exposures", got=exposures)

    from flip_evaluator import evaluate

    settings = {
        "ppd": float(pixels_per_degree),
        "startExposure": start,
        "stopExposure": stop,
        "numExposures": exposures,
        "tonemapper": str(tonemapper).lower(),
    }
    errors, _, used = evaluate(
        np.ascontiguousarray(np.maximum(r, 0.0), np.float32),
        np.ascontiguousarray(np.maximum(t, 0.0), np.float32),
        "HDR",
        applyMagma=False,
        computeMeanError=False,
        parameters=dict(settings),
    )
    settings["numExposures"] = int(used["numExposures"])
    return np.asarray(errors, np.float32)[..., 0], settings


def ldr_flip_map(
    test: ArrayLike, reference: ArrayLike, *, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> np.ndarray:
    """FLIP of linear values in [0, 1] per pixel (Andersson et al. 2020).

    Parameters
    ----------
    test, reference : (H, W, 3) array
        Displayed light, linear, in [0, 1].
    pixels_per_degree : float, optional

    Returns
    -------
    (H, W) float32 array

    Raises
    ------
    InputError
        Wrong shapes or values outside [0, 1].
    """
    t, r = paired(test, reference)
    if t.ndim != 3 or t.shape[-1] != 3:
        raise InputError("FLIP needs pictures", field="shape", got=t.shape, expected="(H, W, 3)")
    low, high = min(t.min(), r.min()), max(t.max(), r.max())
    if not (low >= 0 and high <= 1):
        raise InputError("FLIP of low range needs values in [0, 1]", got=f"{low:g} to {high:g}")
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise InputError("must be positive", field="pixels_per_degree", got=pixels_per_degree)

    from flip_evaluator import evaluate

    errors, _, _ = evaluate(
        np.ascontiguousarray(r, np.float32),
        np.ascontiguousarray(t, np.float32),
        "LDR",
        inputsRGB=False,
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": float(pixels_per_degree)},
    )
    return np.asarray(errors, np.float32)[..., 0]
