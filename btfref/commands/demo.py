"""Run the whole chain on a small material and write a report; exit status 1 when a gate fails.

Synthesizes a checker, compresses it, renders it on three scenes under three sets of lights with Mitsuba and
with OpenGL, and compares the images. A finished store is used again.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_json
from btfref.commands.shared.printing import Progress, emit, emit_json, number, table


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
        cells = {cell.name: cell.comparison.to_dict() for cell in result.cells}
        emit_json(
            {"passed": result.passed, "report": result.report, "seconds": result.seconds, "cells": cells}
        )
    else:
        for line in lines(result):
            emit(line)
    return 0 if result.passed else 1


def lines(result):
    """The outcome for a reader."""
    rows = []
    for cell in result.cells:
        failed = [gate.name for gate in cell.all_gates if not gate.passed]
        metrics = cell.comparison.metrics.get("interior") or cell.comparison.metrics["all"]
        errors = [number(metrics.get(name)) for name in ("rel_p999", "rel_max")]
        rows.append([cell.name, *errors, f"FAIL {', '.join(failed)}" if failed else "pass"])
    yield from table(rows, header=["scene", "p99.9", "max", "gates"])
    yield ""
    yield ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in result.seconds.items())
    yield f"report: {result.report}"
