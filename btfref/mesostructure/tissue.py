"""A plain weave: warp and weft yarns that cross over and under each other.

After the tissue of Suykens, vom Berge, Lagae, Dutré, *Interactive rendering with bidirectional texture
functions* (Eurographics 2003); its dimensions are not given there, those here are our own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.checks import colour, number, whole
from btfref.mesostructure.cloth.weave import refuse_meeting
from btfref.mesostructure.cloth.yarns import fibre, upright_tubes


def tissue(
    *,
    count: int = 4,
    width: float = 0.8,
    thickness: float = 0.08,
    amplitude: float = 0.05,
    segments: int = 96,
    sides: int = 20,
    warp_colour: Sequence[float] = (0.62, 0.10, 0.08),
    weft_colour: Sequence[float] = (0.75, 0.62, 0.40),
    roughness: float = 0.45,
    anisotropy: float = 0.7,
    sheen: float = 0.6,
    backing_colour: Sequence[float] | None = (0.03, 0.03, 0.035),
) -> Mesostructure:
    """Warp along x, weft along y, each an elliptic tube whose axis follows a cosine.

    With pitch p = 1/count, half width w and half thickness t, warp and weft are apart where
    ``A (cos(πξ/p) + cos(πη/p)) > t (√(1 − ξ²/w²) + √(1 − η²/w²))`` on the whole crossing |ξ|, |η| ≤ w; each
    term is checked on its own, which suffices.

    Parameters
    ----------
    count : int
        Yarns of each kind in the tile, even.
    width : float
        Width of a yarn as a share of the pitch, (0, 0.95].
    thickness : float
        Thickness of a yarn in tile units.
    amplitude : float
        A, height of the waves in tile units; above half the thickness.
    segments, sides : int
        Quads along a yarn (a multiple of 2·count) and around it (a multiple of 4).
    warp_colour, weft_colour : sequence of 3 floats
        Base colours, linear RGB in [0, 1].
    roughness, anisotropy, sheen : float
        Of Mitsuba's ``principled``, in [0, 1]; fibres run along the yarn.
    backing_colour : sequence of 3 floats, or None
        Lambertian plane under the cloth, seen through its holes; None leaves the holes open (black).

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or yarns that would meet.
    """
    count = whole("tissue", "count", count, 2, 64, 2)
    width = number("tissue", "width", width, 0.05, 0.95)
    thickness = number("tissue", "thickness", thickness, 1e-4, 0.5)
    amplitude = number("tissue", "amplitude", amplitude, 1e-4, 0.5)
    segments = whole("tissue", "segments", segments, 4 * count, 8192, 2 * count)
    sides = whole("tissue", "sides", sides, 8, 1024, 4)
    roughness = number("tissue", "roughness", roughness, 0.01, 1.0)
    anisotropy = number("tissue", "anisotropy", anisotropy, 0.0, 1.0)
    sheen = number("tissue", "sheen", sheen, 0.0, 1.0)
    warp_colour = colour("tissue", "warp_colour", warp_colour)
    weft_colour = colour("tissue", "weft_colour", weft_colour)
    if backing_colour is not None:
        backing_colour = colour("tissue", "backing_colour", backing_colour)

    refuse_meeting(width, thickness, amplitude)
    look = roughness, anisotropy, sheen
    warp = _yarns(count, width, thickness, amplitude, segments, sides)
    vertices, normals, uv, faces = warp
    # Mirrored in the plane x = y, and turned over: where the warp is up, the weft is down.
    turn = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float64)
    parts = [
        Part(vertices, faces, fibre(warp_colour, *look), normals=normals, uv=uv),
        Part(vertices @ turn.T, faces, fibre(weft_colour, *look), normals=normals @ turn.T, uv=uv),
    ]
    top = max(part.vertices[:, 2].max() for part in parts)
    parts = [
        Part(part.vertices - [0, 0, top], part.faces, part.bsdf, normals=part.normals, uv=part.uv)
        for part in parts
    ]
    if backing_colour is not None:
        low = min(part.vertices[:, 2].min() for part in parts) - 0.05 * thickness
        cloth = {"type": "diffuse", "reflectance": {"type": "rgb", "value": backing_colour}}
        parts.append(square_below(low, cloth))
    parameters = {
        "count": count,
        "width": width,
        "thickness": thickness,
        "amplitude": amplitude,
        "segments": segments,
        "sides": sides,
        "warp_colour": warp_colour,
        "weft_colour": weft_colour,
        "roughness": roughness,
        "anisotropy": anisotropy,
        "sheen": sheen,
        "backing_colour": backing_colour,
    }
    return Mesostructure("tissue", parameters, tuple(parts))


def _yarns(
    count: int, width: float, thickness: float, amplitude: float, segments: int, sides: int
) -> tuple[np.ndarray, ...]:
    """Warp yarns: vertices, normals, texture coordinates (u along the yarn) and faces, z around 0."""
    # The last ring of vertices is the first one of the next tile, bit for bit.
    phase = np.pi * count * (np.arange(segments + 1) % segments) / segments
    sign = np.where(np.arange(count) % 2 == 0, 1, -1)[:, None]
    # Extremes at the crossings x = (j + 1/2)/count: a sine of that phase.
    height = sign * amplitude * np.sin(phase)
    slope = sign * amplitude * np.pi * count * np.cos(phase)
    y = (np.arange(count) + 0.5) / count
    return upright_tubes(height, slope, y, 0.5 * width / count, 0.5 * thickness, sides)
