"""Measure run time, and error beside it, of one suite of benchmarks.

Times are medians of interleaved rounds after a warm-up; ratios are medians of paired rounds.
"""

from __future__ import annotations

from pathlib import Path

from btfref.bench import SUITES
from btfref.commands._shared import Progress, emit, emit_json, output_file, table
from btfref.errors import InputError


def add_arguments(parser):
    """Describe the command's arguments."""
    parser.add_argument("suite", choices=sorted(SUITES), help="what to measure")
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    parser.add_argument("--btf", metavar="BTF", help="a sampled BTF (.btf.zarr) instead of the suite's own")
    parser.add_argument("--only", metavar="METHOD[,METHOD]", help="these methods instead of all")
    parser.add_argument("-o", "--output", metavar="FILE.jsonl", help="append the raw result as one JSON line")
    parser.add_argument("--plot", metavar="FILE.png", help="draw how the cost grows (suite synth)")
    parser.add_argument(
        "--report", metavar="FILE.html", help="a page with the pictures, of suites that have any"
    )
    parser.add_argument("--json", action="store_true", help="print the raw result as JSON")


def run(args):
    """Carry the command out."""
    import importlib
    import inspect
    import json

    out = output_file(args.output, ".jsonl") if args.output else None
    plot = output_file(args.plot, ".png") if args.plot else None
    if plot and args.suite != "synth":
        raise InputError("only the suite synth is drawn", field="--plot", got=args.suite, expected="synth")
    suite = importlib.import_module(SUITES[args.suite])
    options = {"only": args.only.split(",")} if args.only else {}
    if args.report:
        options["report"] = output_file(args.report, ".html")
        if "report" not in inspect.signature(suite.run).parameters:
            raise InputError("this suite has no pictures", field="--report", got=args.suite)
    if args.btf:
        from btfref.sampling import SampledBTF

        options["btf"] = SampledBTF.load(args.btf, variance=False)
    with Progress() as progress:
        result = suite.run(quick=args.quick, progress=progress, **options)
    if out:
        with Path(out).open("a") as stream:
            stream.write(json.dumps(result) + "\n")
    if plot:
        from btfref.report.growth_plot import plot_growth

        plot_growth(result["growth"], plot)
    if args.json:
        emit_json(result)
        return 0
    header, rows = suite.table(result)
    for line in table(rows, header=header):
        emit(line)
    return 0
