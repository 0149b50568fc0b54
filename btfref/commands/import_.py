"""Convert a measured BTF of another format to a sampled BTF.

Reads UBO2003 and ATRIUM (folder or zip), UTIA (folder, zip or MIF), Bonn SPECTRAL folders, Bonn .btf (DFMF, FMF, PVF,
BDI) and MERL .binary; maps: a folder of edited maps (of export); photograph: one picture becomes a g-BRDF (both write
.exr). An interrupted conversion continues when it is started again with the same arguments.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from btfref.commands.shared.options import add_dtype, add_json, add_memory
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, write_representation
from btfref.commands.shared.reading import direction_set, number_above, output_file

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": ""}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("path", metavar="PATH", help="file, folder or archive")
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the store (.btf.zarr) or representation (.exr)"
    )
    parser.add_argument(
        "--format",
        metavar="NAME",
        help="bonn, mif, merl, spectral, utia or ubo (found from the file), maps, photograph",
    )
    parser.add_argument(
        "--allow-missing", action="store_true", help="accept pairs of directions without image"
    )
    parser.add_argument(
        "--cosine", choices=("included", "excluded"), help="whether the values hold the light's cosine"
    )
    parser.add_argument("--scale", type=number_above(0), metavar="S", help="factor from the values to 1/sr")
    parser.add_argument(
        "--gamma", type=number_above(0), metavar="G", help="of 8-bit pictures (ubo; default 2.2)"
    )
    parser.add_argument(
        "--rows", choices=("up", "down"), default="up", help="up: the top of a picture is v = 1 (default)"
    )
    parser.add_argument(
        "--views", metavar="SET", help="directions of a MERL BRDF, as of synth (default ubo81)"
    )
    parser.add_argument("--lights", metavar="SET", help="likewise")
    add_dtype(parser)
    parser.add_argument(
        "--pattern",
        metavar="NAME",
        help='names of pictures, e.g. "cam_{tv}_{pv}_light_{tl}_{pl}.jpg": polar angle and azimuth of the view '
        "(tv, pv) and of the light (tl, pl) in degrees, * for any letters; read as ubo unless --format is given",
    )
    add_memory(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace a store of other settings")
    add_json(parser, "the facts of the store")


def run(args: Namespace) -> int:
    """Carry the command out."""
    if args.format in ("maps", "photograph"):
        return _representation(args, output_file(args.output, ".exr"))
    out = output_file(args.output, ".btf.zarr")

    from btfref.formats.convert import import_btf
    from btfref.sampling import memory

    with Progress() as progress:
        store = import_btf(
            args.path,
            out,
            format=args.format,
            overwrite=args.overwrite,
            dtype=args.dtype,
            cosine=args.cosine,
            scale=args.scale,
            rows=args.rows,
            memory=memory.beside_the_interpreter(args.memory),
            progress=progress,
            allow_missing=args.allow_missing or None,
            gamma=args.gamma,
            pattern=args.pattern,
            views=args.views and direction_set(args.views),
            lights=args.lights and direction_set(args.lights),
        )
    info = store.info() | {"peak_memory_bytes": memory.peak()}
    if args.json:
        emit_json(info)
        return 0
    parent = info["parent"]
    emit(
        f"{out}: {' × '.join(map(str, info['shape']))} from {parent['format']}, {bytes_text(info['file_bytes'])}"
    )
    emit(f"largest memory of the process: {bytes_text(info['peak_memory_bytes'])}")
    if parent["images_missing"]:
        emit(f"  {parent['images_missing']} images are missing: {info['coverage']:.2%} of it there")
    if parent["lights_moved"]:
        emit(f"  {len(parent['lights_moved'])} lights were moved out of the camera's way")
    return 0


def _representation(args: Namespace, out: Path) -> int:
    """A representation from pictures."""
    if args.format == "maps":
        from btfref.formats.maps import import_maps

        representation = import_maps(args.path)
    else:
        from btfref.representations.gbrdf.build import from_photograph

        representation = from_photograph(args.path)
    write_representation(representation, out, json=args.json)
    return 0
