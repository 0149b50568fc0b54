"""The error waterfall as a figure: each stage's own error, and the error so far, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from html import escape

import numpy as np

from btfref.report import svg
from btfref.report.text import number
from btfref.types import Facts

_WIDTH, _LEFT, _RIGHT, _TOP, _ROW = 760, 108, 132, 30, 34

#: Smallest decade below the largest error that is drawn.
DECADES = 8


def waterfall_figure(fall: Facts) -> str:
    """Bars of RMSE on a logarithmic scale, one row a stage.

    Parameters
    ----------
    fall : dict
        `btfref.comparison.waterfall.Waterfall.to_dict`.

    Returns
    -------
    str
        An ``<svg>`` element whose colours come from the page's style.
    """
    stages = fall["stages"]
    rows = [(stage["name"], stage) for stage in stages]
    for share in fall["parts"]:
        at = 1 + [name for name, _ in rows].index(share["of"])
        rows.insert(at, (f"{'beside it' if share.get('beside') else 'of it'} {share['name']}", share))
    both = [stage[key] for stage in stages for key in ("rmse", "rmse_so_far")]
    largest = max([v["high"] for v in both if v["high"] > 0], default=1.0)
    top = float(np.ceil(np.log10(largest) + 1e-9))
    there = [v for _, row in rows for v in (row["rmse"]["estimate"],) if v > 0]
    low = max(top - DECADES, float(np.floor(np.log10(min(there, default=largest)))))
    low = min(low, top - 1)
    base = _TOP + _ROW * (len(rows) + 2)
    height = base + 30

    def x(value: float) -> float:
        log = np.log10(value) if value > 0 else low
        return _LEFT + (np.clip(log, low, top) - low) / (top - low) * (_WIDTH - _LEFT - _RIGHT)

    decades = [(x(10.0**k), f"1e{k}".replace("-", "−")) for k in range(int(low), int(top) + 1)]
    parts = [
        svg.lines("grid", [(at, _TOP, at, base) for at, _ in decades]),
        svg.texts("tick", "middle", [(at, base + 15, words) for at, words in decades]),
    ]
    for row, (name, stage) in enumerate(rows):
        y = _TOP + _ROW * row
        parts.append(svg.text(_LEFT - 8, y + 17, name, "end", "axis"))
        parts.append(_bar(x, stage["rmse"], y + 4, 12, "series interior", low))
        if "rmse_so_far" in stage:
            parts.append(_bar(x, stage["rmse_so_far"], y + 18, 8, "series silhouette", low))
        text = f"{number(stage['rmse']['estimate'])}, ΔE00 {number(stage['delta_e00']['estimate'], 2)}"
        parts.append(svg.text(_WIDTH - _RIGHT + 8, y + 17, text, "start"))
    y = _TOP + _ROW * len(rows)
    parts.append(svg.text(_LEFT - 8, y + 17, "covariances", "end", "axis"))
    parts.append(_bar(x, _magnitude(fall["covariance"]), y + 4, 12, "series mesostructure", low))
    parts.append(svg.text(_WIDTH - _RIGHT + 8, y + 17, _signed_root(fall["covariance"]["estimate"]), "start"))
    y += _ROW
    parts.append(svg.text(_LEFT - 8, y + 17, "whole", "end", "axis"))
    parts.append(_bar(x, fall["total"], y + 6, 14, "series silhouette", low))
    colour = stages[-1]["delta_e00_so_far"]["estimate"]
    text = f"{number(fall['total']['estimate'])}, ΔE00 {number(colour, 2)}"
    parts.append(svg.text(_WIDTH - _RIGHT + 8, y + 17, text, "start"))
    keys = (
        ("interior", "alone"),
        ("silhouette", "so far, against the truth"),
        ("mesostructure", "covariances"),
    )
    for at, (kind, text) in zip((0, 70, 235), keys, strict=True):
        parts.append(f'<rect class="key {kind}" x="{_LEFT + at}" y="8" width="10" height="10"/>')
        parts.append(svg.text(_LEFT + at + 15, 17, text, "start"))
    parts.append(svg.text((_LEFT + _WIDTH - _RIGHT) / 2, height - 2, "RMSE of radiance", "middle", "axis"))
    return (
        f'<svg class="chart waterfall" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'aria-label="Errors of the stages">{"".join(parts)}</svg>'
    )


def _magnitude(mse: Mapping[str, float]) -> dict[str, float]:
    """Interval of the root of a mean square's size, whatever its sign."""
    low, high = sorted(abs(mse[name]) for name in ("low", "high"))
    if mse["low"] < 0 < mse["high"]:
        low = 0.0
    ends = {"low": low, "high": high, "estimate": abs(mse["estimate"])}
    return {name: float(np.sqrt(value)) for name, value in ends.items()}


def _signed_root(mse: float) -> str:
    """√ of a mean square with its sign, as text: what it adds to the whole, or takes from it."""
    return f"{'−' if mse < 0 else '+'}{number(float(np.sqrt(abs(mse))))} (root)"


def _bar(
    x: Callable[[float], float], interval: Mapping[str, float], y: float, height: float, kind: str, low: float
) -> str:
    """A bar to the estimate, and its interval as a whisker."""
    start, end = x(10.0**low), x(interval["estimate"])
    ends = [x(interval[name]) for name in ("low", "high")]
    middle = y + height / 2
    width = svg.short(max(end - start, 0.5))
    bar = f'<rect class="{kind}" x="{svg.short(start)}" y="{y}" width="{width}" height="{height}"/>'
    if ends[1] - ends[0] < 0.5:
        return bar
    return bar + (
        f'<path class="whisker" d="M{svg.short(ends[0])} {svg.short(middle - 4)}v8m0 -4H{svg.short(ends[1])}'
        f'm0 -4v8"/>'
    )


def waterfall_table(fall: Facts) -> str:
    """The same numbers as a table, with intervals.

    Parameters
    ----------
    fall : dict

    Returns
    -------
    str
        A ``<table>`` in a box that scrolls sideways.
    """
    keys = ("rmse", "rmse_so_far", "delta_e00", "delta_e00_so_far")
    head = "".join(
        f'<th scope="col">{name}</th>' for name in ("RMSE alone", "RMSE so far", "ΔE00 alone", "ΔE00 so far")
    )
    shares = {share["of"]: share for share in fall["parts"]}
    rows = ""
    for stage in fall["stages"]:
        rows += f'<tr><th scope="row">{escape(stage["name"])}</th>' + "".join(
            _cell(stage[key]) for key in keys
        )
        if share := shares.get(stage["name"]):
            how = "beside it" if share.get("beside") else "a part of it"
            name = f"{share['name']}, {how}, at {share['pixels']} pixels"
            rows += f'</tr><tr><th scope="row">{escape(name)}</th>{_cell(share["rmse"])}<td></td>'
            rows += f"{_cell(share['delta_e00'])}<td></td>"
        rows += "</tr>"
    shared = fall["covariance"]
    rows += (
        f'<tr><th scope="row">covariances, with their sign</th><td>{_signed_root(shared["estimate"])}</td>'
    )
    rows += "<td></td><td></td><td></td></tr>"
    whole = f'<tr><th scope="row">whole, measured apart</th><td></td>{_cell(fall["total"])}<td></td><td></td></tr>'
    return (
        f'<div class="scroll"><table class="metrics"><thead><tr><th scope="col">stage</th>{head}</tr></thead>'
        f"<tbody>{rows}{whole}</tbody></table></div>"
    )


def _cell(interval: Mapping[str, float]) -> str:
    text = number(interval["estimate"])
    if interval["high"] > interval["low"]:
        text += f'<small class="muted"> {number(interval["low"], 2)} … {number(interval["high"], 2)}</small>'
    return f"<td>{text}</td>"


def waterfall_section(fall: Facts | None) -> str:
    """Figure, table and what they add up to, as HTML; empty without a waterfall."""
    if not fall:
        return ""
    noise = fall.get("sampling")
    apart = ""
    if noise:
        random, rest = (number(float(np.sqrt(max(noise[name], 0))), 2) for name in ("noise", "mse"))
        apart = (
            f" Of the first stage, {random} is Monte Carlo noise of the samples; directions and texels alone leave "
            f"{rest} (by an independent twin)."
        )
    mean = f"Mean radiance of the truth: {number(fall['mean'])} over {number(fall['pixels'])} pixels."
    intervals = "99 % intervals hold the noise of both sides."
    return (
        '<section class="fall"><h3>Where the error comes from</h3>'
        f'<div class="chartbox">{waterfall_figure(fall)}</div>{waterfall_table(fall)}'
        f'<p class="notes">{escape(fall["explanation"] + apart)} {mean} {intervals}</p></section>'
    )
