"""Modelled mesostructure: periodic geometry with materials, from which BTFs are synthesized.

A mesostructure lives on the unit tile [0, 1]² of the plane spanned by x (u) and y (v), repeats without a
seam, and lies below the sampling plane z = 0, which its highest point touches. Heights are in tile units.

A new one is a module with a function ``name(**parameters) -> Mesostructure`` and a row below; third parties
add rows through the entry-point group ``btfref.mesostructures``.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part
from btfref.registry.points import Catalogue

if TYPE_CHECKING:
    from btfref.types import PathLike

__all__ = ["MESOSTRUCTURES", "Mesostructure", "Part", "build", "names"]

#: name -> "module:function", imported when asked for.
MESOSTRUCTURES = {
    "blisters": "btfref.mesostructure.bodies.blisters:blisters",
    "brushed": "btfref.mesostructure.relief.brushed:brushed",
    "checker": "btfref.mesostructure.checker:checker",
    "flakes": "btfref.mesostructure.bodies.flakes:flakes",
    "flat": "btfref.mesostructure.flat:flat",
    "hammered": "btfref.mesostructure.relief.hammered:hammered",
    "height_map": "btfref.mesostructure.height_map:height_map",
    "knit": "btfref.mesostructure.cloth.knit:knit",
    "leather": "btfref.mesostructure.relief.leather:leather",
    "mail": "btfref.mesostructure.bodies.mail:mail",
    "map_folder": "btfref.mesostructure.map_folder:map_folder",
    "mesh": "btfref.mesostructure.mesh:mesh",
    "pebbles": "btfref.mesostructure.bodies.pebbles:pebbles",
    "pile": "btfref.mesostructure.cloth.pile:pile",
    "plaster": "btfref.mesostructure.relief.plaster:plaster",
    "rings": "btfref.mesostructure.rings:rings",
    "satin": "btfref.mesostructure.cloth.weave:satin",
    "specks": "btfref.mesostructure.bodies.specks:specks",
    "tissue": "btfref.mesostructure.tissue:tissue",
    "twill": "btfref.mesostructure.cloth.weave:twill",
}

#: Mesostructures made from a user's file: name -> suffixes. A file's name stands for them.
FROM_FILES = {
    "height_map": (".png", ".exr", ".tif", ".tiff"),
    "mesh": (".ply", ".obj", ".glb", ".gltf", ".stl", ".off"),
    "map_folder": (),  # a folder
}

ENTRY_POINT_GROUP = "btfref.mesostructures"

_CATALOGUE = Catalogue("mesostructure", MESOSTRUCTURES, ENTRY_POINT_GROUP)


def names() -> list[str]:
    """Names of all mesostructures, built in and from entry points, sorted."""
    return sorted(_CATALOGUE.names())


def place(name: str) -> str:
    """``"module:function"`` of a registered mesostructure.

    Raises
    ------
    InputError
        When there is none of that name.
    """
    return _CATALOGUE.place(name)


def build(mesostructure: PathLike | Mesostructure, **parameters: Any) -> Mesostructure:
    """Geometry and materials of a mesostructure.

    Parameters
    ----------
    mesostructure : str, path-like or Mesostructure
        A registered name, or a user's file: PNG, TIFF and OpenEXR are height maps, PLY, OBJ, GLB and others meshes,
        a folder holds maps of one material. A `Mesostructure` is handed through (and takes no parameters).
    **parameters
        Parameters of that mesostructure, e.g. ``amplitude`` in tile units.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        Unknown name, unknown parameter or a value out of range.
    """
    if isinstance(mesostructure, Mesostructure):
        if parameters:
            raise InputError(
                "a built mesostructure takes no parameters",
                field=", ".join(sorted(parameters)),
                expected="none",
            )
        return mesostructure
    mesostructure = str(mesostructure)
    suffix = Path(mesostructure).suffix.lower()
    if mesostructure not in names() and Path(mesostructure).is_dir():
        parameters = {"folder": mesostructure, **parameters}
        mesostructure, suffix = "map_folder", ""
    for name, suffixes in FROM_FILES.items():
        if suffix in suffixes:
            parameters = {"file": mesostructure, **parameters}
            mesostructure = name
    builder = _CATALOGUE.load(mesostructure)
    known = inspect.signature(builder).parameters
    for key in parameters:
        if key not in known:
            raise InputError(
                f"mesostructure '{mesostructure}' has no such parameter",
                field=key,
                expected=f"one of {', '.join(known)}",
            )
    for key, parameter in known.items():
        if parameter.default is parameter.empty and key not in parameters:
            raise InputError(f"mesostructure '{mesostructure}' needs a parameter", field=key)
    try:
        return builder(**parameters)
    except InputError:
        raise
    except (TypeError, ValueError) as error:  # text where a number belongs, a list where a scalar does
        raise InputError(
            f"mesostructure '{mesostructure}' cannot take these values",
            field=", ".join(parameters),
            got=", ".join(map(repr, parameters.values())),
        ) from error
