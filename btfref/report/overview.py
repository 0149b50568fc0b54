"""The head of the report: the verdict and the table of cells by gates."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from btfref.conventions import PixelClass
from btfref.gates.verdicts import GateResult, limit_name
from btfref.report.cell import Cell, full_scale, label_of, signed_difference
from btfref.report.figures import diverging, thumbnail
from btfref.report.text import badge, number

#: Column title and metric of the interior, after the gates.
SHOWN = {"ΔE00": "delta_e00_mean", "FLIP": "flip_mean", "RMSE / mean": "nrmse"}


def verdict(cells: Sequence[Cell]) -> str:
    """One line on all cells.

    Parameters
    ----------
    cells : sequence of Cell

    Returns
    -------
    str
    """
    outcomes = [gate.outcome for cell in cells for gate in cell.all_gates]
    failed, undecided = outcomes.count("fail"), outcomes.count("inconclusive")
    bad = [cell for cell in cells if cell.outcome != "pass"]
    worst = "pass" if not bad else "fail" if any(cell.outcome == "fail" for cell in bad) else "inconclusive"
    word = {"pass": "All gates pass", "fail": "Gates fail", "inconclusive": "Not all gates are decided"}[
        worst
    ]
    counts = f"{len(outcomes) - failed - undecided} of {len(outcomes)} limits kept, {len(cells)} cells"
    if bad:
        counts += f", {len(bad)} of them not passed"
    return f'<p class="verdict {worst}"><strong>{word}</strong><span>{counts}</span></p>'


def overview(cells: Sequence[Cell]) -> str:
    """Cells by gates, each value coloured by its outcome.

    Parameters
    ----------
    cells : sequence of Cell

    Returns
    -------
    str
        A ``<table>`` in a box that scrolls sideways.
    """
    gates = {gate.name: gate for cell in cells for gate in cell.all_gates}
    groups: dict[str, list[GateResult]] = {}
    for gate in gates.values():
        groups.setdefault(gate.gate, []).append(gate)
    names = {key: escape(key).replace(".", ".<wbr>") for key in groups}
    top = "".join(
        f'<th scope="colgroup" colspan="{len(members)}"><code>{names[key]}</code>'
        f"<small>{escape(members[0].pixel_class or '')}</small></th>"
        for key, members in groups.items()
    )
    columns = [gate for members in groups.values() for gate in members]
    heads = [
        f"{escape(limit_name(gate.entry, short=True))}<small>{gate.sign} {number(gate.limit)}</small>"
        for gate in columns
    ]
    sub = "".join(f'<th scope="col">{head}</th>' for head in (*heads, *SHOWN))
    rows = "".join(_row(index, cell, [gate.name for gate in columns]) for index, cell in enumerate(cells, 1))
    return (
        '<div class="scroll"><table class="overview"><thead>'
        f'<tr><th rowspan="2" scope="col">cell</th><th rowspan="2" scope="col">outcome</th>{top}'
        f'<th scope="colgroup" colspan="{len(SHOWN)}">interior, mean</th></tr><tr>{sub}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(index: int, cell: Cell, columns: Sequence[str]) -> str:
    found = {gate.name: gate for gate in cell.all_gates}
    values = []
    for name in columns:
        gate = found.get(name)
        if gate is None:
            values.append('<td class="muted">·</td>')
            continue
        title = escape(f"{gate.sign} {number(gate.limit)}. {gate.detail}")
        sign = {"fail": " ✗", "inconclusive": " ?"}.get(gate.outcome, "")
        values.append(f'<td class="{gate.outcome}" title="{title}">{escape(number(gate.value))}{sign}</td>')
    measured = (cell.comparison.metrics if cell.comparison else {}).get(PixelClass.INTERIOR.label, {})
    values += [f"<td>{number(measured.get(key))}</td>" for key in SHOWN.values()]
    link = f'<a href="#cell-{index}">{_thumbnails(cell)}<span>{escape(cell.name)}</span></a>'
    return f'<tr><th scope="row">{link}</th><td>{badge(cell.outcome)}</td>{"".join(values)}</tr>'


def _thumbnails(cell: Cell) -> str:
    """The first two pictures and their signed difference."""
    if not cell.images:
        return ""
    pictures = {label_of(key)[0]: cell.display.encoded(cell.images[key]) for key in cell.pair}
    if cell.comparison is not None and "difference" in cell.comparison.maps:
        signed = signed_difference(cell.comparison)
        pictures["difference"] = diverging(signed / full_scale(signed, cell.comparison.classes))
    return "".join(
        f'<img src="{thumbnail(picture)}" alt="{name}" width="38" height="38">'
        for name, picture in pictures.items()
    )
