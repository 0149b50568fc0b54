"""Figures of the report: thumbnails as PNG and histograms as SVG whose colours come from the page's style."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

from btfref.conventions import PixelClass
from btfref.images.png import encode_png
from btfref.report import svg

#: Decades of relative error that the histogram shows; smaller ones, and zero, fall into its first bin.
DECADES = (-8, 1)
BINS_PER_DECADE = 6
_WIDTH, _HEIGHT = 640, 252
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 26, 40


def thumbnail(encoded: ArrayLike, *, size: int = 72) -> str:
    """A data URI of a small PNG by averaging blocks.

    Parameters
    ----------
    encoded : (H, W, 3) array
        Display-encoded values in [0, 1].
    size : int, optional
        Longer edge in pixels at most.

    Returns
    -------
    str
    """
    image = np.asarray(encoded, np.float64)
    step = max(1, -(-max(image.shape[:2]) // size))
    height, width = (max(n // step, 1) for n in image.shape[:2])
    image = image[: height * step, : width * step] if min(image.shape[:2]) >= step else image[:1, :1]
    block = (image.shape[0] // height, image.shape[1] // width)
    small = image.reshape(height, block[0], width, block[1], -1).mean(axis=(1, 3))
    png = encode_png(np.round(np.clip(small, 0, 1) * 255).astype(np.uint8))
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def diverging(value: ArrayLike) -> np.ndarray:
    """Blue, white and red of values in [-1, 1] → (..., 3) display-encoded; the page uses the same stops."""
    stops = np.array([[5, 48, 97], [67, 147, 195], [247, 247, 247], [214, 96, 77], [103, 0, 31]]) / 255
    position = np.clip(np.nan_to_num(np.asarray(value, np.float64)), -1, 1) * 2 + 2
    return np.stack([np.interp(position, np.arange(5), stops[:, c]) for c in range(3)], axis=-1)


def error_histogram(relative: np.ndarray, classes: np.ndarray, marks: Sequence[tuple[str, float]]) -> str:
    """Distribution of the relative error per pixel class, both axes logarithmic.

    Parameters
    ----------
    relative : (H, W) array
        Relative error per pixel; NaN is left out.
    classes : (H, W) integer array
        Codes of `PixelClass`.
    marks : list of (str, float)
        Limits to draw: label and relative error.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    low, high = DECADES
    edges = np.linspace(low, high, (high - low) * BINS_PER_DECADE + 1)
    series = []
    for kind in (PixelClass.INTERIOR, PixelClass.SILHOUETTE):
        values = relative[(classes == kind) & ~np.isnan(relative)]
        if values.size:
            logs = np.log10(np.clip(values, 10.0**low, 10.0 ** (high - 1e-9)))
            series.append((kind.label, np.histogram(logs, edges)[0] / values.size))
    floor = -5.0  # log10 of the smallest share drawn: one pixel of 316 x 316

    def x(log: float) -> float:
        return _LEFT + (log - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)

    def y(log: float) -> float:
        return _TOP + (0 - log) / (0 - floor) * (_HEIGHT - _TOP - _BOTTOM)

    lines: list[tuple[float, float, float, float]] = []
    below: list[tuple[float, float, str]] = []
    beside: list[tuple[float, float, str]] = []
    for decade in range(low, high + 1):
        lines.append((x(decade), _TOP, x(decade), y(floor)))
        below.append((x(decade), y(floor) + 15, "≤ 10⁻⁸" if decade == low else _power(decade)))
    for decade, label in ((0, "100 %"), (-1, "10 %"), (-2, "1 %"), (-3, "0.1 %"), (-4, "10⁻⁴"), (-5, "10⁻⁵")):
        lines.append((_LEFT, y(decade), _WIDTH - _RIGHT, y(decade)))
        beside.append((_LEFT - 6, y(decade) + 3.5, label))
    parts = [svg.lines("grid", lines), svg.texts("tick", "middle", below), svg.texts("tick", "end", beside)]
    for name, share in series:
        heights = [y(max(np.log10(v), floor)) if v > 0 else y(floor) for v in share]
        parts.append(svg.steps(f"series {name}", [x(edge) for edge in edges], heights, y(floor)))
    for index, (label, value) in enumerate(marks):
        if 10.0**low < value < 10.0**high:
            at = x(np.log10(value))
            parts.append(svg.lines("mark", [(at, _TOP - 4, at, y(floor))]))
            parts.append(svg.text(at + 4, _TOP - 6 + 12 * (index % 2), label, "start", "marklabel"))
    legend_x = _LEFT + 4.0
    for name, _ in series:
        parts.append(f'<rect class="key {name}" x="{svg.short(legend_x)}" y="6" width="10" height="10"/>')
        parts.append(svg.text(legend_x + 15, 15, name, "start"))
        legend_x += 26 + 6.4 * len(name)
    parts.append(svg.text((_LEFT + _WIDTH) / 2, _HEIGHT - 5, "relative error of a pixel", "middle", "axis"))
    return _svg(parts, "Share of pixels over relative error, by pixel class")


def p_value_histogram(p_values: np.ndarray) -> str:
    """Distribution of p-values, which is flat where nothing but noise differs.

    Parameters
    ----------
    p_values : array
        NaN is left out.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    p = np.asarray(p_values)[~np.isnan(p_values)]
    density = np.histogram(p, 20, (0, 1))[0] / max(p.size, 1) * 20
    tallest = max(2.0, float(density.max()))
    inner_w, inner_h = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    base = _TOP + inner_h
    step = inner_w / 20
    bars = [(_LEFT + k * step + 1, base - v / tallest * inner_h, step - 2) for k, v in enumerate(density)]
    flat = base - inner_h / tallest
    parts = [
        svg.bars("bar", bars, base),
        svg.lines("mark", [(_LEFT, flat, _WIDTH - _RIGHT, flat)]),
        svg.text(_WIDTH - _RIGHT, flat - 5, "expected of noise alone", "end", "marklabel"),
    ]
    below = [(_LEFT + tick * inner_w, base + 15, f"{tick:g}") for tick in (0, 0.25, 0.5, 0.75, 1)]
    beside = [(_LEFT - 6, base - t / tallest * inner_h + 3.5, f"{t:.3g}") for t in (0.0, 1.0, tallest)]
    parts += [svg.texts("tick", "middle", below), svg.texts("tick", "end", beside)]
    parts.append(
        svg.text((_LEFT + _WIDTH) / 2, _HEIGHT - 5, "p-value of a pixel's channel", "middle", "axis")
    )
    return _svg(parts, "Density of p-values")


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")) if exponent else "1"


def _svg(parts: Sequence[str], label: str) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label)}">'
        + "".join(parts)
        + "</svg>"
    )
