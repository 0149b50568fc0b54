"""The maps of a g-BRDF as ordinary pictures for editing, and back without loss.

A folder holds ``maps.toml`` with the scalars and one picture a map: ``height.exr`` (0 … 1 between the scalars
``height_min`` and ``height_max``), ``rotation.png`` (the turn as hue, as in the paper), ``diffuse.exr`` (linear RGB),
``fresnel.exr``, ``material.png`` (palette index) and ``ndf_0.exr``, ``ndf_1.exr``… Any of them may be replaced by a PNG
or an OpenEXR file of the same stem: PNG colours are sRGB, other PNG numbers are shares of their range.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.directions import directions
from btfref.outputs import new_folder
from btfref.representations.gbrdf.build import HUE_STEPS, from_maps

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.representations.gbrdf.definition import Representation
    from btfref.types import Facts, PathLike


SCALARS = "maps.toml"

#: Colours of the first materials in the palette of ``material.png``; the others repeat them.
PALETTE = ((214, 69, 65), (65, 131, 215), (245, 215, 110), (63, 195, 128), (155, 89, 182), (242, 120, 75))


def hue_of_turns(rotation: ArrayLike) -> np.ndarray:
    """Pictures of turns as fully saturated hues: 0 red, 1/3 green, 2/3 blue; (...) -> uint8 (..., 3)."""
    code = np.rint(np.asarray(rotation, float) * HUE_STEPS).astype(int) % HUE_STEPS
    sector, rest = np.divmod(code, 255)
    up, down = rest, 255 - rest
    full, none = np.full_like(rest, 255), np.zeros_like(rest)
    choices = [
        (full, up, none),
        (down, full, none),
        (none, full, up),
        (none, down, full),
        (up, none, full),
        (full, none, down),
    ]
    return np.stack([np.choose(sector, [c[k] for c in choices]) for k in range(3)], -1).astype(np.uint8)


def turns_of_hue(colours: ArrayLike) -> np.ndarray:
    """Turns of any colours by their hue; grey has none and counts as 0. Shape (..., 3) -> float64 (...)."""
    colours = np.asarray(colours, float)
    high, low = colours.max(-1), colours.min(-1)
    spread = np.where(high > low, high - low, 1)
    r, g, b = np.moveaxis(colours, -1, 0)
    hue = np.select([r >= high, g >= high], [(g - b) / spread, 2 + (b - r) / spread], 4 + (r - g) / spread)
    return np.where(high > low, np.mod(hue / 6, 1), 0.0)


def export_maps(representation: Representation, out: PathLike) -> Facts:
    """Write the maps of a g-BRDF into a new folder.

    Parameters
    ----------
    representation : btfref.representations.gbrdf.definition.Representation
    out : path-like
        Folder to make.

    Returns
    -------
    dict
        ``maps`` and ``images``: how many.

    Raises
    ------
    InputError
        When the folder exists, or the one that it belongs in does not.
    """
    from PIL import Image

    from btfref.images.decoding import write_exr

    maps, meta = representation.maps, representation.meta
    if len(maps["ndf"]) > 256:
        raise InputError(
            "too many materials for a palette", field="ndf", got=len(maps["ndf"]), expected="≤ 256"
        )
    with new_folder(out) as folder:

        def exr(stem: str, image: np.ndarray) -> None:
            planes = dict(zip("Y" if image.shape[-1] == 1 else "RGB", np.moveaxis(image, -1, 0), strict=True))
            write_exr(planes, folder / f"{stem}.exr", image.dtype.type)

        for name in ("height", "diffuse", "fresnel"):
            exr(name, maps[name])
        for k, table in enumerate(maps["ndf"]):
            exr(f"ndf_{k}", table)
        Image.fromarray(hue_of_turns(maps["rotation"][..., 0])).save(folder / "rotation.png")
        picture = Image.fromarray(maps["material"][..., 0].astype(np.uint8), "P")
        picture.putpalette([x for k in range(256) for x in PALETTE[k % len(PALETTE)]])
        picture.save(folder / "material.png")
        (folder / SCALARS).write_text(_scalars(maps, meta), encoding="utf-8")
    return {"format": "maps", "maps": 6, "images": 5 + len(maps["ndf"])}


def _scalars(maps: dict[str, np.ndarray], meta: Facts) -> str:
    storage = "half" if maps["diffuse"].dtype == np.float16 else "float"
    lines = [
        "# Scalars of a g-BRDF; the pictures beside this file are its maps.",
        'method = "gbrdf"',
        f"height_min = {meta['constants']['height_min']!r}  # tile units of a height of 0",
        f"height_max = {meta['constants']['height_max']!r}  # tile units of a height of 1",
        f"specular = {[float(x) for x in maps['specular'][:, 0]]!r}  # c_s of each material, 0 to 1",
        f'filter_type = "{meta["filter_type"]}"',
        f'storage = "{storage}"  # of colours and distributions: half or float',
        f"parameters = {json.dumps(json.dumps(meta['parameters']))}",
        f"parent = {json.dumps(json.dumps(meta['parent']))}",
    ]
    for name in ("views", "lights"):
        own = meta[name]["name"]
        spec = json.dumps(own) if own != "custom" else json.dumps(maps[f"{name[:-1]}_directions"].tolist())
        lines.append(f"{name} = {spec}  # directions that guide importance sampling")
    return "\n".join(lines) + "\n"


def import_maps(folder: PathLike) -> Representation:
    """A g-BRDF from a folder that :func:`export_maps` wrote, edited or not.

    Parameters
    ----------
    folder : path-like

    Returns
    -------
    btfref.representations.gbrdf.definition.Representation

    Raises
    ------
    InputError
        Missing or unreadable files, values out of range, pictures of different sizes.
    """
    folder = Path(folder)
    path = folder / SCALARS
    if not path.is_file():
        raise InputError("no such file", file=path)
    try:
        scalars = tomllib.loads(path.read_text(encoding="utf-8"))
        parameters, parent = (json.loads(scalars[name]) for name in ("parameters", "parent"))
        settings: Facts = {
            name: scalars[name] for name in ("height_min", "height_max", "filter_type", "storage")
        }
        specular = np.asarray(scalars["specular"], float)
        sets = {
            name: directions(spec if isinstance(spec, str) else np.asarray(spec, float))
            for name, spec in ((name, scalars[name]) for name in ("views", "lights"))
        }
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError("cannot read the scalars", file=path, got=error) from error
    stems = sorted({p.stem for p in folder.iterdir() if p.stem.startswith("ndf_")}, key=lambda s: (len(s), s))
    if stems != [f"ndf_{k}" for k in range(len(stems))] or not stems:
        raise InputError(
            "distributions", file=folder, got=", ".join(stems) or "none", expected="ndf_0, ndf_1, …"
        )
    height = _numbers(folder, "height")
    fresnel, diffuse = _numbers(folder, "fresnel"), _colours(folder, "diffuse")
    rotation, material = turns_of_hue(_picture(folder, "rotation")[0]), _indices(folder, "material")
    maps = {"fresnel": fresnel, "rotation": rotation, "material": material, "diffuse": diffuse}
    for name, image in maps.items():
        if image.shape[:2] != height.shape:
            raise InputError(
                "pictures differ in size", file=folder, field=name, got=image.shape[:2], expected=height.shape
            )
    tables = [_colours(folder, stem) for stem in stems]
    if len({table.shape for table in tables}) > 1:
        raise InputError("distributions differ in size", file=folder, got=[t.shape[:2] for t in tables])
    try:
        return from_maps(
            height,
            diffuse=diffuse,
            fresnel=fresnel,
            rotation=rotation,
            material=material,
            ndf=np.stack(tables),
            specular=specular,
            parameters=parameters,
            parent=parent,
            views=sets["views"],
            lights=sets["lights"],
            **settings,
        )
    except InputError as error:
        raise InputError(
            error.message, file=folder, field=error.field, got=error.got, expected=error.expected
        ) from None


def _picture(folder: Path, stem: str) -> tuple[np.ndarray, Path]:
    """The one picture of a map, and its path."""
    from btfref.mesostructure.materials import read_image

    found = sorted(p for p in folder.iterdir() if p.stem == stem and p.suffix.lower() in (".png", ".exr"))
    if len(found) != 1:
        got = ", ".join(p.name for p in found) or "none"
        raise InputError("one picture for each map", file=folder, field=stem, got=got)
    return read_image(found[0], field=stem), found[0]


def _numbers(folder: Path, stem: str) -> np.ndarray:
    from btfref.mesostructure.materials import as_numbers

    return as_numbers(_picture(folder, stem)[0])[..., 0]


def _colours(folder: Path, stem: str) -> np.ndarray:
    """Linear colours in float64; unlike for textures, floats are not rounded."""
    from btfref.mesostructure.materials import linear_colours

    image, _ = _picture(folder, stem)
    values = image.astype(float) if image.dtype.kind == "f" else linear_colours(image).astype(float)
    return np.broadcast_to(values, (*values.shape[:2], 3))


def _indices(folder: Path, stem: str) -> np.ndarray:
    from PIL import Image

    image, path = _picture(folder, stem)
    if path.suffix.lower() == ".png":
        # The palette's colours are for eyes: the indices count.
        with Image.open(path) as picture:
            values = np.asarray(picture)
        if values.ndim != 2 or values.dtype.kind not in "ui":
            raise InputError(
                "an index map", file=path, got=f"{values.dtype} {values.shape}", expected="palette or grey"
            )
        return values.astype(np.int64)
    if not (image == np.rint(image)).all():
        raise InputError("an index map holds fractions", file=path)
    return image[..., 0].astype(np.int64)
