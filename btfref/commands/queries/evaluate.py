"""Write a method's answers to the rows of a file of queries, and say how far off they are.

The noise of the true values is taken out of the errors; each stands with its 99 % interval. Footprints are averaged
over random places, the same for every method (--filter lookups), looked up at the level of detail of their width
(level, of methods that have levels), or ignored (point).

  btfref query checker -o checker.queries.zarr --n 1e5 --spp 256 --max-theta 85
  btfref evaluate checker.lpca.exr checker.queries.zarr -o lpca.npy
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_json, add_overwrite
from btfref.commands.shared.printing import Progress, emit, emit_json, table
from btfref.commands.shared.reading import count, output_file
from btfref.errors import SAMPLES

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "file"}

#: Errors and how they are printed.
_LINES = (
    ("rmse", "RMSE, 1/sr", "{:.4g}"),
    ("nrmse", "RMSE over the true values' RMS", "{:.4g}"),
    ("mae", "mean absolute error, 1/sr", "{:.4g}"),
    ("psnr_log", "PSNR of log(1 + B), dB", "{:.2f}"),
    ("bias", "bias over the true mean", "{:+.3g}"),
)


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("file", metavar="FILE", help="representation (.exr) or sampled BTF (.btf.zarr)")
    parser.add_argument("queries", metavar="QUERIES", help="rows (.queries.zarr), from btfref query")
    parser.add_argument(
        "-o", "--output", required=True, metavar="VALUES.npy", help="the answers, rows × 3 float32"
    )
    parser.add_argument(
        "--filter",
        choices=("lookups", "level", "point"),
        default="lookups",
        help="how a footprint is looked up (default %(default)s)",
    )
    parser.add_argument(
        "--lookups",
        type=count(1, SAMPLES),
        default=16,
        metavar="N",
        help="places of a footprint (default 16)",
    )
    add_overwrite(parser)
    add_json(parser, "the errors")


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, ".npy")

    from btfref.querying.evaluate import evaluate

    with Progress() as progress:
        facts = evaluate(
            args.file, args.queries, out, count=args.lookups, filter=args.filter, progress=progress
        )
    if args.json:
        emit_json(facts)
        return 0
    emit(f"{out}: {facts['rows']} rows by {facts['method']}")
    errors = facts["errors"]
    if errors is None:
        emit("no errors: the rows have a single sample, whose noise nothing tells")
        return 0
    lines = [(label, *(form.format(x) for x in errors[key])) for key, label, form in _LINES]
    for line in table(lines, header=("error", "estimate", "99 % from", "to")):
        emit(line)
    return 0
