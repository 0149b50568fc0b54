"""Synthesize a sampled BTF from a mesostructure, a mesh or a height map.

An interrupted run continues where it stopped when it is started again with the same arguments. --views and
--lights choose the directions that the BTF has; --only-views, --only-lights and --only-tiles fill a part of
it now, and the same command with another part, or without, fills more later (btfref info says what is there).

  btfref synth checker -o checker.btf.zarr --views ubo81 --lights ubo81 --spp 16
  btfref synth checker -o checker.btf.zarr --estimator path --spp 16
  btfref synth stone.png -o stone.btf.zarr --albedo stone-colour.png --roughness 0.6 --amplitude 0.1
  btfref synth Bricks076_2K/ -o bricks.btf.zarr --amplitude 0.05
  btfref synth cloth.glb -o cloth.btf.zarr --target-error 0.02 --memory 4G
  btfref synth checker -o checker.btf.zarr --for plane --size 512x512
  btfref synth weave.ply --bsdf yarn.xml -o weave.btf.zarr --scheduler dask --workers 4
"""

from __future__ import annotations

import functools
import operator
import sys
from argparse import ArgumentParser, Namespace
from typing import Any

from btfref.commands.demand import add_scene_arguments, union, whole_shape
from btfref.commands.shared.options import add_dtype, add_json, add_memory, add_seed, add_tracing
from btfref.commands.shared.own_geometry import add_own_geometry, own_parameters
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, printable
from btfref.commands.shared.reading import (
    count,
    direction_set,
    number_above,
    output_file,
    ranges,
)
from btfref.errors import INDICES, InputError
from btfref.errors import SAMPLES as MANY_SAMPLES
from btfref.sampling.settings import AUTO, ESTIMATORS, MOST_SAMPLES, SAMPLES, SynthesisSettings
from btfref.types import Facts

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "store"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "mesostructure",
        metavar="MESO",
        help="name of a mesostructure (checker, rings, knit, pebbles, …), a mesh (PLY, OBJ, GLB, STL, OFF), a height "
        "map (PNG or TIFF of 8 or 16 bits, OpenEXR), or a folder of maps (*_Color, *_Displacement, *_NormalGL, …)",
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT.btf.zarr", help="the store to write")
    default = SynthesisSettings  # its fields' defaults, as attributes of the class
    parser.add_argument(
        "--texels",
        type=count(1),
        default=default.texels,
        metavar="N",
        help="texels per side (default %(default)s)",
    )
    directions = (
        "ubo81, ubo151, a grid such as 10x5, a .txt file of theta and phi in degrees, or adaptive:N, chosen for the "
        "surface (default %(default)s)"
    )
    parser.add_argument("--views", default=default.views, metavar="SET", help=directions)
    parser.add_argument("--lights", default=default.lights, metavar="SET", help="likewise")
    parser.add_argument(
        "--spp",
        type=count(2, MANY_SAMPLES),
        default=default.spp,
        metavar="N",
        help=f"paths (or surface points) per texel and view (default {SAMPLES}); with --target-error the most "
        f"that a texel gets (default {MOST_SAMPLES})",
    )
    parser.add_argument(
        "--target-error",
        type=number_above(0),
        metavar="E",
        help="place samples where they are needed for this relative standard error of the whole BTF, e.g. 0.02",
    )
    parser.add_argument(
        "--texel-error",
        type=number_above(0),
        metavar="E",
        help="and for this one at most of every texel of a view (default: no limit)",
    )
    parser.add_argument(
        "--max-depth",
        type=count(2),
        default=default.max_depth,
        metavar="N",
        help="as Mitsuba's (default %(default)s)",
    )
    add_seed(parser)
    add_dtype(parser)
    add_own_geometry(parser)
    parser.add_argument(
        "--estimator",
        choices=(AUTO, *ESTIMATORS),
        default=default.estimator,
        help="path: the reference; surface: visibility traced once for all views and lights; auto: surface where it "
        "applies, path where a material transmits, mirrors or masks (default %(default)s)",
    )
    parser.add_argument(
        "--no-variance",
        action="store_true",
        help="leave the variance out: a third of the bytes, faster with surface",
    )
    for name in ("views", "lights", "tiles"):
        parser.add_argument(
            f"--only-{name}", type=ranges, metavar="I,J-K", help=f"fill these {name} now, the rest later"
        )
    needs = parser.add_argument_group("fill only what scenes need (see btfref demand), the rest later")
    needs.add_argument(
        "--for",
        dest="scenes",
        action="append",
        metavar="SCENE",
        help="scene file or shipped scene; several need what any of them needs",
    )
    add_scene_arguments(needs)
    add_memory(
        parser,
        "budget, e.g. 2G, of all processes together, or of each worker at an address (default: half of "
        "the machine's); without influence on the result",
    )
    add_tracing(parser, default.variant)
    parser.add_argument("--overwrite", action="store_true", help="replace a store of other settings")
    add_json(parser, "the facts of the store")


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, ".btf.zarr")
    parameters = own_parameters(args, SynthesisSettings.names())

    from btfref.sampling.store.selection import Selection
    from btfref.sampling.synthesis import make_job

    chosen = vars(args) | {
        **_directions(args, parameters),
        "variance": not args.no_variance,
    }
    settings = SynthesisSettings(**{name: chosen[name] for name in SynthesisSettings.names()})
    only = Selection(args.only_views, args.only_lights, args.only_tiles)
    if args.scenes:
        if only != Selection():
            raise InputError("scenes say what is filled", field="--only-…", got="beside --for")
        found = union(args, args.scenes, whole_shape(args.views, args.lights, args.texels)).values()
        only = functools.reduce(operator.or_, found).part()
    elif args.define or args.sweep or args.indirect:
        raise InputError("these are parameters of scenes", field="-D, --sweep, --indirect", expected="--for")

    job = make_job(args.mesostructure, settings, parameters)
    for line in job.mesostructure.ignored:
        sys.stderr.write(f"btfref: warning: ignored: {printable(line)}\n")
    peak: list[int] = []
    with Progress() as progress:
        store = job.to_store(
            out,
            overwrite=args.overwrite,
            progress=progress,
            only=only,
            memory=args.memory,
            scheduler=args.scheduler,
            workers=args.workers,
            report=peak.append,
        )
    info = store.info() | {"peak_memory_bytes": peak[0]}
    if args.json:
        emit_json(info)
        return 0
    emit(f"estimator: {job.attributes.get('fallback', job.settings.estimator)}")
    there = "" if info["complete"] else f", {info['coverage']:.1%} of it there"
    emit(f"{out}: {' × '.join(map(str, info['shape']))}, {bytes_text(info['file_bytes'])}{there}")
    emit(f"largest memory of a process: {bytes_text(peak[0])}")
    if info["error"]:
        emit(error_text(info["error"]))
    return 0


def _directions(args: Namespace, parameters: Facts) -> Facts:
    """Views and lights: sets, files, or as many as are asked for, chosen for the surface."""
    from btfref.sampling.chosen_directions import ADAPTIVE, chosen_directions

    made: dict[str, Any] = {}
    for text in (args.views, args.lights):
        kind, _, number = text.partition(":")
        if kind != ADAPTIVE:
            made[text] = direction_set(text)
        elif args.scenes:
            raise InputError(
                "a set that is chosen for the surface", field="--for", got=text, expected="another"
            )
        elif not number.isdecimal() or len(number) > len(str(INDICES.most)):
            raise InputError("unknown set of directions", got=text[:40], expected=f"{ADAPTIVE}:N")
        elif text not in made:
            made[text] = chosen_directions(
                args.mesostructure,
                int(number),
                seed=args.seed,
                max_depth=args.max_depth,
                variant=args.variant,
                **parameters,
            )
    return {"views": made[args.views], "lights": made[args.lights]}


def error_text(error: Facts) -> str:
    """One line on what a synthesis to a target error has reached."""
    samples = error["samples"]
    text = f"relative standard error {error['reached']:.2%} (target {error['target']:.2%})"
    if error["texel_target"] is not None:
        text += f", {error['texels_above']:.2%} of texels above {error['texel_target']:.2%}"
    return text + f"; {samples['mean']:.1f} samples a texel ({samples['least']} to {samples['most']})"
