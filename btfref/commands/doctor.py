"""Examine this machine: what works, what is missing, and what mends it.

Tries the Mitsuba variants and OpenGL, each in a process of its own; exit status 1 when something needed is
missing. With --mend, only the system libraries are looked at, and the missing ones are installed with apt.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from typing import TYPE_CHECKING

from btfref.commands.shared.options import add_json
from btfref.commands.shared.printing import bytes_text, emit, emit_json, printable
from btfref.commands.shared.stdout import stdout
from btfref.errors import MissingDependencyError

if TYPE_CHECKING:
    from btfref.doctor import Examination

_MARKS = {"ok": ("✓", "32"), "missing": ("✗", "31"), "warning": ("!", "33"), "absent": ("–", "2")}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    add_json(parser, "everything")
    parser.add_argument("--mend", action="store_true", help="install missing system libraries with apt")
    parser.add_argument("--for-tests", action="store_true", help="with --mend: also what only the tests need")


def run(args: Namespace) -> int:
    """Carry the command out."""
    if args.mend:
        return _mend(args.for_tests)
    from btfref.doctor import examine

    examination = examine()
    if args.json:
        emit_json(examination.to_dict())
    else:
        for line in lines(examination, colour=stdout().isatty()):
            emit(line, coloured=True)
    return 0 if examination.ok else 1


def lines(examination: Examination, *, colour: bool = False) -> Iterator[str]:
    """The examination for a reader, problems and their mends last."""

    def paint(text: str, code: str) -> str:
        return f"\x1b[{code}m{text}\x1b[0m" if colour else text

    machine = examination.facts["machine"]
    memory = machine["memory_total"], machine["memory_available"]
    if None not in memory:
        text = ", {} of {} memory free".format(*(bytes_text(n).split(" (")[0] for n in reversed(memory)))
    yield f"{machine['system']}, {machine['cores']} cores{text if None not in memory else ''}"
    group = None
    for check in examination.checks:
        if check.group != group:
            group = check.group
            yield ""
            yield paint(group[0].upper() + group[1:], "1")
        mark, code = _MARKS[check.status]
        yield f"  {paint(mark, code)} {printable(check.name):<17} {printable(check.value)}"
    troubles = [check for check in examination.checks if check.mend]
    yield ""
    for check in troubles:
        mark, code = _MARKS[check.status]
        yield f"{paint(mark, code)} {printable(check.name)}: {printable(check.value)}"
        yield f"    {printable(check.mend)}"
    yield (
        paint("All that btfref needs works here.", "32")
        if examination.ok
        else paint("Something that btfref needs is missing.", "31")
    )


def _mend(for_tests: bool) -> int:
    from btfref import system

    needed = system.missing()
    if needed:
        emit(f"installing {', '.join(requirement.name for requirement in needed)}", flush=True)
        emit(f"installed {' '.join(system.install(needed))}")
    if not for_tests:
        return 0
    for requirement in system.missing(tests=True):
        # One by one, and without failing: a distribution may lack one, and its tests then say why they skip.
        try:
            emit(f"installing {requirement.name}", flush=True)
            system.install([requirement])
        except MissingDependencyError as error:
            sys.stderr.write(f"btfref: warning: {error}; the tests that need it are skipped\n")
    return 0
