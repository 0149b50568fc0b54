"""The page, put together: one file without references to others."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path

from btfref.errors import InputError
from btfref.outputs import new_file
from btfref.report.cell import script_json
from btfref.types import PathLike
from btfref.view.material import Material, material_data, shared_shaders
from btfref.view.packing import Packed
from btfref.view.shapes import Shape, shapes_data

#: In the order in which they build on each other.
SCRIPTS = (
    *("vectors", "unpack", "device", "camera", "lights", "renderer", "display", "painter"),
    *("texel", "pointer", "panel", "main"),
)


def build_page(materials: Sequence[Material], shapes: Sequence[Shape], *, title: str = "btfref view") -> str:
    """The page's HTML.

    Parameters
    ----------
    materials : sequence of Material
        At least one.
    shapes : sequence of Shape
        At least one; the first is shown first.
    title : str

    Returns
    -------
    str

    Raises
    ------
    InputError
        For nothing to show, or tables that WebGL 2 or a page cannot hold.
    """
    if not materials or not shapes:
        raise InputError("nothing to show", field="materials" if not materials else "shapes", got=0)
    packed = Packed()
    data = {
        "materials": [material_data(material, packed) for material in materials],
        "shapes": shapes_data(shapes, packed),
        "shaders": shared_shaders(),
    }
    scripts = "\n".join(_file(f"{name}.js") for name in SCRIPTS)
    slots = {
        "title": escape(title),
        "css": _file("view.css"),
        "js": f'"use strict";\n(() => {{\n{scripts}}})();',
        "data": script_json(data),
        "tables": "\n".join(
            f'<script type="text/plain" id="{name}">{text}</script>' for name, text in packed.blobs.items()
        ),
    }
    head, *rest = _file("view.html").split("{{")
    parts = [head]
    for part in rest:
        name, _, text = part.partition("}}")
        parts += [slots[name], text]
    return "".join(parts)


def write_page(
    path: PathLike, materials: Sequence[Material], shapes: Sequence[Shape], *, title: str = "btfref view"
) -> Path:
    """Write the page; it appears complete or not at all.

    Parameters
    ----------
    path : path-like
        ``….html``.
    materials, shapes, title
        As for :func:`build_page`.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        As :func:`build_page`, and for another ending or a missing folder.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError("a page is an HTML file", file=path, got=repr(path.suffix), expected=".html")
    html = build_page(materials, shapes, title=title)
    with new_file(path) as draft:
        draft.write_text(html, "utf-8")
    return path


def _file(name: str) -> str:
    return resources.files("btfref.view").joinpath("assets", name).read_text("utf-8")
