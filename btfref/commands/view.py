"""Look at representations and sampled BTFs in a browser: one page that draws with WebGL 2.

Turn the camera, drag two lights, change the shape, compare files, click a texel for its apparent BRDF. With -o the page
is written as one file that opens from disk; without, it is served to this machine until Ctrl-C.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.commands.shared.options import add_memory, add_overwrite
from btfref.commands.shared.printing import Progress, bytes_text, emit
from btfref.commands.shared.reading import count, output_file
from btfref.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.types import Facts
    from btfref.types import Progress as Report
    from btfref.view import Material

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "page"}

#: Most files of a page: each is a program and its tables.
MOST_FILES = 8


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="representation (.exr) or sampled BTF (.btf.zarr); several are compared",
    )
    parser.add_argument("-o", "--output", metavar="PAGE.html", help="write the page instead of serving it")
    parser.add_argument(
        "--mesh",
        action="append",
        default=[],
        metavar="MESH",
        help="a shape of yours, with texture coordinates: OBJ, PLY, GLB, glTF; beside plane, sphere and cloth",
    )
    parser.add_argument(
        "--port", type=count(0), default=0, metavar="N", help="of the server (default: one that is free)"
    )
    parser.add_argument("--no-browser", action="store_true", help="serve the page, and let me open it")
    add_memory(parser, "budget of a quick fit of a sampled BTF (default: half of the machine's)")
    add_overwrite(parser)


def run(args: Namespace) -> int:
    """Carry the command out."""
    out = output_file(args.output, ".html") if args.output is not None else None
    if len(args.files) > MOST_FILES:
        raise InputError("too many files for a page", got=len(args.files), expected=f"at most {MOST_FILES}")
    if args.port > 65535:
        raise InputError("no such port", field="--port", got=args.port, expected="0 to 65535")

    from btfref.view import build_page, mesh_shape, shipped_shapes, write_page

    # The user's own shapes come first: they are what is looked at.
    shapes = [*(mesh_shape(path) for path in args.mesh), *shipped_shapes()]
    with Progress() as progress:
        materials = list(_materials(args.files, args.memory, progress))
        progress(0, 1, "putting the page together")
        title = ", ".join(material.name for material in materials)
        if out is not None:
            write_page(out, materials, shapes, title=title)
        else:
            html = build_page(materials, shapes, title=title)
        progress(1, 1, "putting the page together")
    for material in materials:
        if material.note:
            emit(f"{material.name}: {material.note}")
    if out is not None:
        emit(f"{out}: {bytes_text(out.stat().st_size)}")
        return 0
    return _serve(html, args.port, browser=not args.no_browser)


def _materials(files: list[str], memory: int | None, progress: Report) -> Iterator[Material]:
    from btfref import representations
    from btfref.commands import info
    from btfref.view import Material
    from btfref.view.sampled import quick_representation

    names = _names(files)
    for done, (file, name) in enumerate(zip(files, names, strict=True)):
        progress(done, len(files), "reading")
        facts = info.read(file)
        if facts["kind"] == "sampled-btf":
            representation, note = quick_representation(file, memory=memory, progress=progress)
        elif facts["kind"] == "representation":
            representation, note = representations.load(file), ""
        else:
            raise InputError(
                "nothing that the page shows",
                file=file,
                got=_kind(facts),
                expected="a representation or a sampled BTF",
            )
        yield Material(name, representation, list(info.lines(facts)), note)


def _kind(facts: Facts) -> str:
    """What a file is, and what makes a BTF of it."""
    if facts["kind"] == "measured-btf":
        return "a measured BTF: btfref import makes a sampled one of it"
    return f"{facts.get('what', 'an image')}"


def _names(files: list[str]) -> list[str]:
    """What files are called: as short as they can be told apart."""
    paths = [Path(file).resolve() for file in files]
    for length in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-length:]) for path in paths]
        if len(set(names)) == len(set(paths)):
            break
    # One file twice, for comparisons with itself.
    return [
        f"{name} ({names[:i].count(name) + 1})" if name in names[:i] else name for i, name in enumerate(names)
    ]


def _serve(html: str, port: int, *, browser: bool) -> int:
    """Serve the page until Ctrl-C."""
    import webbrowser

    from btfref.view.server import PageServer

    try:
        server = PageServer(html, port)
    except OSError as error:
        raise InputError("cannot serve there", field="--port", got=f"{port} ({error.strerror})") from None
    with server:
        emit(f"{server.url} (Ctrl-C ends)", flush=True)
        if browser and not webbrowser.open(server.url):
            emit("no browser was found here: open the address yourself")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return 0
    return 0
