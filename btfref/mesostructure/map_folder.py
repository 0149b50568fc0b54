"""A folder of maps of one material, as libraries of assets ship them: colour, roughness, displacement and others."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.checks import number
from btfref.mesostructure.height_map import check_heights, surface
from btfref.mesostructure.materials import as_numbers, check_normals, linear_colours, read_image, texture
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.seams import map_seams, refuse

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: What a map is, by the word that its name ends with (without capitals, spaces and signs).
WORDS = {
    "colour": ("color", "colour", "basecolor", "albedo", "diffuse", "diff", "col"),
    "roughness": ("roughness", "rough"),
    "displacement": ("displacement", "disp", "height"),
    "normal": ("normalgl", "norgl"),
    "normal of the other hand": ("normaldx", "nordx"),
    "metalness": ("metalness", "metallic", "metal"),
    "ambient occlusion": ("ambientocclusion", "ao"),
    "opacity": ("opacity", "alpha"),
    "emission": ("emission", "emissive"),
}

_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".tga", ".bmp")

#: Sizes that names may end with: ``_2K``, ``-1k``.
_SIZE = re.compile(r"[_\-. ]\d{1,2}k$", re.IGNORECASE)


def map_folder(
    *,
    folder: PathLike,
    amplitude: float = 0.1,
    rows: str = "up",
    allow_seams: bool = False,
) -> Mesostructure:
    """The surface that the maps of a folder describe, repeated without end.

    Names say what a map is: ``*_Color``, ``*_Roughness``, ``*_Displacement``, ``*_NormalGL``, ``*_Metalness`` and
    other words of `WORDS`. Colours of 8 and 16 bits are sRGB, those of OpenEXR linear; all other maps hold plain
    numbers. The material is Mitsuba's ``principled``.

    A displacement is the heights of the surface. A normal map then says the same once more: it is ignored, or every
    slope would count twice. Without a displacement the tile is flat and the normal map turns its shading normals.

    Parameters
    ----------
    folder : str
    amplitude : float
        Height in tile units of one unit of the displacement. Maps do not say it.
    rows : {"up", "down"}
        "up": the top of a picture is v = 1, so that x, y and the normal are right-handed as one looks at the
        picture. "down": the top is v = 0, as of a height map alone.
    allow_seams : bool
        Take maps whose borders do not continue each other.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A folder without maps, two maps of one kind, one that cannot be read or has a seam, emission or opacity.
    """
    folder = Path(folder)
    amplitude = number("the folder of maps", "amplitude", amplitude, 0.0, 4.0)
    if rows not in ("up", "down"):
        raise InputError("rows of the maps", field="rows", got=repr(rows), expected="up or down")
    notes = Notes()
    found = _found(folder, notes)
    for kind in ("emission", "opacity"):
        if kind in found:
            raise InputError(
                f"map of {kind}: a folder's surface is opaque and reflects",
                file=found[kind],
                field=kind,
                expected="the folder without that map",
            )
    if "ambient occlusion" in found:
        notes.add("ambient occlusion: paths find it themselves", found["ambient occlusion"].name)
    if not {"colour", "displacement", "normal", "roughness"} & found.keys():
        raise InputError(
            "no maps in the folder",
            file=folder,
            field="folder",
            expected="images named *_Color, *_Roughness, *_Displacement, *_NormalGL, *_Metalness",
        )

    def image(kind: str, n_channels: int) -> np.ndarray:
        """Numbers of a map, row 0 at v = 0."""
        pixels = read_image(found[kind], field=kind)
        values = linear_colours(pixels) if kind == "colour" else as_numbers(pixels)
        values = values[::-1] if rows == "up" else values
        if values.shape[2] < n_channels:
            raise InputError("map without colours", file=found[kind], field=kind, got=values.shape)
        values = values[..., :n_channels]
        if kind != "displacement" and (values.min() < 0 or values.max() > 1):
            got = f"{values.min():.4g} … {values.max():.4g}"
            raise InputError("map out of range", file=found[kind], field=kind, got=got, expected="0 … 1")
        if kind != "displacement":
            refuse(map_seams(values, kind), file=found[kind], field=kind, allow=allow_seams)
        return values

    textures: dict[str, np.ndarray] = {}

    def lookup(name: str, kind: str, n_channels: int, default: Facts | float) -> Facts | float:
        if kind not in found:
            return default
        textures[name] = np.ascontiguousarray(image(kind, n_channels), np.float32)
        return texture(name)

    material: Facts = {
        "type": "principled",
        "specular": 0.5,
        "base_color": lookup("base_color", "colour", 3, {"type": "rgb", "value": [0.5, 0.5, 0.5]}),
        "roughness": lookup("roughness", "roughness", 1, 1.0),
        "metallic": lookup("metallic", "metalness", 1, 0.0),
    }
    if "displacement" in found:
        if "normal" in found:
            notes.add("normal map beside a displacement, which has its slopes", found["normal"].name)
        heights = image("displacement", 1)[..., 0]
        check_heights(heights, found["displacement"], allow_seams)
        part = surface(amplitude * (heights - heights.max()), material, textures)
    else:
        if "normal" in found:
            values = image("normal", 3)
            check_normals(values, found["normal"], "normal")
            if rows == "down":  # green points up in the picture
                values = np.stack([values[..., 0], 1 - values[..., 1], values[..., 2]], -1)
            textures["normal"] = np.ascontiguousarray(values, np.float32)
            material = {
                "type": "normalmap",
                "use_shadowing_function": False,
                "normalmap": texture("normal"),
                "bsdf": material,
            }
        flat = square_below(0.0, material)
        part = Part(flat.vertices, flat.faces, material, normals=flat.normals, textures=textures)
    parameters = {
        "folder": str(folder),
        "amplitude": amplitude,
        "rows": rows,
        "allow_seams": bool(allow_seams),
    }
    return Mesostructure("map_folder", parameters, (part,), notes.lines())


def _found(folder: Path, notes: Notes) -> dict[str, Path]:
    """Maps by what they are."""
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, field="folder")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not path.is_file():
            continue
        kind = kind_of(path)
        if kind is None:
            notes.add("files that are no map of a known name", path.name)
        elif kind in found:
            raise InputError(
                f"two maps of {kind}", file=folder, field=kind, got=f"{found[kind].name} and {path.name}",
                expected="one",
            )  # fmt: skip
        else:
            found[kind] = path
    if (other := found.pop("normal of the other hand", None)) is not None:
        notes.add("normal map whose green points down; *_NormalGL is read", other.name)
    return found


def kind_of(path: PathLike) -> str | None:
    """What a map is by its name, a key of `WORDS`: by the longest ending that is known; None for other files.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    str or None
    """
    path = Path(path)
    if path.suffix.lower() not in _IMAGES:
        return None
    kinds = {word: kind for kind, words in WORDS.items() for word in words}
    words = re.split(r"[_\-. ]", _SIZE.sub("", path.stem))
    for n in (3, 2, 1):
        kind = kinds.get("".join(words[-n:]).lower())
        if kind is not None:
            return kind
    return None
