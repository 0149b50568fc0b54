"""Comparison of a test image with a reference: errors by pixel class, statistics, gates."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison import metrics, significance
from btfref.comparison.colour import delta_e00
from btfref.comparison.flip import exposure_range, flip_map
from btfref.comparison.picture_gates import Rounding, class_codes, judge_pictures
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.tolerances import gate_table, limits, tolerance
from btfref.gates.verdicts import GateResult, Measured, judge
from btfref.images.display import Display, fit_display
from btfref.types import Facts, PathLike

CONFIDENCE = 0.99


class HasImage(Protocol):
    """A picture as a renderer returns it; it may carry its ``variance``, of the mean and of the image's shape."""

    @property
    def image(self) -> np.ndarray:
        """Linear Rec. 709, shape (H, W, 3)."""


#: What can be compared.
Side = PathLike | ArrayLike | HasImage


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` found.

    Parameters
    ----------
    metrics : dict of str to dict of str to float
        Class (``interior``, ``edge``, ``silhouette``, ``mesostructure``, ``other``, ``background``, ``all``; those
        with pixels) → name → number.
    gates : tuple of GateResult
        ``image.finite`` first, then those asked for.
    settings : dict
        Every constant that decides a number: ε, floor, peak, exposures, tone mapping.
    counts : dict
        Pixels per class, non-finite and negative pixels of each side.
    statistics : dict
        Class → confidence intervals and the difference test; empty without variances.
    maps : dict of str to array
        ``difference`` (H, W, 3) test - reference; ``relative``, ``delta_e00`` and, unless left out, ``flip``
        (H, W); ``p_value`` (H, W, 3) with variances. NaN where a pixel is not finite.
    test, reference : (H, W, 3) float64 arrays or None
    classes : (H, W) uint8 array or None
    variance : (H, W, 3) float64 array or None
        Of test - reference.
    """

    metrics: dict[str, dict[str, float]]
    gates: tuple[GateResult, ...] = ()
    settings: Facts = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    statistics: dict[str, Facts] = field(default_factory=dict)
    maps: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    test: np.ndarray | None = field(default=None, repr=False)
    reference: np.ndarray | None = field(default=None, repr=False)
    classes: np.ndarray | None = field(default=None, repr=False)
    variance: np.ndarray | None = field(default=None, repr=False)

    @property
    def passed(self) -> bool:
        """Whether there are gates and all of them passed."""
        return bool(self.gates) and all(gate.passed for gate in self.gates)

    @property
    def pictures(self) -> tuple[np.ndarray, np.ndarray]:
        """Test and reference.

        Raises
        ------
        ValueError
            For a comparison of other things than pictures.
        """
        if self.test is None or self.reference is None:
            raise ValueError("no comparison of pictures")
        return self.test, self.reference

    def to_dict(self) -> Facts:
        """Strict JSON; numbers that are not finite become ``"inf"``, ``"-inf"`` or ``"nan"``."""
        return json_safe(
            {
                "kind": "comparison",
                "schema": 1,
                "passed": self.passed,
                "shape": None if self.test is None else list(self.test.shape),
                "counts": self.counts,
                "settings": self.settings,
                "metrics": self.metrics,
                "statistics": self.statistics,
                "gates": [gate.to_dict() for gate in self.gates],
            }
        )


def json_safe(value: object) -> Any:
    """A copy that strict JSON can hold: NumPy values become numbers and lists, non-finite numbers text."""
    if isinstance(value, dict):
        return {str(key): json_safe(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_safe(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return json_safe(value.tolist())
    if isinstance(value, np.generic):
        return json_safe(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return "nan" if value != value else ("inf" if value > 0 else "-inf")
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def compare(
    test: Side,
    reference: Side,
    *,
    classes: ArrayLike | None = None,
    gate: str | Sequence[str] | None = None,
    variance: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    display: Display | None = None,
    flip: bool = True,
    rounding: Rounding | None = None,
) -> Comparison:
    """Compare two pictures of linear radiance.

    Parameters
    ----------
    test, reference : path-like, (H, W, 3) array, or an object with ``image`` and perhaps ``variance``
        Linear Rec. 709. Paths are read by `load_image`.
    classes : (H, W) integer array, optional
        Codes of `PixelClass`: 0 background, 1 interior, 2 silhouette, 3 mesostructure, 4 edge, 5 shadow border, 6
        other. Without it every pixel counts as interior: nothing is excused.
    gate : str or sequence of str, optional
        Keys of ``tolerances.toml``; ``image.finite`` is always applied.
    variance : (H, W, 3) array or pair of such, optional
        Variance of the mean: of test - reference, or of each. Default: what the arguments carry.
    display : Display, optional
        For ΔE00 and SSIM; default `fit_display` of the reference.
    flip : bool, optional
        Whether to compute HDR-FLIP.
    rounding : callable, optional
        Pixels, bool (H, W) -> the most that the rounding of texture coordinates may move them by, (H, W, 3), such as
        :func:`btfref.rendering.offline.rounding.rounding_of` gives. Asked for a few pixels, where the 99.9th percentile
        of a gate with ``beyond_rounding`` is over its limit.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        Unreadable files, shapes that differ, an unknown gate or class.
    """
    sides = [_image(side, name) for side, name in ((test, "test"), (reference, "reference"))]
    (t, r), carried = [image for image, _ in sides], [v for _, v in sides]
    metrics.paired(t, r)
    classes = _class_map(classes, t.shape[:2])
    variance = _variance(variance, carried, t.shape)
    keys = (gate,) if isinstance(gate, str) else tuple(gate or ())
    finite = np.isfinite(t).all(-1) & np.isfinite(r).all(-1)
    masks = {kind.label: finite & (classes == kind) for kind in PixelClass} | {"all": finite}
    masks = {name: mask for name, mask in masks.items() if mask.any()}

    shown = finite & (classes != PixelClass.BACKGROUND)
    display = display or fit_display(r, shown)
    clean_t, clean_r = (np.where(finite[..., None], x, 0.0) for x in (t, r))
    peak = float(np.abs(clean_r).max()) or 1.0
    settings = {
        "relmse_epsilon": metrics.RELMSE_EPSILON,
        "smape_epsilon": metrics.SMAPE_EPSILON,
        "relative_floor": metrics.FLOOR,
        "psnr_peak": peak,
        "ssim": "Gaussian window, sigma 1.5, on display-encoded values",
        "display": display.to_dict(),
        "confidence": CONFIDENCE,
    }
    maps = {"difference": np.where(finite[..., None], clean_t - clean_r, np.nan).astype(np.float32)}
    maps["delta_e00"] = delta_e00(clean_t, clean_r, display)
    ssim = metrics.ssim_map(display.encoded(clean_t), display.encoded(clean_r)).mean(-1)
    if flip:
        start, stop, exposures = exposure_range(clean_r, shown)
        maps["flip"], settings["flip"] = flip_map(
            clean_t, clean_r, start=start, stop=stop, exposures=exposures
        )
    relative = np.full(finite.shape, np.nan)
    for kind in PixelClass:
        if kind.label in masks:
            mask = masks[kind.label]
            relative[mask] = metrics.relative_error(t[mask], r[mask])
    maps["relative"] = relative

    found = {
        name: _class_metrics(t[mask], r[mask], {k: maps[k][mask] for k in maps}, ssim[mask], peak)
        for name, mask in masks.items()
    }
    statistics = {}
    if variance is not None:
        maps["p_value"] = np.full(t.shape, np.nan)
        known = finite & np.isfinite(variance).all(-1)
        if known.any():
            maps["p_value"][known] = significance.welch_test(t[known], variance[known], r[known], 0.0)[1]
        statistics = {
            name: _class_statistics(t, r, variance, mask & known, maps["p_value"])
            for name, mask in masks.items()
            if (mask & known).any()
        }
    counts = {kind.label: int(np.count_nonzero(classes == kind)) for kind in PixelClass} | {
        "all": int(classes.size),
        "nonfinite_test": int(np.count_nonzero(~np.isfinite(t).all(-1))),
        "nonfinite_reference": int(np.count_nonzero(~np.isfinite(r).all(-1))),
        "negative_test": int(np.count_nonzero((clean_t < 0).any(-1))),
        "negative_reference": int(np.count_nonzero((clean_r < 0).any(-1))),
    }
    comparison = Comparison(
        found,
        (),
        settings,
        counts,
        statistics,
        maps,
        t,
        r,
        classes,
        variance,
    )
    every = ("image.finite", *keys)
    gates = [result for key in every for result in judge_pictures(key, comparison, masks, rounding)]
    return replace(comparison, gates=tuple(dict.fromkeys(gates)))


def agreement(
    test: ArrayLike,
    reference: ArrayLike,
    *,
    gate: str = "probe.agreement",
    allowance: ArrayLike | None = None,
) -> Comparison:
    """Compare lists of values (probes) instead of pictures.

    Parameters
    ----------
    test, reference : (..., C) array
        Values of one shape; an entry's error is relative to its largest channel.
    gate : str, optional
        Key of ``tolerances.toml`` with limits among p50, p99, p999, max, rmse, mae, bias and ``floor``.
    allowance : (..., C) array, optional
        Absolute differences that are let through: what the reference itself changes by within the stated tolerance of
        a hit. Only what exceeds them counts.

    Returns
    -------
    Comparison
        Without maps and pictures; ``settings["worst"]`` is the flat index of the worst entry. NaN fails.
    """
    t, r = metrics.paired(test, reference)
    if allowance is not None:
        with np.errstate(invalid="ignore"):
            excess = np.maximum(np.abs(t - r) - np.reshape(allowance, t.shape), 0)
        t = r + np.copysign(excess, t - r)
    t, r = t.reshape(-1, t.shape[-1]), r.reshape(-1, r.shape[-1])
    finite = np.isfinite(t).all(-1) & np.isfinite(r).all(-1)
    bad = int(np.count_nonzero(~finite))
    floor = float(gate_table(gate).get("floor", metrics.FLOOR))
    values, worst = {}, None
    if finite.any():
        error = metrics.relative_error(t[finite], r[finite], floor=floor)
        worst = int(np.flatnonzero(finite)[np.argmax(error)])
        values = {name: getattr(metrics, name)(t[finite], r[finite]) for name in ("rmse", "mae", "bias")}
        values |= metrics.percentiles(error)
    wanted = [entry.removeprefix("min_") for entry in limits(gate_table(gate))]
    measured = {name: Measured(values.get(name)) for name in wanted}
    if bad:
        text = f"{bad} of {len(t)} values are not finite"
        measured = {name: Measured(m.value, "fail", text) for name, m in measured.items()}
    return Comparison(
        {"all": {"count": len(t), **values}},
        tuple(judge(gate, measured)),
        {"relative_floor": floor, "worst": worst},
        {"all": len(t), "nonfinite": bad},
    )


def _image(side: Side, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    carried = getattr(side, "variance", None)
    if isinstance(side, str | os.PathLike):
        from btfref.images.files import load_image

        side = load_image(side)
    image = np.asarray(side.image if hasattr(side, "image") else side, np.float64)
    if image.ndim != 3 or image.shape[-1] != 3:
        raise InputError(f"the {name} is no picture", field="shape", got=image.shape, expected="(H, W, 3)")
    return image, carried


def _class_map(classes: ArrayLike | None, shape: tuple[int, ...]) -> np.ndarray:
    if classes is None:
        return np.full(shape, PixelClass.INTERIOR, np.uint8)
    classes = np.asarray(classes)
    if classes.shape != shape:
        raise InputError("class map and picture differ", field="classes", got=classes.shape, expected=shape)
    unknown = sorted(set(np.unique(classes).tolist()) - set(PixelClass))
    if unknown:
        raise InputError("unknown pixel class", field="classes", got=unknown, expected=class_codes())
    return classes.astype(np.uint8)


def _variance(
    variance: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    carried: Sequence[np.ndarray | None],
    shape: tuple[int, ...],
) -> np.ndarray | None:
    if variance is None:
        parts: list[ArrayLike] = [v for v in carried if v is not None]
    else:
        parts = list(variance) if isinstance(variance, (tuple, list)) else [variance]
    for part in parts:
        if np.shape(part) != shape:
            raise InputError(
                "variance and picture differ", field="variance", got=np.shape(part), expected=shape
            )
    return np.sum([np.asarray(part, np.float64) for part in parts], axis=0) if parts else None


def _class_metrics(
    t: np.ndarray, r: np.ndarray, maps: Mapping[str, np.ndarray], ssim: np.ndarray, peak: float
) -> dict[str, float]:
    found = {"count": len(t), "mean_reference": float(r.mean()), "max_reference": float(np.abs(r).max())}
    for name in ("bias", "bias_fraction", "mae", "rmse", "nrmse", "relative_l2", "relmse", "smape"):
        found[name] = getattr(metrics, name)(t, r)
    found["max_abs"] = float(np.abs(t - r).max())
    found["psnr"] = metrics.psnr(t, r, peak=peak)
    found["ssim"] = float(ssim.mean())
    found |= {f"rel_{k}": v for k, v in metrics.percentiles(metrics.relative_error(t, r)).items()}
    for name in ("delta_e00", "flip"):
        if name in maps:
            values = maps[name].astype(np.float64)
            spread = metrics.percentiles(values)
            found |= {
                f"{name}_mean": float(values.mean()),
                f"{name}_p99": spread["p99"],
                f"{name}_max": spread["max"],
            }
    return found


def _class_statistics(
    t: np.ndarray, r: np.ndarray, variance: np.ndarray, mask: np.ndarray, p_values: np.ndarray
) -> Facts:
    d, v = (t - r)[mask], variance[mask]
    shared = {"confidence": CONFIDENCE, "correlated": d.shape[-1]}
    mse = significance.mse_interval(d, v, **shared)
    return {
        "bias": significance.bias_interval(d, v, **shared).to_dict(),
        "rmse_without_noise": significance.rmse_interval(mse).to_dict(),
        "noise": float(np.sqrt(v.mean())),
        "difference": significance.difference_test(
            p_values[mask], significance=tolerance("image.difference.significance")
        ).to_dict(),
    }
