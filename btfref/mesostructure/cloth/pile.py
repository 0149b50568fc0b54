"""Pile: short fibres that stand on a ground and let light through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.bodies.scattering import distances, scattered
from btfref.mesostructure.bodies.shapes import fans, repeated
from btfref.mesostructure.bodies.thin import thin
from btfref.mesostructure.checks import colour, number, sweep_faces, whole

if TYPE_CHECKING:
    from btfref.types import Facts


def pile(
    *,
    fibres: int = 240,
    thickness: float = 0.022,
    length: float = 0.22,
    lean: float = 0.09,
    variation: float = 0.3,
    transmission: float = 0.9,
    fibre_colour: Sequence[float] = (0.60, 0.30, 0.16),
    ground_colour: Sequence[float] = (0.10, 0.05, 0.03),
    roughness: float = 0.5,
    segments: int = 8,
    sides: int = 8,
    seed: int = 5,
) -> Mesostructure:
    """Tapered fibres with round ends that lean along x, a little differently each, over a Lambertian ground.

    Horizontal sections are discs, whose middles move by at most what the nearest two leave room for; so no two fibres
    meet.

    Parameters
    ----------
    fibres : int
        On the tile, 4 to 2000.
    thickness : float
        Diameter at the foot, tile units.
    length : float
        Height of the longest, tile units.
    lean : float
        How far tips lie beside their feet, tile units, [0, 1].
    variation : float
        How much shorter the shortest are, as a share, [0, 0.9].
    transmission : float
        Diffuse transmission of Mitsuba's ``principledthin``, [0, 2]: 1 sends half of the diffuse light through.
    fibre_colour, ground_colour : sequence of 3 floats
        Linear RGB in [0, 1].
    roughness : float
        [0.01, 1].
    segments, sides : int
        Quads along a fibre and around it.
    seed : int
        Of places, lengths and directions.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or fibres that would meet.
    """
    parameters: Facts = {
        "fibres": whole("pile", "fibres", fibres, 4, 2000),
        "thickness": number("pile", "thickness", thickness, 1e-4, 0.2),
        "length": number("pile", "length", length, 1e-3, 2.0),
        "lean": number("pile", "lean", lean, 0.0, 1.0),
        "variation": number("pile", "variation", variation, 0.0, 0.9),
        "transmission": number("pile", "transmission", transmission, 0.0, 2.0),
        "fibre_colour": colour("pile", "fibre_colour", fibre_colour),
        "ground_colour": colour("pile", "ground_colour", ground_colour),
        "roughness": number("pile", "roughness", roughness, 0.01, 1.0),
        "segments": whole("pile", "segments", segments, 3, 64),
        "sides": whole("pile", "sides", sides, 4, 64),
        "seed": whole("pile", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    feet = scattered(rng, fibres)
    room = distances(feet).min() - 1.02 * thickness
    if room <= 0:
        raise InputError(
            "fibres would meet",
            field="thickness",
            got=thickness,
            expected=f"below {distances(feet).min() / 1.02:.4g}, or fewer fibres",
        )
    angle = 2 * np.pi * rng.random(fibres)
    # Each tip strays by less than half of what the nearest two leave free, and not so far that it would lie down.
    astray = (
        0.5
        * min(room, 0.15 * length)
        * np.sqrt(rng.random(fibres))[:, None]
        * np.stack([np.cos(angle), np.sin(angle)], -1)
    )
    tall = length * (1 - variation * rng.random(fibres))
    tall[0] = length
    vertices, normals = _fibres(feet, astray, tall, parameters)
    rings = segments + 1
    each = rings * sides + 2
    one = np.concatenate([sweep_faces(rings, sides)[:, ::-1], *fans(rings, sides)])
    faces = repeated(one, each, fibres)
    vertices[:, 2] -= vertices[:, 2].max()
    bsdf = thin(parameters["fibre_colour"], roughness, transmission)
    ground = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["ground_colour"]}}
    plane = square_below(vertices[:, 2].min() - 0.02 * length, ground)
    return Mesostructure("pile", parameters, (Part(vertices, faces, bsdf, normals=normals), plane))


def _fibres(
    feet: np.ndarray, astray: np.ndarray, tall: np.ndarray, parameters: Facts
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals: rings from the foot to the tip, then the ends' middles."""
    segments, sides = parameters["segments"], parameters["sides"]
    height = np.sin(0.5 * np.pi * np.arange(segments + 1) / segments)  # closer near the tip
    # The bend follows the height itself, not the share of a fibre's own length: fibres stay side by side.
    z = height * tall[:, None]
    share = (z / parameters["length"]) ** 2
    middle = feet[:, None] + share[..., None] * (astray[:, None] + np.array([parameters["lean"], 0.0]))
    radius = 0.5 * parameters["thickness"] * np.sqrt(np.maximum(1 - 0.97 * height**2, 0))
    around = 2 * np.pi * np.arange(sides) / sides
    out = np.stack([np.cos(around), np.sin(around)], -1)
    ring = middle[:, :, None] + radius[:, None, None] * out
    body = np.concatenate([ring, np.broadcast_to(z[:, :, None, None], (*ring.shape[:3], 1))], -1)
    ends = np.concatenate([middle[:, [0, -1]], z[:, [0, -1], None]], -1)
    count = len(feet)
    vertices = np.concatenate([body.reshape(count, -1, 3), ends], 1)
    # Normals of a sheared disc stack: horizontal outward, tilted so that they are perpendicular to the slope.
    slope = np.gradient(middle, axis=1) / np.maximum(np.gradient(z, axis=1), 1e-9)[..., None]
    taper = np.gradient(radius) / np.maximum(np.gradient(z, axis=1), 1e-9)
    up = -(np.einsum("crx,sx->crs", slope, out) + taper[..., None])
    up[:, 0] = np.minimum(up[:, 0], -0.01)  # around the foot's own face, which looks down
    side = np.broadcast_to(out, (*up.shape, 2))
    normals = np.concatenate([side, up[..., None]], -1)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    poles = np.broadcast_to(np.array([[0, 0, -1.0], [0, 0, 1.0]]), (count, 2, 3))
    normals = np.concatenate([normals.reshape(count, -1, 3), poles], 1)
    return vertices.reshape(-1, 3), normals.reshape(-1, 3)
