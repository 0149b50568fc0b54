"""Drops: frosted dielectric lenses over a printed ground, which is seen and lit through them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.bodies.scattering import disjoint_radii, scattered
from btfref.mesostructure.bodies.shapes import ellipsoids
from btfref.mesostructure.checks import colour, number, whole

#: Free space between drops, and between drops and ground, tile units.
_GAP = 0.004


def drops(
    *,
    count: int = 12,
    height: float = 0.8,
    ior: float = 1.5,
    roughness: float = 0.5,
    stripes: int = 4,
    first_colour: Sequence[float] = (0.75, 0.72, 0.66),
    second_colour: Sequence[float] = (0.04, 0.22, 0.25),
    rings: int = 24,
    sides: int = 40,
    seed: int = 7,
) -> Mesostructure:
    """Flattened balls of a rough dielectric just above a Lambertian ground with stripes along y.

    Parameters
    ----------
    count : int
        Drops on the tile, 2 to 200.
    height : float
        Of a drop over its diameter, [0.05, 1].
    ior : float
        Index of refraction, [1.05, 2.5].
    roughness : float
        GGX α, [0.1, 1]: light finds its way through rough surfaces alone, and through smoother ones with more noise.
    stripes : int
        Stripes of each colour.
    first_colour, second_colour : sequence of 3 floats
        Of the ground, linear RGB in [0, 1].
    rings, sides : int
        Rings of vertices of a drop and vertices of a ring.
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
    parameters = {
        "count": whole("drops", "count", count, 2, 200),
        "height": number("drops", "height", height, 0.05, 1.0),
        "ior": number("drops", "ior", ior, 1.05, 2.5),
        "roughness": number("drops", "roughness", roughness, 0.1, 1.0),
        "stripes": whole("drops", "stripes", stripes, 1, 64),
        "first_colour": colour("drops", "first_colour", first_colour),
        "second_colour": colour("drops", "second_colour", second_colour),
        "rings": whole("drops", "rings", rings, 4, 128),
        "sides": whole("drops", "sides", sides, 6, 256),
        "seed": whole("drops", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    places = scattered(rng, count)
    radii = disjoint_radii(places, _GAP)
    axes = np.stack([radii, radii, height * radii], -1)
    top = 2 * axes[:, 2].max()
    centres = np.concatenate([places, axes[:, 2:] - top], -1)
    vertices, normals, faces = ellipsoids(centres, axes, np.zeros(count), rings, sides)
    glass = {
        "type": "roughdielectric",
        "distribution": "ggx",
        "alpha": float(roughness),
        "int_ior": float(ior),
    }
    low = -top - _GAP
    printed = [
        Part(
            *_stripes(stripes, k, low), {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour_}}
        )
        for k, colour_ in enumerate((parameters["first_colour"], parameters["second_colour"]))
    ]
    return Mesostructure("drops", parameters, (Part(vertices, faces, glass, normals=normals), *printed))


def _stripes(count: int, first: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Every other one of 2 · count stripes."""
    left = (2 * np.arange(count) + first) / (2 * count)
    right = (2 * np.arange(count) + first + 1) / (2 * count)
    corners = [(left, 0), (right, 0), (right, 1), (left, 1)]
    vertices = np.stack([np.stack(np.broadcast_arrays(x, y, z), -1) for x, y in corners], 1)
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]
    return vertices.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
