"""Blisters: thin translucent shells over a printed ground, which glow where light shines through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.bodies.scattering import disjoint_radii, scattered
from btfref.mesostructure.bodies.shapes import ellipsoids
from btfref.mesostructure.bodies.thin import thin
from btfref.mesostructure.checks import colour, number, whole

if TYPE_CHECKING:
    from btfref.types import Facts

#: Free space between shells, and between shells and ground, tile units.
_GAP = 0.004


def blisters(
    *,
    count: int = 12,
    height: float = 0.8,
    transmission: float = 1.2,
    shell_colour: Sequence[float] = (0.85, 0.78, 0.62),
    roughness: float = 0.3,
    stripes: int = 4,
    first_colour: Sequence[float] = (0.75, 0.72, 0.66),
    second_colour: Sequence[float] = (0.04, 0.22, 0.25),
    rings: int = 24,
    sides: int = 40,
    seed: int = 7,
) -> Mesostructure:
    """Flattened hollow balls of a thin material just above a Lambertian ground with stripes along y.

    Parameters
    ----------
    count : int
        Shells on the tile, 2 to 200.
    height : float
        Of a shell over its diameter, [0.05, 1].
    transmission : float
        Diffuse transmission of Mitsuba's ``principledthin``, [0, 2]: 1 sends half of the diffuse light through.
    shell_colour : sequence of 3 floats
        Linear RGB in [0, 1].
    roughness : float
        Of the shells' gloss, [0.01, 1].
    stripes : int
        Stripes of each colour.
    first_colour, second_colour : sequence of 3 floats
        Of the ground, linear RGB in [0, 1].
    rings, sides : int
        Rings of vertices of a shell and vertices of a ring.
    seed : int
        Of the places.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    parameters: Facts = {
        "count": whole("blisters", "count", count, 2, 200),
        "height": number("blisters", "height", height, 0.05, 1.0),
        "transmission": number("blisters", "transmission", transmission, 0.0, 2.0),
        "shell_colour": colour("blisters", "shell_colour", shell_colour),
        "roughness": number("blisters", "roughness", roughness, 0.01, 1.0),
        "stripes": whole("blisters", "stripes", stripes, 1, 64),
        "first_colour": colour("blisters", "first_colour", first_colour),
        "second_colour": colour("blisters", "second_colour", second_colour),
        "rings": whole("blisters", "rings", rings, 4, 128),
        "sides": whole("blisters", "sides", sides, 6, 256),
        "seed": whole("blisters", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    places = scattered(rng, count)
    radii = disjoint_radii(places, _GAP)
    axes = np.stack([radii, radii, height * radii], -1)
    top = 2 * axes[:, 2].max()
    centres = np.concatenate([places, axes[:, 2:] - top], -1)
    vertices, normals, faces = ellipsoids(centres, axes, np.zeros(count), rings, sides)
    shell = thin(parameters["shell_colour"], roughness, transmission)
    low = -top - _GAP
    printed = [
        Part(
            *_stripes(stripes, k, low), {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour_}}
        )
        for k, colour_ in enumerate((parameters["first_colour"], parameters["second_colour"]))
    ]
    return Mesostructure("blisters", parameters, (Part(vertices, faces, shell, normals=normals), *printed))


def _stripes(count: int, first: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Every other one of 2 · count stripes."""
    left = (2 * np.arange(count) + first) / (2 * count)
    right = (2 * np.arange(count) + first + 1) / (2 * count)
    corners = [(left, 0), (right, 0), (right, 1), (left, 1)]
    vertices = np.stack([np.stack(np.broadcast_arrays(x, y, z), -1) for x, y in corners], 1)
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]
    return vertices.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
