"""One cell as HTML: its pictures for the page's viewer, its charts, tables and gates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from btfref.comparison.comparison import Comparison
from btfref.conventions import PixelClass
from btfref.gates.verdicts import limit_name
from btfref.report.cell import LABELS, Cell, asset, full_scale, label_of, script_json, signed_difference
from btfref.report.figures import error_histogram, p_value_histogram
from btfref.report.pack import pack
from btfref.report.text import badge, class_table, gate_list, number
from btfref.types import Facts


def article(
    index: int, cell: Cell, *, extra: str = "", images: Mapping[str, Facts] | None = None, bits: int = 6
) -> str:
    """The cell's part of the page.

    Parameters
    ----------
    index : int
        Its number on the page.
    cell : Cell
    extra : str
        HTML between the pictures and the numbers.
    images : dict of str to dict, optional
        Packed pictures by label (see `btfref.report.pack.pack`), or ``{"shared": key}``; by default all are packed
        here.
    bits : int
        Mantissa bits of the error maps.

    Returns
    -------
    str
    """
    parts = [
        f'<article class="cell" id="cell-{index}" data-outcome="{cell.outcome}">',
        f'<header><h2><span class="index">{index}</span> {escape(cell.name)}</h2>{badge(cell.outcome)}'
        '<a class="up" href="#overview">overview ↑</a></header>',
    ]
    if cell.notes:
        parts.append(f'<p class="notes">{escape(cell.notes)}</p>')
    if cell.comparison is None and cell.images:
        parts.append('<p class="alert">These pictures were not compared, which counts as a failure.</p>')
    if cell.images:
        parts.append(_stage(index, cell, images, bits))
    parts.append(extra)
    table = ""
    if cell.comparison and cell.comparison.metrics:
        table = class_table(cell.comparison, " against ".join(cell.names) if cell.images else "")
    parts.append(
        f'<div class="numbers"><section>{table}{_remarks(cell.comparison)}</section>'
        f'<section class="gatebox"><h3>Gates</h3>{gate_list(cell.all_gates)}</section></div></article>'
    )
    return "".join(parts)


def _remarks(comparison: Comparison | None) -> str:
    """Pixels that need attention, and the constants behind the numbers."""
    if comparison is None:
        return ""
    words = {
        "nonfinite_test": "not finite in the test picture",
        "nonfinite_reference": "not finite in the reference",
        "negative_test": "negative in the test picture (kept in all errors, shown as 0)",
        "negative_reference": "negative in the reference (kept in all errors, shown as 0)",
    }
    found = [
        f"<li>{number(comparison.counts[key])} pixels are {text}</li>"
        for key, text in words.items()
        if comparison.counts.get(key)
    ]
    if "flip" in comparison.settings:
        flip = comparison.settings["flip"]
        found.append(
            f"<li>FLIP: exposures {number(flip['startExposure'])} to {number(flip['stopExposure'])} EV in "
            f"{flip['numExposures']} steps, {flip['tonemapper'].upper()}, {number(flip['ppd'])} pixels per "
            "degree</li>"
        )
    if "display" in comparison.settings:
        stops = comparison.settings["display"]["stops"]
        found.append(f"<li>ΔE00 and SSIM: shown at {number(stops)} EV, clipped, sRGB</li>")
    return f'<ul class="counts">{"".join(found)}</ul>' if found else ""


def _stage(index: int, cell: Cell, packed: Mapping[str, Facts] | None, bits: int) -> str:
    """Viewer, maps and charts of a cell with pictures."""
    limits = [
        (f"{gate.gate.rpartition('.')[2]}, {limit_name(gate.entry)}".replace("_", " "), gate.limit)
        for gate in cell.all_gates
        if gate.entry in ("p50", "p99", "p999", "max")
    ]
    pixels: Facts = {
        "stops": cell.display.stops,
        "limits": [limit for _, limit in limits],
        "images": {
            key: (packed[key] if packed else pack(image)) | {"name": LABELS.get(key, (key,))[0]}
            for key, image in cell.images.items()
        },
        "maps": {},
    }
    charts = []
    if cell.comparison is not None and cell.comparison.maps:
        pixels |= _maps(cell.comparison, bits)
        charts = _charts(cell.comparison, limits)
    first, second = cell.pair
    pixels["pair"] = list(cell.names)
    viewer = (
        asset("viewer.html").replace("{{A}}", _options(cell, first)).replace("{{B}}", _options(cell, second))
    )
    boxes = "".join(
        f'<figure class="chartbox"><figcaption>{title}</figcaption>{svg}</figure>' for title, svg in charts
    )
    labels = [label_of(key) for key in cell.images]
    meanings = "".join(f"<li><b>{name}</b>{': ' if text else ''}{text}</li>" for name, text in labels)
    height, width = cell.images[first].shape[:2]
    return (
        f'<div class="stage" style="--aspect:{width}/{height}">{viewer}<div class="maps"></div>'
        f'<div class="charts">{boxes}</div><ul class="meanings">{meanings}</ul>'
        f'<script type="application/json" class="pixels" id="pixels-{index}">{script_json(pixels)}</script>'
        "</div>"
    )


def _options(cell: Cell, chosen: str) -> str:
    return "".join(
        f'<option value="{escape(key)}"{" selected" if key == chosen else ""}>{label_of(key)[0]}</option>'
        for key in cell.images
    )


def _maps(comparison: Comparison, bits: int) -> Facts:
    """Errors per pixel for the page; in the order in which it shows them."""
    signed = signed_difference(comparison)
    finite = np.isfinite(comparison.maps["difference"]).all(-1)
    maps = {"difference": pack(np.where(finite, signed, np.nan), bits=bits)}
    for name in ("relative", "flip", "delta_e00"):
        if name in comparison.maps:
            maps[name] = pack(comparison.maps[name], bits=bits)
    if comparison.classes is not None:
        maps["classes"] = pack(comparison.classes, bits=4)
    if "p_value" in comparison.maps:
        maps["p_value"] = pack(np.nan_to_num(comparison.maps["p_value"], nan=1.0).min(-1), bits=4)
    return {"maps": maps, "full_scale": full_scale(signed, comparison.classes)}


def _charts(comparison: Comparison, limits: Sequence[tuple[str, float]]) -> list[tuple[str, str]]:
    if comparison.classes is None:
        return []
    charts = [("Relative errors", error_histogram(comparison.maps["relative"], comparison.classes, limits))]
    if "p_value" in comparison.maps:
        shown = comparison.maps["p_value"][comparison.classes != PixelClass.BACKGROUND]
        charts.append(("p-values outside the background", p_value_histogram(shown)))
    return charts
