"""Specks: three layers of small discs of different looks over each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.scattering import disjoint_radii, scattered
from btfref.mesostructure.bodies.shapes import plates
from btfref.mesostructure.checks import colour, number, whole

if TYPE_CHECKING:
    from btfref.types import Facts

#: Free space between discs of a layer, tile units.
_GAP = 0.004

#: Thickness of a disc as a share of a layer's height.
_SHARE = 0.35


def specks(
    *,
    count: int = 26,
    layer: float = 0.03,
    largest: float = 0.075,
    dull_colour: Sequence[float] = (0.70, 0.66, 0.58),
    glossy_colour: Sequence[float] = (0.50, 0.06, 0.04),
    metal: str = "Au",
    base_colour: Sequence[float] = (0.06, 0.07, 0.08),
    sides: int = 24,
    seed: int = 9,
) -> Mesostructure:
    """Discs in three layers: dull below, glossy between, metal on top; within a layer none meets another.

    Parameters
    ----------
    count : int
        Discs of each layer, 2 to 200.
    layer : float
        Height of a layer, tile units.
    largest : float
        Radius above which discs are cut down, tile units.
    dull_colour, glossy_colour, base_colour : sequence of 3 floats
        Diffuse albedos, linear RGB in [0, 1].
    metal : str
        Conductor as named by Mitsuba.
    sides : int
        Corners of a disc.
    seed : int
        Of places and sizes.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    if not isinstance(metal, str):
        raise InputError("parameter of specks", field="metal", got=metal, expected="a name such as Au")
    parameters: Facts = {
        "count": whole("specks", "count", count, 2, 200),
        "layer": number("specks", "layer", layer, 1e-3, 0.5),
        "largest": number("specks", "largest", largest, 1e-3, 0.45),
        "dull_colour": colour("specks", "dull_colour", dull_colour),
        "glossy_colour": colour("specks", "glossy_colour", glossy_colour),
        "metal": metal,
        "base_colour": colour("specks", "base_colour", base_colour),
        "sides": whole("specks", "sides", sides, 3, 128),
        "seed": whole("specks", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    looks = (
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["dull_colour"]}},
        _glossy(parameters["glossy_colour"], 0.15),
        {"type": "roughconductor", "material": metal, "distribution": "ggx", "alpha": 0.2},
    )
    thickness = _SHARE * layer
    parts = []
    for k, look in enumerate(looks):
        places = scattered(rng, count)
        # Metal lies on top and is smaller, so that the layers below are seen.
        radii = np.minimum(disjoint_radii(places, _GAP), largest * (1 - 0.25 * k)) * (
            0.5 + 0.5 * rng.random(count)
        )
        centres = np.concatenate([places, np.full((count, 1), (k - 2) * layer - 0.5 * thickness)], -1)
        frames = np.broadcast_to(np.eye(3), (count, 3, 3))
        parts.append(Part(*plates(centres, radii, thickness, frames, parameters["sides"]), look))
    top = max(part.vertices[:, 2].max() for part in parts)
    moved = [Part(part.vertices - [0, 0, top], part.faces, part.bsdf) for part in parts]
    base = square_below(-3 * layer, _glossy(parameters["base_colour"], 0.3))
    return Mesostructure("specks", parameters, (*moved, base))


def _glossy(albedo: list[float], roughness: float) -> Facts:
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": roughness,
        "diffuse_reflectance": {"type": "rgb", "value": albedo},
    }
