"""Validate methods and renderers: the whole matrix, and which stage is to blame; exit status 1 when a gate fails.

Every method is fitted to modelled mesostructures and rendered in shipped scenes under shipped lights by both renderers.
Each cell tells the error of every stage, from the path-traced mesostructure to the 8-bit picture. Results are kept by
content: what has not changed is not computed again. Methods of installed packages take part like btfref's own.

With --scheduler materials, views and methods are tasks of a Dask cluster: the cells and verdicts of the plain run. Its
workers share the cache folder. One with other code, versions, drivers or scene files is refused in one line.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.commands.shared.options import add_json, add_only, add_scheduler, words
from btfref.commands.shared.printing import Progress, absent_line, emit, emit_json, number, table
from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.validate.run import Validation

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "folder"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "--quick", action="store_true", help="one mesostructure, three views a method, small pictures"
    )
    add_only(parser)
    parser.add_argument("--scene", metavar="SCENE[,SCENE]", help="plane, sphere, cloth, or scene files")
    parser.add_argument("--lights", metavar="LIGHTS[,LIGHTS]", help="such as directional1, points2")
    parser.add_argument("--mesostructure", metavar="NAME[,NAME]", help="such as checker, rings, tissue")
    parser.add_argument(
        "-o", "--output", default="output/validation", metavar="FOLDER", help="default: output/validation"
    )
    parser.add_argument(
        "--cache", metavar="FOLDER", help="of results (default: BTFREF_CACHE, else the user's cache)"
    )
    add_scheduler(
        parser,
        see="whose workers run the same code and see the cache folder under the same name: on this machine, or on a "
        "shared file system",
        workers="processes, or workers of the local cluster (default: by cores and memory)",
    )
    parser.add_argument("--no-report", action="store_true", help="numbers only")
    add_json(parser, "the result")
    parser.add_argument(
        "--self-test",
        action="store_true",
        help="inject known faults instead; each must be caught by its gate",
    )


def run(args: Namespace) -> int:
    """Carry the command out."""
    if args.self_test:
        return _self_test(args)
    from btfref.validate.matrix import FULL, QUICK, select
    from btfref.validate.run import validate

    specs = select(
        only=words(args.only),
        scenes=words(args.scene),
        lights=words(args.lights),
        mesostructures=words(args.mesostructure),
        quick=args.quick,
    )
    settings = QUICK if args.quick else FULL
    with Progress() as progress:
        result = validate(
            specs,
            settings=settings,
            cache=args.cache,
            workers=args.workers,
            scheduler=args.scheduler,
            progress=progress,
        )
        report = None
        if not args.no_report:
            from btfref.report.validation import write_validation

            report = write_validation(Path(args.output), result, progress=progress)
    if args.json:
        emit_json(result.to_dict())
    else:
        for line in lines(result):
            emit(line)
        if report:
            emit(f"report: {report}")
    return 0 if result.passed else 1


def lines(result: Validation) -> Iterator[str]:
    """The outcome for a reader: a row a method and mesostructure, what failed, what took how long."""
    from btfref.validate.summary import HEADER, additivity, rows

    yield from table(
        [[number(c) if isinstance(c, float) else c for c in row] for row in rows(result)], header=HEADER
    )
    yield ""
    for name, gate in result.failed_gates:
        yield f"{name}: {gate.line}"
    for name in result.facts.get("absent", ()):
        yield absent_line(name)
    passed = sum(cell.outcome == "pass" for cell in result.cells)
    yield (
        f"{passed} of {len(result.cells)} cells pass; {additivity(result)}; "
        f"{result.computed} of {result.jobs} jobs computed, {result.seconds:.0f} s"
    )


def _self_test(args: Namespace) -> int:
    if args.scheduler is not None:
        raise InputError("the self-test runs in this process", field="--scheduler", got="beside --self-test")
    from btfref.validate.injected.faults import FAULTS
    from btfref.validate.self_test import Caught, possible, self_test

    with Progress() as progress:
        caught = self_test(progress=progress)
    if args.json:
        emit_json({"kind": "self-test", "schema": 1, "faults": [fault.to_dict() for fault in caught]})
    else:
        for line in table([fault.row for fault in caught], header=Caught.HEAD):
            emit(line)
        if len(possible()) < len(FAULTS):
            emit(absent_line("webgl"))
    return 0 if all(fault.caught for fault in caught) else 1
