"""Compress a sampled BTF with one of the methods.

`--preset paper` starts from the settings of the method's paper; --set overrides single parameters. The file and the
output say how wrong the fit is between its samples, at random directions; beyond stated limits there is a warning.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_json, add_memory, add_overwrite, add_scheduler, add_seed
from btfref.commands.shared.printing import Progress, bytes_text, emit, number, write_representation
from btfref.commands.shared.reading import assignments, output_file
from btfref.errors import InputError

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "representation"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("method", metavar="METHOD", help="key of the method, e.g. lpca")
    parser.add_argument("btf", metavar="BTF", help="a sampled BTF (.btf.zarr)")
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILE.exr", help="the representation to write"
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", metavar="KEY=VALUE", help="parameters of the method"
    )
    parser.add_argument("--preset", metavar="NAME", help="named settings, e.g. paper")
    parser.add_argument(
        "--target-error",
        type=float,
        metavar="E",
        help="short for --set target_error=E: relative RMS error, for methods that can aim at one",
    )
    parser.add_argument(
        "--partial",
        action="store_true",
        help="take a store of which only a part is there, as synth --for fills it (methods that can)",
    )
    add_memory(
        parser,
        "budget, e.g. 2G, of all processes together, or of each at an address (default: half of the machine's): a fit "
        "that would take more is refused",
    )
    add_scheduler(parser)
    add_seed(parser)
    add_overwrite(parser)
    add_json(parser, "the facts of the file")


def help_text(parser: ArgumentParser, args: Namespace) -> str:
    """Help of the command with all methods, or of the method that stands before ``--help``."""
    from btfref.commands.shared import method_help
    from btfref.registry import method

    if args.method:
        return method_help.method_help(method(args.method))
    return "\n".join([parser.format_help(), *method_help.methods_help()])


def run(args: Namespace) -> int:
    """Carry the command out."""
    from btfref.registry import method

    row = method(args.method)
    out = output_file(args.output, ".exr")
    given = assignments(args.set)
    if args.target_error is not None:
        given["target_error"] = args.target_error
    parameters = row.settings(args.preset, given)

    from btfref.representations import between
    from btfref.representations.fit_memory import fitted_by
    from btfref.representations.protocol import FitsPartially
    from btfref.sampling import memory, open_store
    from btfref.sampling.passes import DistributedBTF

    of_workers = ""
    if args.partial:
        if args.scheduler is not None:
            raise InputError("a part is fitted by this process", field="--scheduler", got="beside --partial")
        fitting = row.fitting
        if not isinstance(fitting, FitsPartially):
            raise InputError("the method needs the whole BTF", field="--partial", got=row.key)
        representation = fitting.fit_partial(open_store(args.btf), **parameters)
    else:
        store = open_store(args.btf)
        with (
            fitted_by(row, store, args.memory, parameters, args.scheduler, args.workers) as btf,
            Progress() as progress,
        ):
            representation = between.fit(row, btf, seed=args.seed, progress=progress, **parameters)
            if isinstance(btf, DistributedBTF):
                of_workers = f", of a worker: {bytes_text(btf.largest)}"
    write_representation(representation, out, json=args.json)
    if not args.json:
        emit(f"largest memory of the process: {bytes_text(memory.peak())}{of_workers}")
    _say_between(row.key, representation.meta.get("fit", {}).get("between_samples"), json=args.json)
    return 0


def _say_between(method: str, facts: dict[str, float] | None, *, json: bool) -> None:
    """How wrong the fit is between its samples; on standard error, what is beyond the stated limits."""
    import sys

    from btfref.stress.between_samples import between_gates

    if facts is None:  # fitted to a part
        return
    if not json:
        emit("between the samples: " + ", ".join(f"{name} {number(facts[name])}" for name in facts))
    beyond = [gate for gate in between_gates(method, facts) if not gate.passed]
    if beyond:
        found = ", ".join(
            f"{g.entry.removeprefix('min_')} {number(g.value)}, wanted {g.sign} {g.limit:g}" for g in beyond
        )
        sys.stderr.write(f"btfref: warning: wrong between the samples: {found}\n")
