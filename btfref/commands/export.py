"""Write a sampled BTF in a format of others, or a representation for other programs.

Of a sampled BTF: ubo: pictures named as UBO2003's, in a folder or .zip; utia: likewise as UTIA's; bonn: a .btf file,
factored (DFMF) or as it is (BDI). Losses and clipped values are reported. Of a representation: maps: a folder of
OpenEXR images; gl: a folder with its shader, textures and known answers, for renderers with OpenGL 3.3 or WebGL 2.

  btfref export checker.lpca.exr --format gl -o port
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_json, add_memory
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, number
from btfref.commands.shared.reading import assignments, count, number_above, output_file
from btfref.errors import InputError

#: Option -> what it is called in the library, where that differs.
_SETTINGS = (
    "image",
    "gamma",
    "quality",
    "scale",
    "moved",
    "family",
    "components",
    "error",
    "colour_model",
    "scalar",
    "texels",
)

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": ""}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "btf", metavar="BTF", help="sampled BTF (.btf.zarr), or representation (.exr) for maps and gl"
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="folder, .zip or .btf to write")
    parser.add_argument(
        "--format",
        required=True,
        metavar="NAME",
        help="whose files to write: ubo, utia, bonn, maps, gl, or a format that an installed package brings",
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", metavar="KEY=VALUE", help="settings of such a format"
    )
    images = parser.add_argument_group("ubo, utia")
    images.add_argument("--image", choices=("jpg", "png", "hdr", "exr"), help="default jpg (ubo), exr (utia)")
    images.add_argument("--quality", type=count(1), metavar="Q", help="of JPEG (default 95)")
    images.add_argument(
        "--gamma", type=number_above(0), metavar="G", help="of 8-bit pictures (ubo; default 2.2)"
    )
    images.add_argument("--scale", type=number_above(0), metavar="S", help="divide values by it (default 1)")
    images.add_argument(
        "--moved", type=count(0), metavar="DEGREES", help="move the light where it coincides with the camera"
    )
    bonn = parser.add_argument_group("bonn")
    bonn.add_argument("--family", choices=("DFMF", "BDI"), help="default DFMF")
    bonn.add_argument("--components", type=count(1), metavar="K", help="per channel (default 64)")
    bonn.add_argument("--error", type=number_above(0), metavar="E", help="relative RMS error that decides K")
    bonn.add_argument("--colour-model", type=int, choices=(0, 11), help="0: RGB (default), 11: as UBO2014")
    bonn.add_argument("--scalar", type=int, choices=(2, 4), help="bytes of a factor (default 2)")
    bonn.add_argument(
        "--texels",
        type=count(1),
        metavar="N",
        help="rows and columns of the file: the tile is repeated (default: the BTF's own)",
    )
    add_memory(parser)
    add_json(parser, "what was written")


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, *{"bonn": (".btf",)}.get(args.format, ()))
    settings = {key: getattr(args, key) for key in _SETTINGS if getattr(args, key) is not None}
    settings |= assignments(args.set)

    from btfref.sampling import memory

    with Progress() as progress:
        if args.format in ("maps", "gl"):
            if settings:
                raise InputError(f"{args.format} takes no settings", field=next(iter(settings)))
            if args.format == "maps":
                from btfref.formats.maps import export_maps

                facts = export_maps(args.btf, out)
            else:
                from btfref.stress.known_answers import export_port

                facts = export_port(args.btf, out, progress=progress)
        else:
            from btfref.formats import export_btf, exporters, format_named, names
            from btfref.sampling import open_store

            if args.format not in names() or format_named(args.format).export is None:
                known = ", ".join([*exporters(), "maps", "gl"])
                raise InputError("no such format to write", field="--format", got=args.format, expected=known)

            facts = export_btf(
                open_store(args.btf),
                out,
                args.format,
                memory=memory.beside_the_interpreter(args.memory),
                progress=progress,
                **settings,
            )
    if args.json:
        emit_json(facts | {"peak_memory_bytes": memory.peak()})
    else:
        emit(f"{out}: {', '.join(f'{key} {_text(fact)}' for key, fact in facts.items())}")
        emit(f"largest memory of the process: {bytes_text(memory.peak())}")
    return 0


def _text(fact: object) -> str:
    if isinstance(fact, list):
        return "/".join(map(_text, fact))
    return number(fact) if isinstance(fact, float) else str(fact)
