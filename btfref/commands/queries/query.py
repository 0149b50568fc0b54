"""Ask for B at random places, footprints and pairs of directions, with its noise: data to train and to judge with.

The source is a modelled surface, a mesh, a height map or a folder of maps, as synth takes them, whose rows are path
traced; or a sampled BTF or a representation. An interrupted run continues where it stopped when it is started again
with the same arguments. The output's name says what is written: .queries.zarr, .h5, .npz or .parquet; metadata
(Croissant) lies beside it.

  btfref query checker -o checker.queries.zarr --n 1e6 --radius levels:0.004:4,2,1
  btfref query cloth.glb -o cloth.h5 --n 262144 --light cosine --spp 64 --texels 512
  btfref query rings -o rings.h5 --picture 64 --n 409600 --layout product --footprint square --radius 0.0078125
  btfref query checker.lpca.exr -o lpca.queries.zarr --n 1e5 --light halfdiff --view halfdiff

Laws of directions: uniform (solid angle), cosine, grazing (half beyond 75.5 degrees), halfdiff (of both: half and
difference angles), a set such as ubo81 or 10x5, or a .txt file of theta and phi in degrees. Laws of radii, in tiles:
0, R, levels:R:S0,S1,... (R 2^k with these shares), log:R0:R1 (log-uniform).
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace

from btfref.commands.shared.options import add_json, add_seed, add_tracing
from btfref.commands.shared.own_geometry import add_own_geometry, own_parameters
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, printable
from btfref.commands.shared.reading import count, direction_set, number_above, output_file, size
from btfref.errors import SAMPLES as MANY_SAMPLES
from btfref.errors import InputError
from btfref.querying.settings import FOOTPRINTS, LIGHTS, MOST_SPP, ROWS, SPP, QuerySettings

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": ""}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    default = QuerySettings  # its fields' defaults, as attributes of the class
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="what synth takes (checker, rings, knit, …, a mesh, a height map, a folder of maps), a sampled BTF "
        "(.btf.zarr) or a representation (.exr)",
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help=".queries.zarr, .h5, .npz or .parquet to write"
    )
    parser.add_argument(
        "--n", type=whole, default=default.n, metavar="N", help="rows, e.g. 1e7 (default %(default)s)"
    )
    for name in ("light", "view"):
        parser.add_argument(
            f"--{name}",
            default=getattr(default, name),
            metavar="LAW",
            help=f"of {name} directions (default %(default)s)",
        )
    parser.add_argument(
        "--max-theta",
        type=number_above(0),
        default=default.max_theta,
        metavar="DEGREES",
        help="largest polar angle of a law's directions (default %(default)s)",
    )
    parser.add_argument(
        "--radius",
        default=default.radius,
        metavar="LAW",
        help="of the footprints' radii, tiles (default %(default)s)",
    )
    parser.add_argument(
        "--footprint",
        choices=tuple(FOOTPRINTS),
        default=default.footprint,
        help="a radius R is a Gaussian's standard deviation, a disk's radius or half a square's side (default "
        "%(default)s)",
    )
    parser.add_argument(
        "--picture",
        type=sides,
        metavar="N|WxH",
        help="rows go through the texels of pictures, each with a pair of directions",
    )
    parser.add_argument(
        "--lights-per-path",
        type=count(1, LIGHTS),
        default=default.lights_per_path,
        metavar="N",
        help="rows in turn that share place, footprint, view and paths: cheaper, their errors correlated (default "
        "%(default)s)",
    )
    parser.add_argument(
        "--spp",
        type=count(1, MANY_SAMPLES),
        metavar="N",
        help=f"independent samples a row (default {SPP}); with --target-error the most (default {MOST_SPP})",
    )
    parser.add_argument(
        "--target-error",
        type=number_above(0),
        metavar="E",
        help="relative standard error of every row, e.g. 0.05",
    )
    parser.add_argument(
        "--max-depth",
        type=count(2),
        default=default.max_depth,
        metavar="N",
        help="as Mitsuba's (default %(default)s)",
    )
    add_seed(parser)
    add_own_geometry(parser)
    hdf5 = parser.add_argument_group("HDF5")
    hdf5.add_argument(
        "--layout",
        choices=("records", "product"),
        help="random records, or pictures and their directions (default: product with --picture)",
    )
    hdf5.add_argument(
        "--dtype", choices=("float32", "float16"), default="float32", help="default %(default)s"
    )
    hdf5.add_argument(
        "--texels",
        type=count(1),
        default=512,
        metavar="N",
        help="of the texture to train: base_radius (default 512)",
    )
    add_tracing(parser, default.variant)
    parser.add_argument("--overwrite", action="store_true", help="replace queries of other settings")
    add_json(parser, "what was written")


def whole(text: str) -> int:
    """A whole number, also as 1e7, for argparse's ``type=``."""
    try:
        found = float(text)
    except ValueError:
        found = float("nan")
    if not found >= 1 or found > ROWS.most or found != int(found):
        raise ArgumentTypeError(f"got {text[:40]!r}, expected a whole number of rows, {ROWS}")
    return int(found)


def sides(text: str) -> tuple[int, int]:
    """``N`` or ``WxH`` as (rows, columns), for argparse's ``type=``."""
    width, height = size(text if "x" in text.lower() else f"{text}x{text}")
    return height, width


def run(args: Namespace) -> int:
    """Carry the command out."""
    from btfref.querying.files import export

    out = output_file(args.output, *export.ENDINGS)
    export.check(out, args.n, args.layout, args.dtype, args.picture)
    chosen = vars(args) | {"light": direction_set(args.light), "view": direction_set(args.view)}
    settings = QuerySettings(**{name: chosen[name] for name in QuerySettings.names()})
    parameters = own_parameters(args, QuerySettings.names())

    from btfref.mesostructure import Mesostructure
    from btfref.querying.files.zarr_file import ENDING
    from btfref.querying.job import QueryJob, fill_file
    from btfref.sampling.memory import peak

    job = QueryJob.of(args.source, settings, parameters)
    if isinstance(job.source, Mesostructure):
        for line in job.source.ignored:
            sys.stderr.write(f"btfref: warning: ignored: {printable(line)}\n")
    if out.exists() and not args.overwrite and not out.name.endswith(ENDING):
        raise InputError("exists already", file=out, expected="another name, or --overwrite")
    with Progress() as progress:
        file = fill_file(
            job,
            export.rows_of(out),
            overwrite=args.overwrite,
            progress=progress,
            scheduler=args.scheduler,
            workers=args.workers,
        )
    written = export.export(file, out, layout=args.layout, dtype=args.dtype, texels=args.texels)
    facts = written | {"rows": settings.n, "peak_memory_bytes": peak()} | job.attributes
    if args.json:
        emit_json(facts)
        return 0
    emit(f"{out}: {settings.n} rows, {bytes_text(written['file_bytes'])}; metadata: {written['metadata']}")
    emit(f"largest memory of the process: {bytes_text(facts['peak_memory_bytes'])}")
    return 0
