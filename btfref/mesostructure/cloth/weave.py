"""Weaves whose yarns float over several others: twill and satin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.checks import colour, number, whole
from btfref.mesostructure.cloth.yarns import fibre, upright_tubes

if TYPE_CHECKING:
    from btfref.types import Facts

#: Smallest clearance between two yarns, in half thicknesses: far above what facets take off.
CLEARANCE = 0.02

#: Turns warp into weft: mirrored in the plane x = y, and turned over.
_TURN = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float64)


def twill(
    *,
    count: int = 8,
    width: float = 0.82,
    thickness: float = 0.045,
    amplitude: float = 0.03,
    segments: int = 12,
    sides: int = 16,
    warp_colour: Sequence[float] = (0.045, 0.07, 0.19),
    weft_colour: Sequence[float] = (0.55, 0.56, 0.58),
    roughness: float = 0.5,
    anisotropy: float = 0.5,
    sheen: float = 0.8,
    backing_colour: Sequence[float] = (0.03, 0.03, 0.035),
) -> Mesostructure:
    """A 2/2 twill: each warp yarn goes over two and under two, one further than its neighbour.

    Parameters
    ----------
    count : int
        Yarns of each kind in the tile, a multiple of 4.
    width : float
        Width of a yarn as a share of the pitch, (0, 0.95].
    thickness : float
        Thickness of a yarn in tile units.
    amplitude : float
        Height of the waves in tile units; above half the thickness.
    segments, sides : int
        Quads along a yarn from one crossing to the next, even, and around it, a multiple of 4.
    warp_colour, weft_colour, backing_colour : sequence of 3 floats
        Base colours, linear RGB in [0, 1]; the backing is Lambertian.
    roughness, anisotropy, sheen : float
        Of Mitsuba's ``principled``, in [0, 1]; fibres run along the yarn.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or yarns that would meet.
    """
    given = dict(locals())
    count = whole("twill", "count", count, 4, 64, 4)
    warp, weft = np.mgrid[0:count, 0:count]
    return _woven("twill", (warp - weft) % 4 < 2, given)


def satin(
    *,
    count: int = 10,
    width: float = 0.88,
    thickness: float = 0.03,
    amplitude: float = 0.025,
    segments: int = 12,
    sides: int = 16,
    warp_colour: Sequence[float] = (0.50, 0.035, 0.09),
    weft_colour: Sequence[float] = (0.30, 0.02, 0.06),
    roughness: float = 0.28,
    anisotropy: float = 0.85,
    sheen: float = 0.2,
    backing_colour: Sequence[float] = (0.03, 0.03, 0.035),
) -> Mesostructure:
    """A warp-faced satin of five: each warp yarn goes over four and under one, no two of these are neighbours.

    Parameters
    ----------
    count : int
        Yarns of each kind in the tile, a multiple of 5.
    width : float
        Width of a yarn as a share of the pitch, (0, 0.95].
    thickness : float
        Thickness of a yarn in tile units.
    amplitude : float
        Height of the waves in tile units; above half the thickness.
    segments, sides : int
        Quads along a yarn from one crossing to the next, even, and around it, a multiple of 4.
    warp_colour, weft_colour, backing_colour : sequence of 3 floats
        Base colours, linear RGB in [0, 1]; the backing is Lambertian.
    roughness, anisotropy, sheen : float
        Of Mitsuba's ``principled``, in [0, 1]; fibres run along the yarn.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range, or yarns that would meet.
    """
    given = dict(locals())
    count = whole("satin", "count", count, 5, 60, 5)
    warp, weft = np.mgrid[0:count, 0:count]
    return _woven("satin", (weft - 2 * warp) % 5 != 0, given)


def crossing_heights(over: np.ndarray, amplitude: float, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights of the axes of yarns along x, and their slopes.

    From one crossing to the next a half wave of a cosine where the side changes, flat where it does not; so two yarns
    that cross are nowhere nearer than in a plain weave.

    Parameters
    ----------
    over : ndarray (count, count) of bool
        Whether the yarn (row) is up at a crossing (column), which lie at x = (j + ½)/count.
    amplitude : float
    segments : int
        From one crossing to the next, even.

    Returns
    -------
    height, slope : ndarray (count, count · segments + 1)
    """
    count = over.shape[1]
    n = count * segments
    # The last is the first of the next tile, bit for bit.
    place = np.arange(n + 1) % n
    # Crossings lie half a pitch into the tile.
    before, step = np.divmod(place - segments // 2, segments)
    side = np.where(over, amplitude, -amplitude)
    here, there = side[:, before % count], side[:, (before + 1) % count]
    phase = np.pi * step / segments
    height = 0.5 * (here + there) + 0.5 * (here - there) * np.cos(phase)
    return height, -0.5 * np.pi * count * (here - there) * np.sin(phase)


def _woven(name: str, over: np.ndarray, given: Facts) -> Mesostructure:
    """A weave in which warp yarns (along x, rows) are over weft yarns where `over` says so."""
    parameters: Facts = {
        "count": len(over),
        "width": number(name, "width", given["width"], 0.05, 0.95),
        "thickness": number(name, "thickness", given["thickness"], 1e-4, 0.5),
        "amplitude": number(name, "amplitude", given["amplitude"], 1e-4, 0.5),
        "segments": whole(name, "segments", given["segments"], 4, 128, 2),
        "sides": whole(name, "sides", given["sides"], 8, 256, 4),
        "warp_colour": colour(name, "warp_colour", given["warp_colour"]),
        "weft_colour": colour(name, "weft_colour", given["weft_colour"]),
        "roughness": number(name, "roughness", given["roughness"], 0.01, 1.0),
        "anisotropy": number(name, "anisotropy", given["anisotropy"], 0.0, 1.0),
        "sheen": number(name, "sheen", given["sheen"], 0.0, 1.0),
        "backing_colour": colour(name, "backing_colour", given["backing_colour"]),
    }
    count, width, thickness, amplitude = (
        len(over),
        *(parameters[k] for k in ("width", "thickness", "amplitude")),
    )
    refuse_meeting(width, thickness, amplitude)
    look = [parameters[key] for key in ("roughness", "anisotropy", "sheen")]
    y = (np.arange(count) + 0.5) / count
    parts = []
    # A weft yarn, turned, is up where the warp is: it is made turned over.
    for up, base in ((over, "warp_colour"), (over.T, "weft_colour")):
        made = crossing_heights(up, amplitude, parameters["segments"])
        vertices, normals, uv, faces = upright_tubes(
            *made, y, 0.5 * width / count, 0.5 * thickness, parameters["sides"]
        )
        if base == "weft_colour":
            vertices, normals = vertices @ _TURN.T, normals @ _TURN.T
        parts.append(Part(vertices, faces, fibre(parameters[base], *look), normals=normals, uv=uv))
    top = max(part.vertices[:, 2].max() for part in parts)
    low = min(part.vertices[:, 2].min() for part in parts) - top - 0.05 * thickness
    backing = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["backing_colour"]}}
    moved = [
        Part(part.vertices - [0, 0, top], part.faces, part.bsdf, normals=part.normals, uv=part.uv)
        for part in parts
    ]
    return Mesostructure(name, parameters, (*moved, square_below(low, backing)))


def refuse_meeting(width: float, thickness: float, amplitude: float) -> None:
    """InputError where warp and weft of a weave would meet.

    They are apart where ``A (cos(πξ/p) + cos(πη/p)) > t (√(1 − ξ²/w²) + √(1 − η²/w²))`` on the whole crossing; each
    term is checked on its own, which suffices.

    Parameters
    ----------
    width : float
        As a share of the pitch.
    thickness, amplitude : float
    """
    across = np.linspace(0.0, 1.0, 1025)
    rest = 2 * amplitude / thickness * np.cos(0.5 * np.pi * width * across) - np.sqrt(1 - across**2)
    if rest.min() < CLEARANCE:
        raise InputError(
            "yarns would meet",
            field="amplitude",
            got=amplitude,
            expected="a larger one, or narrower or thinner yarns",
        )
