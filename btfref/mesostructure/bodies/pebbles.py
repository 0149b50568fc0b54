"""Pebbles: tall rounded stones side by side, with deep gaps between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.scattering import disjoint_radii, scattered
from btfref.mesostructure.bodies.shapes import ellipsoids
from btfref.mesostructure.checks import colour, number, whole

#: Free space between the circles in which stones lie, tile units.
_GAP = 0.004


def pebbles(
    *,
    count: int = 22,
    tallness: float = 1.15,
    flatness: float = 0.25,
    light_colour: Sequence[float] = (0.55, 0.50, 0.42),
    warm_colour: Sequence[float] = (0.42, 0.24, 0.13),
    dark_colour: Sequence[float] = (0.12, 0.13, 0.15),
    ground_colour: Sequence[float] = (0.20, 0.17, 0.12),
    roughness: float = 0.3,
    rings: int = 20,
    sides: int = 32,
    seed: int = 6,
) -> Mesostructure:
    """Ellipsoids of three colours in circles that do not meet, over a Lambertian ground on which they all but stand.

    Parameters
    ----------
    count : int
        Stones on the tile, 3 to 200.
    tallness : float
        Height of a stone over the diameter of its circle, [0.1, 2].
    flatness : float
        How much narrower than long stones are at most, as a share, [0, 0.8].
    light_colour, warm_colour, dark_colour : sequence of 3 floats
        Diffuse albedos of a third of the stones each, linear RGB in [0, 1].
    ground_colour : sequence of 3 floats
    roughness : float
        GGX α of the stones, [0.01, 1].
    rings, sides : int
        Rings of vertices of a stone and vertices of a ring.
    seed : int
        Of places and shapes.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    parameters = {
        "count": whole("pebbles", "count", count, 3, 200),
        "tallness": number("pebbles", "tallness", tallness, 0.1, 2.0),
        "flatness": number("pebbles", "flatness", flatness, 0.0, 0.8),
        "light_colour": colour("pebbles", "light_colour", light_colour),
        "warm_colour": colour("pebbles", "warm_colour", warm_colour),
        "dark_colour": colour("pebbles", "dark_colour", dark_colour),
        "ground_colour": colour("pebbles", "ground_colour", ground_colour),
        "roughness": number("pebbles", "roughness", roughness, 0.01, 1.0),
        "rings": whole("pebbles", "rings", rings, 4, 128),
        "sides": whole("pebbles", "sides", sides, 6, 256),
        "seed": whole("pebbles", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    places = scattered(rng, count)
    radii = disjoint_radii(places, _GAP)
    narrow = 1 - flatness * rng.random(count)
    axes = np.stack([radii, radii * narrow, radii * tallness * (0.8 + 0.2 * rng.random(count))], -1)
    turn = 2 * np.pi * rng.random(count)
    centres = np.concatenate([places, axes[:, 2:]], -1)
    top = 2 * axes[:, 2].max()
    centres[:, 2] -= top
    parts = []
    for k, name in enumerate(("light_colour", "warm_colour", "dark_colour")):
        some = slice(k, None, 3)
        vertices, normals, faces = ellipsoids(centres[some], axes[some], turn[some], rings, sides)
        stone = {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": float(roughness),
            "diffuse_reflectance": {"type": "rgb", "value": parameters[name]},
        }
        parts.append(Part(vertices, faces, stone, normals=normals))
    ground = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["ground_colour"]}}
    return Mesostructure("pebbles", parameters, (*parts, square_below(-top - _GAP, ground)))
