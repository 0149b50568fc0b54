"""Path trace a modelled mesostructure into a sampled BTF.

An interrupted run continues where it stopped when it is started again with the same arguments.
"""

from __future__ import annotations

from btfref.commands._shared import (
    Progress,
    assignments,
    bytes_text,
    count,
    direction_set,
    emit,
    emit_json,
    numbers_or_file,
    output_file,
    ranges,
)
from btfref.errors import InputError

#: Options that are parameters of a user's mesh or height map.
_OWN = ("bsdf", "albedo", "roughness", "amplitude", "tile", "up", "allow_seams")


def add_arguments(parser):
    """Describe the command's arguments."""
    parser.add_argument(
        "mesostructure",
        metavar="MESO",
        help="name of a mesostructure (checker, rings, tissue, flat), a mesh (PLY, OBJ, GLB, STL, OFF) or a "
        "height map (PNG of 8 or 16 bits, OpenEXR)",
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT.btf.zarr", help="the store to write")
    parser.add_argument(
        "--texels", type=count(1), default=64, metavar="N", help="texels per side (default 64)"
    )
    directions = (
        "ubo81, ubo151, a grid such as 10x5, or a .txt file of theta and phi in degrees (default ubo81)"
    )
    parser.add_argument("--views", default="ubo81", metavar="SET", help=directions)
    parser.add_argument("--lights", default="ubo81", metavar="SET", help="likewise")
    parser.add_argument(
        "--spp", type=count(2), default=64, metavar="N", help="paths per texel and view (default 64)"
    )
    parser.add_argument("--max-depth", type=count(2), default=8, metavar="N", help="as Mitsuba's (default 8)")
    parser.add_argument("--seed", type=count(0), default=0, metavar="N")
    parser.add_argument(
        "--dtype", choices=("float16", "float32"), default="float16", help="of the stored values"
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", metavar="KEY=VALUE", help="parameters of the mesostructure"
    )
    parser.add_argument(
        "--estimator",
        choices=("path", "surface"),
        default="path",
        help="path: the reference; surface: visibility traced once for all views and lights (default path)",
    )
    own = parser.add_argument_group("a mesh or a height map of your own")
    own.add_argument("--bsdf", metavar="FILE.xml", help="a Mitsuba BSDF, with its textures")
    own.add_argument(
        "--albedo", type=numbers_or_file, metavar="IMAGE|R,G,B", help="of a height map (default 0.5,0.5,0.5)"
    )
    own.add_argument(
        "--roughness", type=numbers_or_file, metavar="IMAGE|X", help="of a height map (default: Lambertian)"
    )
    own.add_argument(
        "--amplitude", type=float, metavar="A", help="tile units that a height of 1 stands for (default 0.1)"
    )
    own.add_argument(
        "--tile",
        type=numbers_or_file,
        metavar="X0,Y0,X1,Y1",
        help="where one tile lies in the mesh, in its units, or: bounds (default 0,0,1,1)",
    )
    own.add_argument(
        "--up", choices=("y", "z"), help="axis of the mesh that points up (default: glTF y, else z)"
    )
    own.add_argument("--allow-seams", action="store_true", default=None, help="take input that does not tile")
    for name in ("views", "lights", "tiles"):
        parser.add_argument(
            f"--only-{name}", type=ranges, metavar="I,J-K", help=f"fill these {name} now, the rest later"
        )
    parser.add_argument("--overwrite", action="store_true", help="replace a store of other settings")
    parser.add_argument("--json", action="store_true", help="print the facts of the store as JSON")


def run(args):
    """Carry the command out."""
    out = output_file(args.output, ".btf.zarr")
    parameters = assignments(args.set)
    for name in _OWN:
        if getattr(args, name) is not None:
            parameters[name] = getattr(args, name)
    settings = {
        "texels": args.texels,
        "views": direction_set(args.views),
        "lights": direction_set(args.lights),
        "spp": args.spp,
        "seed": args.seed,
        "max_depth": args.max_depth,
        "dtype": args.dtype,
        "estimator": args.estimator,
    }
    for key in parameters:
        if key in settings:
            option = f"--{key.replace('_', '-')}"
            raise InputError("not a parameter of the mesostructure", field="--set", got=key, expected=option)

    from btfref.sampling.part import Part
    from btfref.sampling.synthesis import synthesize_store

    only = Part(args.only_views, args.only_lights, args.only_tiles)

    with Progress() as progress:
        store = synthesize_store(
            out,
            args.mesostructure,
            overwrite=args.overwrite,
            progress=progress,
            only=only,
            **settings,
            **parameters,
        )
    info = store.info()
    if args.json:
        emit_json(info)
    else:
        there = "" if info["complete"] else f", {info['coverage']:.1%} of it there"
        emit(f"{out}: {' × '.join(map(str, info['shape']))}, {bytes_text(info['file_bytes'])}{there}")
    return 0
