"""One self-contained HTML file from cells of pictures and their comparisons."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from btfref.comparison.comparison import json_safe
from btfref.errors import InputError
from btfref.gates.tolerances import gate_table
from btfref.report.cell import Cell, asset, script_json
from btfref.report.overview import overview, verdict
from btfref.report.stage import article
from btfref.report.text import facts_list
from btfref.types import Facts, PathLike


def report_data(title: str, cells: Sequence[Cell], facts: Facts) -> Facts:
    """The report as strict JSON: everything but the pixels.

    Parameters
    ----------
    title : str
    cells : sequence of Cell
    facts : dict

    Returns
    -------
    dict
    """
    gates = {gate.gate for cell in cells for gate in cell.all_gates}
    return json_safe(
        {
            "kind": "report",
            "schema": 1,
            "title": title,
            "passed": bool(cells) and all(cell.outcome == "pass" for cell in cells),
            "facts": facts,
            "gates": {key: gate_table(key) for key in sorted(gates)},
            "cells": [
                {
                    "name": cell.name,
                    "outcome": cell.outcome,
                    "notes": cell.notes,
                    "images": list(cell.images),
                    "comparison": cell.comparison.to_dict() if cell.comparison else None,
                    "gates": [gate.to_dict() for gate in cell.gates],
                }
                for cell in cells
            ],
        }
    )


def write_report(path: PathLike, *, title: str, cells: Iterable[Cell], facts: Facts) -> Path:
    """Write a report that opens anywhere, and its numbers beside it.

    Parameters
    ----------
    path : path-like
        ``….html``; the same name with ``.json`` holds `report_data`. Both appear complete or not at all, and
        their bytes depend on the arguments alone.
    title : str
    cells : sequence of Cell
        At least one.
    facts : dict
        Versions, seeds, machine, commands and so on: nested dicts, lists of text lines, plain values. A
        time of writing belongs here if it is wanted.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        No cells, pictures of different shapes within a cell, a wrong ending or a missing folder.
    """
    from btfref.outputs import new_file

    path, cells = Path(path), list(cells)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError("a report is an HTML file", file=path, got=repr(path.suffix), expected=".html")
    if not cells:
        raise InputError("a report needs a cell", file=path, field="cells", got=0)
    for cell in cells:
        cell.check()
    data = report_data(title, cells, facts)
    slots = {
        "title": escape(title),
        "css": asset("report.css"),
        "js": asset("report.js"),
        "verdict": verdict(cells),
        "overview": overview(cells),
        "cells": "".join(article(index, cell) for index, cell in enumerate(cells, 1)),
        "facts": facts_list(json_safe(facts)),
        "data": script_json(data),
    }
    html = asset("report.html")
    head, *rest = html.split("{{")
    for part in rest:
        name, _, text = part.partition("}}")
        head += slots[name] + text
    with new_file(path) as draft:
        draft.write_text(head, "utf-8")
    with new_file(path.with_suffix(".json")) as draft:
        draft.write_text(json.dumps(data, sort_keys=True, indent=1, allow_nan=False) + "\n", "utf-8")
    return path
