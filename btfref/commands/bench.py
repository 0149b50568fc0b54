"""Measure run time, and error beside it.

A plan (a shipped one by its name, or a file NAME.toml) measures methods and their peers and keeps raw results; a suite
answers one question of one method. "report" makes tables and diagrams of the results of plans, "compare" sets two
folders of results side by side. Times are medians of interleaved rounds after a warm-up; ratios are medians of paired
rounds.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.bench import PICTURED, SUITES
from btfref.bench.plan import SUFFIX, shipped
from btfref.commands.shared.options import (
    add_data_folder,
    add_json,
    add_only,
    add_overwrite,
    add_scheduler,
    words,
)
from btfref.commands.shared.printing import Progress, emit, emit_json, table
from btfref.commands.shared.reading import output_file
from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF

#: Words in the place of a suite that read results instead.
READERS = ("compare", "report")

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "", "plot": "picture", "report": "page"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    plans, suites = ", ".join(shipped()), ", ".join(sorted(SUITES))
    parser.add_argument(
        "suite", metavar="WHAT", help=f"a plan ({plans}, or FILE.toml), a suite ({suites}), report or compare"
    )
    parser.add_argument("folders", nargs="*", metavar="FOLDER", help="results, for report and compare")
    parser.add_argument("--quick", action="store_true", help="less data or fewer rounds")
    parser.add_argument("--btf", metavar="BTF", help="a sampled BTF (.btf.zarr) instead of the suite's own")
    add_only(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="FOLDER|FILE.jsonl",
        help="raw results: a folder for plans (and for the report), a file to append a line to for suites",
    )
    parser.add_argument(
        "--dataset",
        metavar="SET",
        help="fit a plan's methods to a standard data set (btf-1, or btf-1/MATERIAL), ask its test queries and write "
        "rows for btfref board into -o FOLDER",
    )
    add_data_folder(parser)
    parser.add_argument(
        "--plot", metavar="FILE.png", help="draw how the cost (suite synth) or the error (env) grows"
    )
    parser.add_argument(
        "--report", metavar="FILE.html", help="a page with the pictures, of suites that have any"
    )
    add_scheduler(
        parser,
        see="whose workers run the same code and see -o FOLDER under the same name (on this machine or a shared file "
        "system): they build a plan's methods and find their errors; builds are timed on all processors of a worker's "
        "machine, one at a time there; all other times are measured here when no worker is at work",
    )
    add_json(parser, "metrics or the raw result")
    add_overwrite(parser)


def run(args: Namespace) -> int:
    """Carry the command out."""
    if args.scheduler is not None and (args.dataset or not _is_plan(args.suite)):
        raise InputError("workers are for plans", field="--scheduler", got=args.dataset or args.suite)
    if args.suite in READERS:
        return _compare(args) if args.suite == "compare" else _report(args)
    if args.folders:
        raise InputError("folders are for report and compare", field="FOLDER", got=args.folders[0])
    if args.dataset and not _is_plan(args.suite):
        raise InputError("a data set is for plans", field="--dataset", got=args.suite, expected="methods")
    if _is_plan(args.suite):
        return _rows(args) if args.dataset else _plan(args)
    if args.suite in SUITES:
        return _suite(args)
    known = ", ".join([*shipped(), *sorted(SUITES), *READERS])
    raise InputError("no such plan or suite", field="WHAT", got=args.suite, expected=known)


def _is_plan(word: str) -> bool:
    return word in shipped() or word.endswith(SUFFIX)


def _plan(args: Namespace) -> int:
    import tempfile

    from btfref.bench.matrix import run as run_plan
    from btfref.bench.metrics import read_records, rows
    from btfref.bench.plan import read_plan
    from btfref.bench.tables import tables

    if args.plot or args.report:
        raise InputError("diagrams of plans are made by: btfref bench report FOLDER", field="--report")
    plan = read_plan(shipped().get(args.suite, args.suite), quick=args.quick, only=words(args.only))
    with tempfile.TemporaryDirectory() as scratch, Progress() as progress:
        folder = Path(args.output or scratch)
        number = run_plan(
            plan,
            folder,
            btf=_btf(args),
            scheduler=args.scheduler,
            workers=args.workers,
            progress=progress,
        )
        records = [r for r in read_records(folder) if number in (r.get("run"), r.get("id"))]
        found = rows(folder, records)
    if args.json:
        emit_json({"run": records[0], "metrics": found})
        return 0
    for title, header, lines in tables(found):
        emit(title)
        for line in table(lines, header=header):
            emit(line)
        emit()
    if "off_grid" in plan.measures and not any(row["kind"] == "off_grid" for row in found):
        emit("no errors off the grid: the geometry that the BTF is of is not known")
    return 0


def _rows(args: Namespace) -> int:
    from btfref.bench.plan import read_plan
    from btfref.board.baselines import refuse_other_data, run
    from btfref.datasets.sets import FOLDER

    if not args.output:
        raise InputError("rows of a board are files", field="-o", expected="a folder for them")
    plan = read_plan(shipped().get(args.suite, args.suite), quick=args.quick, only=words(args.only))
    refuse_other_data(plan, args.btf)
    with Progress() as progress:
        written = run(
            plan, args.dataset, args.output, tier=args.tier, folder=args.folder or FOLDER, progress=progress
        )
    if args.json:
        emit_json([str(path) for path in written])
        return 0
    for path in written:
        emit(str(path))
    return 0


def _report(args: Namespace) -> int:
    import json

    from btfref.bench.tables import markdown, panels, summary, tables
    from btfref.report.pareto import draw_pareto, pareto_table

    if len(args.folders) != 1 or not args.output:
        raise InputError("report needs one folder of results, and -o FOLDER", field="FOLDER")
    made = summary(args.folders[0])
    out = Path(args.output)
    out.mkdir(parents=True, exist_ok=True)
    lines = []
    for title, header, rows in tables(made["metrics"]):
        lines += markdown(title, header, rows)
    for material in made["front"]:
        diagrams = panels(made["metrics"], material)
        if diagrams:
            draw_pareto(diagrams, out / f"{material}.png")
            lines += [f"![{material}]({material}.png)", ""]
            for diagram in diagrams:
                lines += [f"**{material}: {diagram.x_label}**", "", *pareto_table(diagram), ""]
    (out / "tables.md").write_text("\n".join(lines))
    (out / "summary.json").write_text(json.dumps(made, indent=1))
    emit(f"{out / 'tables.md'}")
    return 0


def _compare(args: Namespace) -> int:
    from btfref.bench.tables import compared

    if len(args.folders) != 2:
        raise InputError("compare needs two folders of results", field="FOLDER", got=len(args.folders))
    found = compared(*args.folders)
    if not found:
        raise InputError("the two have no measurement in common", field="FOLDER", got=" ".join(args.folders))
    if args.json:
        emit_json(found)
        return 0
    number = lambda x: "–" if x is None else f"{x:.4g}"  # noqa: E731
    lines = [(r["what"], *(number(r[k]) for k in ("first", "second", "ratio", "low", "high"))) for r in found]
    for line in table(lines, header=("what", "first", "second", "ratio", "95 % from", "to")):
        emit(line)
    return 0


def _suite(args: Namespace) -> int:
    import importlib
    import json

    from btfref.bench.options import Options

    out = output_file(args.output, ".jsonl") if args.output else None
    plot = output_file(args.plot, ".png") if args.plot else None
    suite = importlib.import_module(SUITES[args.suite])
    if plot and args.suite != "synth" and not hasattr(suite, "plot"):
        raise InputError("this suite has no plot", field="--plot", got=args.suite, expected="env or synth")
    only = words(args.only)
    if plot and args.suite == "synth" and only and "growth" not in only:
        raise InputError(
            "the plot is that of the growth", field="--only", got=args.only, expected="growth too"
        )
    if args.report and args.suite not in PICTURED:
        raise InputError(
            "this suite has no pictures", field="--report", got=args.suite, expected=" or ".join(PICTURED)
        )
    report = output_file(args.report, ".html") if args.report else None
    with Progress() as progress:
        result = suite.run(Options(args.quick, progress, _btf(args), only or None, report))
    if out:
        with Path(out).open("a") as stream:
            stream.write(json.dumps(result) + "\n")
    if plot:
        if hasattr(suite, "plot"):
            suite.plot(result, plot)
        else:
            from btfref.report.growth_plot import plot_growth

            plot_growth(result["growth"], plot)
    if args.json:
        emit_json(result)
        return 0
    header, rows = suite.table(result)
    for line in table(rows, header=header):
        emit(line)
    return 0


def _btf(args: Namespace) -> SampledBTF | None:
    if not args.btf:
        return None
    from btfref.sampling import SampledBTF

    return SampledBTF.load(args.btf, variance=False)
