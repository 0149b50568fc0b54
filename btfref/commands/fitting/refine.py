"""Move the maps of a fit towards true values, by their gradient.

The maps follow Adam on random batches of rows: queries of the surface (btfref query), or the samples of a sampled BTF;
or they follow a picture of a scene. Some rows or pixels are held out; the maps that are best on these are kept, and
none that are worse than the start. The file keeps its maps' shapes and types, hence its bytes, and says what was done
to it.

  btfref query checker -o checker.queries.zarr --n 3e5 --spp 32 --max-theta 85 --footprint square --radius 0.0078125
  btfref refine checker.lpca.exr --to checker.queries.zarr -o checker.refined.exr
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_define, add_json, add_overwrite, add_seed, words
from btfref.commands.shared.printing import Progress, emit, number, write_representation
from btfref.commands.shared.reading import assignments, count, number_above, output_file
from btfref.errors import SAMPLES, InputError

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "representation"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("file", metavar="FILE", help="representation (.exr) to start from")
    parser.add_argument(
        "--to",
        required=True,
        metavar="QUERIES|BTF|PICTURE",
        help="true values: queries (.queries.zarr), a sampled BTF (.btf.zarr), or a picture (.exr) of --scene",
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILE.exr", help="the refined representation"
    )
    parser.add_argument(
        "--loss",
        choices=("delta_e", "log", "relative"),
        default="delta_e",
        help="squared colour difference, of logarithms, or over squared truth (default %(default)s)",
    )
    parser.add_argument(
        "--steps", type=count(1, SAMPLES), default=600, metavar="N", help="at most (default %(default)s)"
    )
    parser.add_argument(
        "--batch", type=count(1, SAMPLES), default=8192, metavar="N", help="rows a step (default %(default)s)"
    )
    parser.add_argument(
        "--rate",
        type=number_above(0),
        default=0.01,
        metavar="R",
        help="of the first step, relative to the size of a map's values (default %(default)s)",
    )
    parser.add_argument("--scene", metavar="SCENE", help="that the picture shows; its material is FILE")
    add_define(parser)
    parser.add_argument("--maps", metavar="MAP[,MAP]", help="these maps instead of all")
    add_seed(parser)
    add_overwrite(parser)
    add_json(parser, "what was done")


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, ".exr")
    parameters = assignments(args.define, convert=str, option="-D")
    if parameters and not args.scene:
        raise InputError("parameters of no scene", field="-D", expected="--scene too")

    from btfref.commands.shared.printing import emit_json
    from btfref.refining import refine

    with Progress() as progress:
        made = refine(
            args.file,
            args.to,
            loss=args.loss,
            steps=args.steps,
            batch=args.batch,
            rate=args.rate,
            seed=args.seed,
            maps=words(args.maps),
            scene=args.scene,
            parameters=parameters,
            progress=progress,
        )
    facts = made.meta["refined"][-1]
    if args.json:
        from btfref.representations import save

        save(made, out)
        emit_json(facts)
        return 0
    write_representation(made, out, json=False)
    change = f"{number(facts['before'])} -> {number(facts['after'])}"
    what = f"{facts['held_out']} held-out {'pixels' if args.scene else 'rows'}"
    emit(f"{facts['loss']} of {what}: {change}, {facts['steps_taken']} steps")
    if facts["share"] == 0:
        emit("nothing was better than the start: the maps are as they were")
    return 0
