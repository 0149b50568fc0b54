"""Stress the numerical stability of all methods: hard lookups, hard data, symmetries of fits.

Values of the ports (Dr.Jit with and without FastMath, GLSL, and WebGL 2 where there is a Chromium) are judged against
the float64 definition, by relative error and in units in the last place; fits by determinism, symmetry and monotone
error. Every failure is one line with a command that shows it alone. Exit status 1 when anything failed.

  btfref stress --only lpca
  btfref stress --long -o stress.md
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_json, add_only, add_overwrite, add_seed, words
from btfref.commands.shared.printing import Progress, absent_line, emit, emit_json
from btfref.commands.shared.reading import output_file
from btfref.errors import InputError

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "text"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    add_only(parser)
    parser.add_argument("--data", metavar="NAME[,NAME]", help="these data only, and lookups only")
    parser.add_argument("--evaluator", metavar="NAME[,NAME]", help="these ports only")
    parser.add_argument("--long", action="store_true", help="all ports on all data: more than 10⁶ lookups")
    add_seed(parser)
    parser.add_argument(
        "--case", metavar="BLOCK:INDEX:SIZE", help="show this lookup alone, as a reproducer says"
    )
    parser.add_argument("--storage", metavar="NAME", help="of the fit, with --case")
    parser.add_argument("-o", "--output", metavar="FILE.md", help="write the tables as Markdown")
    add_json(parser, "everything")
    add_overwrite(parser)


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, ".md") if args.output else None

    from btfref.outputs import new_file
    from btfref.stress.runner import run as stress
    from btfref.stress.runner import show_case
    from btfref.stress.table import check_table, evaluator_table, failure_lines

    if args.case:
        if not (args.only and args.data and args.evaluator):
            raise InputError("a case needs its method, data and evaluator", field="--case", got=args.case)
        shown = show_case(
            args.only, args.data, args.evaluator, args.case, seed=args.seed, storage=args.storage
        )
        if args.json:
            emit_json(shown)
        else:
            for name, value in shown.items():
                emit(f"{name}: {value}")
        return int(shown["failed"])
    with Progress() as progress:
        result = stress(
            only=words(args.only),
            data=words(args.data),
            evaluators=words(args.evaluator),
            long=args.long,
            seed=args.seed,
            progress=progress,
        )
    findings = result["findings"]
    if out:
        lines = [*evaluator_table(findings), "", *check_table(findings), ""]
        with new_file(out) as draft:
            draft.write_text("\n".join(lines), "utf-8")
    if args.json:
        emit_json(result | {"findings": [f.to_dict() for f in findings]})
    else:
        for line in (*evaluator_table(findings), "", *check_table(findings), "", *failure_lines(findings)):
            emit(line)
        emit(
            f"{result['cases']} cases, {result['failures']} failures, {result['explained']} explained by the "
            "rounding of their arguments"
        )
        for name in result["parameters"]["absent"]:
            emit(absent_line(name))
    return int(result["failures"] > 0)
