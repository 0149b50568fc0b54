"""Gates applied to a comparison of pictures: what each limit measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from btfref.comparison import metrics, significance
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.tolerances import Gate, gate_table, limits
from btfref.gates.verdicts import GateResult, Measured, judge

if TYPE_CHECKING:
    from btfref.comparison.comparison import Comparison


def class_codes() -> dict[str, int]:
    """Pixel class → its number in a class map."""
    return {kind.label: kind.value for kind in PixelClass}


#: Pixels (H, W) → what rounding alone may move them by, (H, W, 3).
Rounding = Callable[[np.ndarray], np.ndarray]

#: Share of the judged pixels that may ask for it: where more are off, rounding is not why.
ASKING = 0.1


def judge_pictures(
    key: str,
    comparison: Comparison,
    masks: Mapping[str, np.ndarray],
    rounding: Rounding | None = None,
) -> list[GateResult]:
    """Apply one gate to a comparison of pictures.

    Parameters
    ----------
    key : str
        Key of ``tolerances.toml``.
    comparison : Comparison
    masks : dict of str to ndarray of bool, shape (H, W)
        Finite pixels of each class that has some.
    rounding : callable, optional
        What rounding alone may move some pixels by. It is asked where a gate with ``beyond_rounding`` fails.

    Returns
    -------
    list of GateResult
        One for every limit.
    """
    table = gate_table(key)
    name = table.get("class", PixelClass.INTERIOR.label)
    wanted = [entry.removeprefix("min_") for entry in limits(table)]
    names = name.split("+")
    if not {*names} <= {*class_codes(), "all"}:
        raise InputError("unknown pixel class", file="tolerances.toml", field=f"{key}.class", got=name)
    mask = np.any([masks[one] for one in names if one in masks], axis=0)
    # Materials that real time shows otherwise are left out of what is judged.
    covered = (comparison.classes != PixelClass.BACKGROUND) & (comparison.classes != PixelClass.OTHER)
    share = int(np.count_nonzero(mask & covered)) / max(int(np.count_nonzero(covered)), 1)
    if wanted == ["judged_share"]:
        # Edges inside a material and borders of shadows have classes and gates of their own.
        smooth = covered & (comparison.classes != PixelClass.MESOSTRUCTURE)
        smooth &= comparison.classes != PixelClass.SHADOW_BORDER
        share = int(np.count_nonzero(mask & smooth)) / max(int(np.count_nonzero(smooth)), 1)
        return judge(key, {"judged_share": share}, pixel_class=name)
    if wanted == ["nonfinite"]:
        bad = {side: comparison.counts[f"nonfinite_{side}"] for side in ("test", "reference")}
        detail = ", ".join(f"{n} in the {side}" for side, n in bad.items() if n)
        return judge(
            key,
            {
                "nonfinite": Measured(
                    sum(bad.values()), None, detail and f"pixels that are not finite: {detail}"
                )
            },
            pixel_class=name,
        )
    if not np.any(mask):
        outcome = "empty" if table.get("may_be_empty") else "fail"
        detail = f"no finite {name} pixels"
        return judge(key, dict.fromkeys(wanted, Measured(None, outcome, detail)), pixel_class=name)
    measured = {w: _measure(w, name, table, comparison, mask) for w in wanted}
    if rounding is not None and "beyond_rounding" in table:
        entry = str(table["beyond_rounding"])
        measured[entry] = _beyond(entry, table, comparison, mask, rounding)
    found = judge(key, measured, pixel_class=name)
    return [replace(gate, judged=share) for gate in found] if name not in ("all", "background") else found


def _measure(
    entry: str, name: str, table: Gate, comparison: Comparison, mask: np.ndarray
) -> float | Measured:
    t, r = (picture[mask] for picture in comparison.pictures)
    if entry in metrics.PERCENTILES or entry == "failing_fraction":
        error = metrics.relative_error(t, r, floor=table.get("floor", metrics.FLOOR))
        if entry == "failing_fraction":
            return float(np.mean(error > table["failing_above"]))
        return metrics.percentiles(error)[entry]
    if entry.startswith("code_"):
        return metrics.percentiles(metrics.code_error(t, r).max(-1))[entry.removeprefix("code_")]
    if entry == "lost_negative":
        return metrics.lost_negative(t, r)
    if entry in ("rejected_fraction", "relative_rmse", "relative_tile_bias"):
        if comparison.variance is None:
            return Measured(None, "fail", "needs the variance of the reference, none was given")
        known = np.isfinite(comparison.variance[mask]).all(-1)
        if not known.all():
            return Measured(None, "fail", f"variance is not finite at {np.count_nonzero(~known)} pixels")
        v = comparison.variance[mask]
        if entry == "rejected_fraction":
            p = significance.welch_test(t, v, r, 0.0)[1]
            return significance.difference_test(p, significance=table["significance"]).rejected_fraction
        if entry == "relative_tile_bias":
            return _tiles(comparison, comparison.variance, mask, table)
        return _equivalence(t, r, v, table)
    known = comparison.metrics.get(name, comparison.metrics["all"])
    if entry not in known:
        raise InputError("no such measure", file="tolerances.toml", field=entry, expected=sorted(known))
    # Of several classes together nothing is measured before a gate asks.
    return known[entry] if name in comparison.metrics else float(getattr(metrics, entry)(t, r))


def _beyond(
    entry: str, table: Gate, comparison: Comparison, mask: np.ndarray, rounding: Rounding
) -> float | Measured:
    """A percentile of the errors beyond what rounding accounts for, which is asked for where they exceed the limit."""
    t, r = (picture[mask] for picture in comparison.pictures)
    floor = float(table.get("floor", metrics.FLOOR))
    error = metrics.relative_error(t, r, floor=floor)
    plain, asking = metrics.percentiles(error)[entry], error > table[entry]
    if plain <= table[entry] or np.mean(asking) > ASKING:
        return plain
    pixels = np.zeros_like(mask)
    pixels[mask] = asking
    excess = np.maximum(np.abs(t - r) - rounding(pixels)[mask], 0)
    value = metrics.percentiles(metrics.relative_error(r + excess, r, floor=floor))[entry]
    count = np.count_nonzero(asking)
    return Measured(
        value, None, f"{plain:.2e} before the rounding of uv, measured at {count} pixels, was taken off"
    )


def _equivalence(t: np.ndarray, r: np.ndarray, variance: np.ndarray, table: Gate) -> Measured:
    scale = float(np.mean(np.abs(r)))
    if scale == 0:
        return Measured(None, "fail", "the reference is black: no relative error")
    mse = significance.mse_interval(
        t - r, variance, confidence=1 - table["significance"], correlated=t.shape[-1]
    )
    found = significance.rmse_interval(mse)
    relative = significance.interval(found.estimate / scale, found.standard_error / scale)
    relative = significance.Interval(
        relative.estimate, relative.standard_error, found.low / scale, found.high / scale, mse.confidence
    )
    return Measured(
        relative.estimate,
        None,
        f"{100 * mse.confidence:g} % interval {relative.low:.2e} to {relative.high:.2e}",
        (relative.low, relative.high),
    )


def _tiles(comparison: Comparison, variance: np.ndarray, mask: np.ndarray, table: Gate) -> Measured:
    test, reference = comparison.pictures
    scale = float(np.mean(np.abs(reference[mask])))
    if scale == 0:
        return Measured(None, "fail", "the reference is black: no relative error")
    # What is not looked at may not be finite.
    difference, noise = (np.where(mask[..., None], image, 0.0) for image in (test - reference, variance))
    found = significance.tile_equivalence(
        difference / scale,
        noise / scale**2,
        mask,
        tolerance=table["relative_tile_bias"],
        significance=table["significance"],
    )
    if found is None:
        return Measured(None, "empty", "no tile of which a quarter is of the class")
    worst = found.interval
    detail = f"interval of the worst tile {worst.low:.2e} to {worst.high:.2e}"
    return Measured(abs(worst.estimate), None, detail, found.bounds)
