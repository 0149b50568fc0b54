"""The report of a validation: a folder that opens from disk, an overview and one page a cell."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.gates.verdicts import GateResult
from btfref.querying.split import LOOKUPS
from btfref.report.cell import Cell, asset, script_json
from btfref.report.figures import thumbnail
from btfref.report.pack import pack, pack_text
from btfref.report.pareto import Panel, Point, pareto_svg
from btfref.report.stage import article
from btfref.report.text import badge, facts_list, gate_list, number
from btfref.report.waterfall_figure import waterfall_section
from btfref.types import Facts, PathLike, Progress
from btfref.validate.cell import CellResult, gate_from
from btfref.validate.run import Validation, method_name
from btfref.validate.summary import HEADER, additivity, off_grid_rows, rows

if TYPE_CHECKING:
    from btfref.validate.self_test import Caught

#: Mantissa bits of pictures and of error maps on the pages: enough for eyes, and little to store.
PICTURE_BITS, MAP_BITS = 6, 4

#: What the matrix can show: label → number of a cell's facts, or None.
SHOWN: dict[str, Callable[[Facts], float | None]] = {
    "outcome": lambda facts: None,
    "whole, RMSE / mean": lambda facts: _relative(facts, "total"),
    "fit, RMSE / mean": lambda facts: _relative(facts, "fit"),
    "sampled BTF, RMSE / mean": lambda facts: _relative(facts, "sampled BTF"),
    "real time, RMSE / mean": lambda facts: _relative(facts, "real time"),
    "whole, ΔE00": lambda facts: _whole_colour(facts),
}


def write_validation(
    folder: PathLike,
    result: Validation,
    *,
    self_test: Sequence[Caught] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the report.

    Parameters
    ----------
    folder : path-like
        Made if missing; what an earlier report left in it is replaced.
    result : btfref.validate.run.Validation
    self_test : list of btfref.validate.self_test.Caught, optional
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    pathlib.Path
        ``index.html``; beside it ``validation.json``, the same numbers.
    """
    folder, report = Path(folder), progress or (lambda *_: None)
    for name in ("cells", "assets"):
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name).mkdir(parents=True)
    for name in ("report.css", "report.js", "validation.js"):
        (folder / "assets" / name).write_text(asset(name), "utf-8")
    _shared_pictures(folder, result)
    thumbnails = {}
    for done, cell in enumerate(result.cells):
        report(done, len(result.cells), "writing pages")
        thumbnails[cell.facts["name"]] = _cell_page(folder, result, done)
    report(len(result.cells), len(result.cells), "writing pages")
    _index(folder, result, self_test, thumbnails)
    # More than six digits no picture of float32 gives.
    text = json.dumps(_rounded(result.to_dict()), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    (folder / "validation.json").write_text(text + "\n", "utf-8")
    return folder / "index.html"


def slug(facts: Facts) -> str:
    """Name of a cell's page."""
    # Scenes and mesostructures may be files; a method's name stays whole, whatever it holds.
    words = (
        Path(str(facts["mesostructure"])).stem,
        str(facts["method"]),
        Path(str(facts["scene"])).stem,
        str(facts["lights"]),
    )
    return "-".join("".join(c if c.isalnum() or c in "_." else "_" for c in word) for word in words)


def _rounded(value: Any, digits: int = 6) -> Any:
    """JSON-able data whose floats have so many digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {name: _rounded(inner, digits) for name, inner in value.items()}
    return [_rounded(inner, digits) for inner in value] if isinstance(value, list | tuple) else value


def _view(facts: Facts) -> str:
    """What all methods' cells of a scene, its lights and a mesostructure share."""
    return "-".join(slug(facts | {"method": ""}).split("--"))


def _shared_pictures(folder: Path, result: Validation) -> None:
    """The truth, and the pixel classes, once for all methods."""
    for cell in result.cells:
        path = folder / "assets" / f"{_view(cell.facts)}.js"
        if "truth" in cell.images and not path.exists():
            packed = pack(cell.images["truth"], bits=PICTURE_BITS)
            path.write_text(
                f"(globalThis.sharedPictures ??= {{}}).truth = {script_json(packed)};\n", encoding="utf-8"
            )


def _packed(images: Mapping[str, np.ndarray]) -> dict[str, Facts]:
    """Pictures for a page: the truth by name, real time by what differs from the reference."""
    packed = {"truth": {"shared": "truth"}} if "truth" in images else {}
    if "reference" in images:
        packed["reference"] = pack(images["reference"], bits=PICTURE_BITS)
    for name in images:
        if name not in packed:
            base = ("reference", images["reference"]) if "reference" in images else None
            packed[name] = pack(images[name], bits=PICTURE_BITS, base=base)
    return {name: packed[name] for name in sorted(packed, key=lambda n: n != "reference")}


def _cell_page(folder: Path, result: Validation, index: int) -> str:
    """Write a cell's page; returns a thumbnail of its picture, or nothing."""
    made, facts = result.cells[index], result.cells[index].facts
    comparison = made.comparison()
    own = {gate.name for gate in comparison.gates} if comparison else set()
    images = {name: made.images[name] for name in sorted(made.images, key=lambda n: n != "reference")}
    # The waterfall says it below.
    notes = facts["notes"].removeprefix((facts["waterfall"] or {}).get("explanation", "")).strip()
    cell = Cell(facts["name"], images, comparison, notes, tuple(g for g in made.gates if g.name not in own))
    body = article(
        index + 1, cell, extra=waterfall_section(facts["waterfall"]), images=_packed(images), bits=MAP_BITS
    )
    body = body.replace('href="#overview"', 'href="../index.html"')
    body = f'<script type="text/plain" id="packed">{pack_text(body)}</script>'
    names = [c.facts for c in result.cells]
    around = [("← previous", index - 1), ("next →", index + 1)]
    links = [f'<a href="{slug(names[k])}.html">{word}</a>' for word, k in around if 0 <= k < len(names)]
    shared = f'<script src="../assets/{_view(facts)}.js"></script>' if "truth" in images else ""
    page = _page(
        title=facts["name"],
        heading=escape(facts["name"]),
        verdict="",
        root="../",
        nav="".join(['<a href="../index.html">Overview</a>', *links]),
        noscript="This page needs JavaScript; the overview does not.",
        main=body,
        scripts=f'{shared}<script src="../assets/report.js"></script>',
    )
    (folder / "cells" / f"{slug(facts)}.html").write_text(page, "utf-8")
    return thumbnail(cell.display.encoded(images["reference"]), size=28) if images else ""


def _page(**slots: str) -> str:
    head, *rest = asset("page.html").split("{{")
    slots["title"] = escape(slots["title"])
    for part in rest:
        name, _, text = part.partition("}}")
        head += slots[name] + text
    return head


def _index(
    folder: Path, result: Validation, self_test: Sequence[Caught] | None, thumbnails: Mapping[str, str]
) -> None:
    outcomes = [cell.outcome for cell in result.cells]
    failed = result.failed_gates
    kind, word = ("pass", "All gates pass") if result.passed else ("fail", "Gates fail")
    counts = f"{outcomes.count('pass')} of {len(outcomes)} cells pass; {additivity(result)}"
    sections = [
        ("matrix", "Matrix", _matrix(result, thumbnails)),
        ("failures", "What failed", _failures(failed) if failed else '<p class="muted">Nothing.</p>'),
        ("off-grid", "At directions that nobody fitted", _off_grid(result)),
        ("summary", "Summary", _summary(result)),
        ("pareto", "Error against bytes and time", _pareto(result)),
        ("methods", "Evaluators and sampling", _methods(result)),
    ]
    if self_test:
        sections.append(("self-test", "Self-test", _self_test(self_test)))
    facts = {
        **result.settings.to_dict(),
        "seconds": round(result.seconds, 1),
        "jobs": f"{result.computed} of {result.jobs} computed, the others kept",
        **result.facts,
    }
    sections.append(("facts", "Facts", f'<div class="facts">{facts_list(facts)}</div>'))
    page = _page(
        title="btfref validation",
        heading="Validation",
        verdict=f'<p class="verdict {kind}"><strong>{word}</strong><span>{counts}</span></p>',
        root="",
        noscript="Without JavaScript the tables and figures are complete; the choice of numbers needs it.",
        nav="".join(f'<a href="#{key}">{title}</a>' for key, title, _ in sections)
        + '<a href="validation.json">JSON</a>',
        main="".join(
            f'<section id="{key}"><h2>{title}</h2>{html}</section>' for key, title, html in sections
        ),
        scripts='<script src="assets/report.js"></script><script src="assets/validation.js"></script>',
    )
    (folder / "index.html").write_text(page, "utf-8")


def _relative(facts: Facts, stage: str) -> float | None:
    fall = facts["waterfall"]
    if not fall or not fall["mean"]:
        return None
    if stage == "total":
        return fall["total"]["estimate"] / fall["mean"]
    found = [s["rmse"]["estimate"] for s in fall["stages"] if s["name"] == stage]
    return found[0] / fall["mean"] if found else None


def _whole_colour(facts: Facts) -> float | None:
    fall = facts["waterfall"]
    return fall["stages"][-1]["delta_e00_so_far"]["estimate"] if fall else None


def _matrix(result: Validation, thumbnails: Mapping[str, str]) -> str:
    """Methods by scenes and lights; what a cell shows is chosen above it."""
    cells = {
        (c.facts["mesostructure"], c.facts["method"], c.facts["scene"], c.facts["lights"]): c
        for c in result.cells
    }
    views = sorted({key[2:] for key in cells})
    owners = sorted({key[:2] for key in cells})
    peaks = {
        name: max((v for c in result.cells if (v := show(c.facts)) is not None), default=1.0)
        for name, show in SHOWN.items()
    }
    head = "".join(
        f'<th scope="col">{escape(Path(s).stem)}<small>{escape(light)}</small></th>' for s, light in views
    )
    body, before = [], None
    for owner in owners:
        entries = []
        for view in views:
            cell = cells.get((*owner, *view))
            entries.append(_entry(cell, peaks, thumbnails) if cell else '<td class="muted">·</td>')
        first = ' class="first"' if owner[0] != before else ""
        before = owner[0]
        body.append(
            f'<tr data-mesostructure="{escape(owner[0])}"{first}><th scope="row">{escape(owner[1])} '
            f'<span class="muted">{escape(owner[0])}</span></th>{"".join(entries)}</tr>'
        )
    values = "".join(f"<option>{escape(name)}</option>" for name in SHOWN)
    materials = "".join(f"<option>{escape(m)}</option>" for m in sorted({o[0] for o in owners}))
    return (
        f'<div class="controls"><label>Show <select id="value">{values}</select></label>'
        f'<label>Mesostructure <select id="filter"><option value="">all</option>{materials}</select></label></div>'
        f'<div class="scroll"><table class="matrix"><thead><tr><th scope="col">method</th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _entry(cell: CellResult, peaks: Mapping[str, float], thumbnails: Mapping[str, str]) -> str:
    facts = cell.facts
    numbers = {name: show(facts) for name, show in SHOWN.items()}
    sign = {"pass": "✓", "fail": "✗", "inconclusive": "?"}[cell.outcome]
    # In the order of the choice above the matrix.
    values = [sign if name == "outcome" else number(v, 2) for name, v in numbers.items()]
    shades = [
        str(round(55 * v / peaks[name]) if v is not None and peaks[name] else 0)
        for name, v in numbers.items()
    ]
    picture = thumbnails.get(facts["name"])
    image = f'<img src="{picture}" alt="" width="38" height="38" loading="lazy">' if picture else ""
    data = {"values": "|".join(values), "shades": "|".join(shades)}
    attributes = " ".join(f'data-{name}="{escape(text)}"' for name, text in data.items())
    link = f'<a href="cells/{slug(facts)}.html" title="{escape(facts["name"])}">'
    return f'<td class="{cell.outcome}" {attributes}>{link}{image}<span class="value">{sign}</span></a></td>'


def _failures(failed: Iterable[tuple[str, GateResult]]) -> str:
    return (
        "<ul>" + "".join(f"<li>{escape(name)}: {escape(gate.line)}</li>" for name, gate in failed) + "</ul>"
    )


def _table(header: Iterable[str], body: Iterable[Iterable[Any]]) -> str:
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in header)
    lines = "".join(
        "<tr>"
        + "".join(f"<td>{escape(number(c) if not isinstance(c, str) else c)}</td>" for c in row)
        + "</tr>"
        for row in body
    )
    table = f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>'
    return f'<div class="scroll">{table}</div>'


def _summary(result: Validation) -> str:
    note = (
        "Off the grid: root mean square ΔE00 and mean absolute error (1/sr) of texels at directions that nobody "
        "fitted. RMSE of each stage alone over the truth's mean, root mean square over the cells; ΔE00 of the whole."
    )
    return _table(HEADER, rows(result)) + f'<p class="notes">{note}</p>'


def _off_grid(result: Validation) -> str:
    """Errors by mesostructure, method and footprint, with their intervals."""
    header, lines = off_grid_rows(result)
    if not lines:
        return '<p class="muted">Nothing was asked.</p>'
    note = (
        "The surface itself, path traced at random places and pairs of directions up to 85°, the same for all methods "
        "and fitted by none; the noise of these values is taken out, brackets are 99 % intervals. A footprint is "
        f"averaged over {LOOKUPS} places."
    )
    return _table(header, lines) + f'<p class="notes">{note}</p>'


def _pareto(result: Validation) -> str:
    """Error of the fit against bytes, and of the whole against the time of a frame; a colour a mesostructure."""
    by_bytes, by_time = [], []
    for row in rows(result):
        name = dict(zip(HEADER, row, strict=True))
        if name["total"] and name["bytes"]:
            by_bytes.append(Point(name["method"], name["bytes"], name["total"], name["mesostructure"]))
        times = [
            c.facts["frame_ms"]
            for c in result.cells
            if c.facts.get("frame_ms")
            and (c.facts["mesostructure"], c.facts["method"]) == (name["mesostructure"], name["method"])
        ]
        if name["total"] and times:
            median = sorted(times)[len(times) // 2]
            by_time.append(Point(name["method"], median, name["total"], name["mesostructure"]))
    panels = [
        Panel(title, label, "RMSE of the picture / mean", points)
        for title, label, points in (
            ("Error against bytes", "bytes of the maps", by_bytes),
            ("Error against time", "frame in ms, one sample a pixel", by_time),
        )
        if points
    ]
    if not panels:
        return '<p class="muted">No method has both numbers.</p>'
    note = (
        "Times were taken while other cells were computed, on the renderer that the facts name: they order methods "
        "roughly. <code>btfref bench</code> measures them."
    )
    return f'<div class="pareto">{pareto_svg(panels)}</div><p class="notes">{note}</p>'


def _methods(result: Validation) -> str:
    parts = []
    for facts in result.methods:
        gates = [gate_from(gate) for gate in facts["gates"]]
        outcome = "pass" if gates and all(gate.passed for gate in gates) else "fail"
        notes = f'<p class="alert">{escape(facts["notes"])}</p>' if facts.get("notes") else ""
        summary = f"<summary>{escape(method_name(facts))} {badge(outcome)}</summary>"
        parts.append(f"<details>{summary}{notes}{gate_list(gates)}</details>")
    return "".join(parts)


def _self_test(caught: Sequence[Caught]) -> str:
    return _table(caught[0].HEAD, [fault.row for fault in caught])
