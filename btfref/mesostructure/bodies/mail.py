"""Chain mail: lying rings, linked by standing ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.shapes import repeated, torus, torus_faces
from btfref.mesostructure.checks import colour, number, whole

#: Smallest clearance between wires as a share of their thickness.
_CLEARANCE = 0.02

#: Axes of a ring in the planes z = 0, y = 0 and x = 0.
_FRAMES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
)

#: Middles of the three rings of a cell.
_MIDDLES = np.array([[0.5, 0.5, 0], [1.0, 0.5, 0], [0.5, 1.0, 0]])


def mail(
    *,
    count: int = 3,
    wire: float = 0.1,
    lying: float = 0.37,
    standing: float = 0.25,
    segments: int = 64,
    sides: int = 20,
    material: str = "Ag",
    roughness: float = 0.18,
    base_colour: Sequence[float] = (0.25, 0.03, 0.03),
    gap: float = 0.05,
) -> Mesostructure:
    """Lying rings on a square lattice, neighbours linked by standing rings, over a Lambertian ground.

    Parameters
    ----------
    count : int
        Cells along a side of the tile, 1 to 16.
    wire : float
        Thickness of the wire, in sides of a cell.
    lying, standing : float
        Radii of the two kinds of rings, in sides of a cell.
    segments, sides : int
        Quads along a ring and around the wire, multiples of 4.
    material : str
        Conductor as named by Mitsuba.
    roughness : float
        GGX α, [0.01, 1].
    base_colour : sequence of 3 floats
        Albedo of the ground.
    gap : float
        Between the rings and the ground, in sides of a cell.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or rings that would meet or not be linked.
    """
    if not isinstance(material, str):
        raise InputError("parameter of mail", field="material", got=material, expected="a name such as Ag")
    parameters = {
        "count": whole("mail", "count", count, 1, 16),
        "wire": number("mail", "wire", wire, 1e-3, 0.5),
        "lying": number("mail", "lying", lying, 0.05, 0.5),
        "standing": number("mail", "standing", standing, 0.05, 0.5),
        "segments": whole("mail", "segments", segments, 8, 1024, 4),
        "sides": whole("mail", "sides", sides, 8, 256, 4),
        "material": material,
        "roughness": number("mail", "roughness", roughness, 0.01, 1.0),
        "base_colour": colour("mail", "base_colour", base_colour),
        "gap": number("mail", "gap", gap, 1e-3, 1.0),
    }
    if standing <= 0.5 - lying:
        raise InputError(
            "rings that are not linked", field="standing", got=standing, expected=f"above {0.5 - lying:.4g}"
        )
    apart = clearance(lying, standing)
    if apart < (1 + _CLEARANCE) * wire:
        raise InputError(
            "rings would meet",
            field="wire",
            got=wire,
            expected=f"at most {apart / (1 + _CLEARANCE):.4g}, or rings of other sizes",
        )
    j, i = (index.ravel() for index in np.mgrid[0:count, 0:count])
    corners = np.stack([i, j, np.zeros_like(i)], -1)
    vertices, normals = [], []
    for radius, frame, middle in zip((lying, standing, standing), _FRAMES, _MIDDLES, strict=True):
        ring, normal = torus(radius, 0.5 * wire, segments, sides, middle, frame)
        vertices.append((corners[:, None] + ring).reshape(-1, 3) / count)
        normals.append(np.tile(normal, (len(corners), 1)))
    rings = np.concatenate(vertices)
    rings[:, 2] -= rings[:, 2].max()
    faces = repeated(torus_faces(segments, sides), segments * sides, 3 * count**2)
    metal = {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": float(roughness)}
    ground = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["base_colour"]}}
    plane = square_below(rings[:, 2].min() - gap / count, ground)
    return Mesostructure(
        "mail", parameters, (Part(rings, faces, metal, normals=np.concatenate(normals)), plane)
    )


def clearance(lying: float, standing: float) -> float:
    """Smallest distance of the axes of two rings, in sides of a cell.

    Parameters
    ----------
    lying, standing : float
        Radii.

    Returns
    -------
    float
    """
    around = 2 * np.pi * np.arange(192)[:, None] / 192
    axes = [
        middle + radius * (np.cos(around) * np.array(frame[0]) + np.sin(around) * np.array(frame[1]))
        for radius, frame, middle in zip((lying, standing, standing), _FRAMES, _MIDDLES, strict=True)
    ]
    shifts = [np.array([x, y, 0]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    return min(
        float(np.linalg.norm(one[:, None] - (other + shift), axis=-1).min())
        for k, one in enumerate(axes)
        for m, other in enumerate(axes)
        for shift in shifts
        if k != m or shift.any()
    )
