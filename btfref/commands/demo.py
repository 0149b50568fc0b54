"""Run the whole chain on a small material and write a report; exit status 1 when a gate fails.

Synthesizes a checker, compresses it, renders it on three scenes under three sets of lights with Mitsuba and
with OpenGL, and compares the images. A finished store is used again.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from typing import TYPE_CHECKING

from btfref.commands.shared.options import add_json
from btfref.commands.shared.printing import GATE_HEADER, Progress, emit, emit_json, gate_cells, table

if TYPE_CHECKING:
    from btfref.demo import DemoResult

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "folder"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "-o", "--output", default="output/demo", metavar="FOLDER", help="default: output/demo"
    )
    add_json(parser, "metrics, gates and times")


def run(args: Namespace) -> int:
    """Carry the command out."""
    from btfref.demo import demo

    with Progress() as progress:
        result = demo(args.output, progress=progress)
    if args.json:
        cells = {cell.name: cell.comparison and cell.comparison.to_dict() for cell in result.cells}
        emit_json(
            {"passed": result.passed, "report": result.report, "seconds": result.seconds, "cells": cells}
        )
    else:
        for line in lines(result):
            emit(line)
    return 0 if result.passed else 1


def lines(result: DemoResult) -> Iterator[str]:
    """The outcome for a reader: of each cell the gate that failed, or that is nearest to its limit."""
    from btfref.gates.verdicts import deciding

    rows = []
    for cell in result.cells:
        gate = deciding(cell.all_gates)
        rows.append([cell.name, *(gate_cells(gate) if gate else ["none", "–", "–", "–", "–", "FAIL"])])
    yield from table(rows, header=["cell", *GATE_HEADER])
    yield "A row has the gate that failed, or else the one nearest to its limit; the report has them all."
    yield ""
    yield ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in result.seconds.items())
    yield f"report: {result.report}"
