"""Flakes: a few small mirrors that lean every way over dark lacquer; glints are rare and bright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.scattering import distances, scattered
from btfref.mesostructure.bodies.shapes import plates, tilted
from btfref.mesostructure.checks import colour, number, whole

#: Free space between flakes, and between flakes and ground, tile units.
_GAP = 0.002


def flakes(
    *,
    count: int = 40,
    radius: float = 0.03,
    thickness: float = 0.004,
    tilt: float = 25.0,
    material: str = "Ag",
    roughness: float = 0.06,
    base_colour: Sequence[float] = (0.01, 0.03, 0.10),
    base_roughness: float = 0.1,
    sides: int = 6,
    seed: int = 8,
) -> Mesostructure:
    """Plates of polished metal, each tilted at random, over a glossy plane.

    Parameters
    ----------
    count : int
        On the tile, 2 to 400.
    radius : float
        Of the largest, tile units; the smallest have half of it.
    thickness : float
        Tile units.
    tilt : float
        Root mean square angle of the normals, degrees, [0, 60]; none is above twice that.
    material : str
        Conductor as named by Mitsuba.
    roughness, base_roughness : float
        GGX α, [0.01, 1].
    base_colour : sequence of 3 floats
        Diffuse albedo of the plane.
    sides : int
        Corners of a flake.
    seed : int
        Of places, sizes and tilts.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or flakes that would meet.
    """
    if not isinstance(material, str):
        raise InputError("parameter of flakes", field="material", got=material, expected="a name such as Ag")
    parameters = {
        "count": whole("flakes", "count", count, 2, 400),
        "radius": number("flakes", "radius", radius, 1e-3, 0.4),
        "thickness": number("flakes", "thickness", thickness, 1e-4, 0.1),
        "tilt": number("flakes", "tilt", tilt, 0.0, 60.0),
        "material": material,
        "roughness": number("flakes", "roughness", roughness, 0.01, 1.0),
        "base_colour": colour("flakes", "base_colour", base_colour),
        "base_roughness": number("flakes", "base_roughness", base_roughness, 0.01, 1.0),
        "sides": whole("flakes", "sides", sides, 3, 64),
        "seed": whole("flakes", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    places = scattered(rng, count)
    # Balls about the flakes must not meet.
    most = 0.5 * (distances(places).min() - _GAP)
    if np.hypot(radius, 0.5 * thickness) > most:
        raise InputError(
            "flakes would meet", field="radius", got=radius, expected=f"below {most:.4g}, or fewer flakes"
        )
    # Rayleigh's law: slopes along x and y are normal.
    lean = np.minimum(np.sqrt(-np.log1p(-rng.random(count))), 2.0) * np.radians(tilt)
    frames = tilted(lean, 2 * np.pi * rng.random(count))
    sizes = radius * (0.5 + 0.5 * rng.random(count))
    centres = np.concatenate([places, np.zeros((count, 1))], -1)
    vertices, faces = plates(centres, sizes, thickness, frames, sides)
    each = vertices.reshape(count, -1, 3)
    each[..., 2] -= each[..., 2].min(1)[:, None]  # they lie on the ground with one edge
    top = vertices[:, 2].max()
    vertices[:, 2] -= top
    metal = {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": float(roughness)}
    lacquer = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": float(base_roughness),
        "diffuse_reflectance": {"type": "rgb", "value": parameters["base_colour"]},
    }
    return Mesostructure(
        "flakes", parameters, (Part(vertices, faces, metal), square_below(-top - _GAP, lacquer))
    )
