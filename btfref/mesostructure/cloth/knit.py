"""Plain knit: courses of loops, each drawn through the one below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part, square_below
from btfref.mesostructure.checks import colour, number, whole
from btfref.mesostructure.cloth.yarns import fibre, round_tubes

if TYPE_CHECKING:
    from btfref.types import Facts

#: Smallest clearance between yarns as a share of their thickness: facets lie inside the round tube.
_CLEARANCE = 0.02


def knit(
    *,
    columns: int = 4,
    rows: int = 5,
    thickness: float = 0.21,
    lean: float = 0.24,
    loop: float = 0.875,
    depth: float = 0.2,
    segments: int = 48,
    sides: int = 16,
    yarn_colour: Sequence[float] = (0.62, 0.56, 0.44),
    roughness: float = 0.6,
    anisotropy: float = 0.4,
    sheen: float = 0.9,
    backing_colour: Sequence[float] = (0.03, 0.03, 0.035),
) -> Mesostructure:
    """Courses along x of the curve ``(t/2π + a sin 2t, h cos t, d cos 2t)``, one stitch for each turn of t.

    Parameters
    ----------
    columns, rows : int
        Stitches along x and courses along y, 2 to 32.
    thickness : float
        Of the yarn, in widths of a stitch.
    lean : float
        a, how far the loop's sides lean, in widths of a stitch.
    loop : float
        h, half of a loop's height, in distances of two courses; above 1/2 they are drawn through each other.
    depth : float
        d, half of a loop's depth, in widths of a stitch.
    segments, sides : int
        Quads along a stitch (a multiple of 8) and around the yarn (a multiple of 4).
    yarn_colour, backing_colour : sequence of 3 floats
        Linear RGB in [0, 1]; the backing is Lambertian.
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
    parameters: Facts = {
        "columns": whole("knit", "columns", columns, 2, 32),
        "rows": whole("knit", "rows", rows, 2, 32),
        "thickness": number("knit", "thickness", thickness, 0.01, 0.5),
        "lean": number("knit", "lean", lean, 0.0, 0.5),
        "loop": number("knit", "loop", loop, 0.1, 1.5),
        "depth": number("knit", "depth", depth, 0.01, 1.0),
        "segments": whole("knit", "segments", segments, 16, 256, 8),
        "sides": whole("knit", "sides", sides, 8, 128, 4),
        "yarn_colour": colour("knit", "yarn_colour", yarn_colour),
        "roughness": number("knit", "roughness", roughness, 0.01, 1.0),
        "anisotropy": number("knit", "anisotropy", anisotropy, 0.0, 1.0),
        "sheen": number("knit", "sheen", sheen, 0.0, 1.0),
        "backing_colour": colour("knit", "backing_colour", backing_colour),
    }
    spacing = columns / rows  # of two courses, in widths of a stitch
    shape = (lean, loop * spacing, depth)
    apart = clearance(*shape, spacing)
    if apart < (1 + _CLEARANCE) * thickness:
        raise InputError(
            "yarns would meet",
            field="thickness",
            got=thickness,
            expected=f"at most {apart / (1 + _CLEARANCE):.4g}, or loops of another shape",
        )
    n = columns * segments
    t = 2 * np.pi * (np.arange(n + 1) % n) / segments
    curve, tangent = stitch(t, *shape)
    # The last ring of vertices is the first one of the next tile.
    curve[:, 0] -= t / (2 * np.pi)
    curve[:, 0] += np.arange(n + 1) / segments
    axis = np.repeat(curve[None] / columns, rows, 0)
    axis[..., 1] += ((np.arange(rows) + 0.5) / rows)[:, None]
    radius = 0.5 * thickness / columns
    vertices, normals, uv, faces = round_tubes(axis, np.repeat(tangent[None], rows, 0), radius, sides)
    vertices[:, 2] -= vertices[:, 2].max()
    yarn = fibre(parameters["yarn_colour"], roughness, anisotropy, sheen)
    backing = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["backing_colour"]}}
    plane = square_below(vertices[:, 2].min() - 0.05 * radius, backing)
    return Mesostructure("knit", parameters, (Part(vertices, faces, yarn, normals=normals, uv=uv), plane))


def stitch(t: np.ndarray, lean: float, height: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of the yarn's axis and unit tangents, in widths of a stitch."""
    point = np.stack([t / (2 * np.pi) + lean * np.sin(2 * t), height * np.cos(t), depth * np.cos(2 * t)], -1)
    along = [1 / (2 * np.pi) + 2 * lean * np.cos(2 * t), -height * np.sin(t), -2 * depth * np.sin(2 * t)]
    tangent = np.stack(along, -1)
    return point, tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)


def clearance(lean: float, height: float, depth: float, spacing: float) -> float:
    """Smallest distance of a course's axis to those of the next two and to its own other stretches.

    Parameters
    ----------
    lean, height, depth : float
        Of `stitch`.
    spacing : float
        Of two courses.

    Returns
    -------
    float
        In widths of a stitch.
    """
    one = 192
    t = 2 * np.pi * np.arange(-2 * one, 3 * one) / one
    curve = stitch(t, lean, height, depth)[0]
    middle = slice(2 * one, 3 * one)
    apart = [np.linalg.norm(curve[middle, None] - curve - [0, k * spacing, 0], axis=-1).min() for k in (1, 2)]
    own = np.linalg.norm(curve[middle, None] - curve, axis=-1)
    # Nearer along the yarn than this is the bend itself.
    far = np.abs(t[middle, None] - t) > 0.45 * np.pi
    return float(min(*apart, own[far].min()))
