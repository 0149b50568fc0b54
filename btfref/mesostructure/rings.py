"""Concentric gold-like rings on a blue glossy base plane.

After the rings of Suykens, vom Berge, Lagae, Dutré, *Interactive rendering with bidirectional texture
functions* (Eurographics 2003); their dimensions are not given there, those here are our own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.shapes import torus, torus_faces
from btfref.mesostructure.checks import colour, number, whole


def rings(
    *,
    count: int = 3,
    thickness: float = 0.09,
    gap: float = 0.004,
    segments: int = 144,
    sides: int = 32,
    material: str = "Au",
    roughness: float = 0.15,
    base_colour: Sequence[float] = (0.05, 0.12, 0.5),
    base_roughness: float = 0.1,
) -> Mesostructure:
    """Closed rings (tori) around the middle of the tile, evenly spaced, just above a plane.

    Parameters
    ----------
    count : int
        Rings, 1 to 16.
    thickness : float
        Diameter of the wire in tile units; the rings must not touch: below 1 / (2 count + 1).
    gap : float
        Clearance between wire and plane, [1e-4, 1].
    segments, sides : int
        Quads along a ring and around the wire, multiples of 4.
    material : str
        Conductor as named by Mitsuba, e.g. "Au", "Cu", "Ag".
    roughness : float
        GGX α of the rings, [0.01, 1].
    base_colour : sequence of 3 floats
        Diffuse albedo of the plane, linear RGB in [0, 1].
    base_roughness : float
        GGX α of the plane, [0.01, 1].

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    count = whole("rings", "count", count, 1, 16)
    thickness = number("rings", "thickness", thickness, 1e-3, 0.5)
    if thickness * (2 * count + 1) >= 1:
        raise InputError(
            "rings would touch", field="thickness", got=thickness, expected=f"below {1 / (2 * count + 1):.4g}"
        )
    gap = number("rings", "gap", gap, 1e-4, 1.0)
    segments = whole("rings", "segments", segments, 8, 4096, 4)
    sides = whole("rings", "sides", sides, 8, 1024, 4)
    roughness = number("rings", "roughness", roughness, 0.01, 1.0)
    base_roughness = number("rings", "base_roughness", base_roughness, 0.01, 1.0)
    base_colour = colour("rings", "base_colour", base_colour)
    if not isinstance(material, str):
        raise InputError("parameter of rings", field="material", got=material, expected="a name such as Au")

    wire = 0.5 * thickness
    vertices, normals, faces = [], [], []
    for index in range(count):
        # Radii at odd multiples of half a spacing, so that neighbouring tiles continue the pattern.
        radius = (2 * index + 2) / (4 * count + 2)
        ring, normal = torus(radius, wire, segments, sides, [0.5, 0.5, -wire])
        faces.append(torus_faces(segments, sides) + index * segments * sides)
        vertices.append(ring)
        normals.append(normal)
    gold = {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": roughness}
    blue = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": base_roughness,
        "diffuse_reflectance": {"type": "rgb", "value": base_colour},
    }
    parts = (
        Part(np.concatenate(vertices), np.concatenate(faces), gold, normals=np.concatenate(normals)),
        square_below(-thickness - gap, blue),
    )
    parameters = {
        "count": count,
        "thickness": thickness,
        "gap": gap,
        "segments": segments,
        "sides": sides,
        "material": material,
        "roughness": roughness,
        "base_colour": base_colour,
        "base_roughness": base_roughness,
    }
    return Mesostructure("rings", parameters, parts)
