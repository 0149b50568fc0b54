"""A smoothed checker height field: raised pink glossy squares on low blue ones.

After the checker of Suykens, vom Berge, Lagae, Dutré, *Interactive rendering with bidirectional texture
functions* (Eurographics 2003); its dimensions are not given there, those here are our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.checks import colour as check_colour
from btfref.mesostructure.checks import grid_faces, number

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.types import Facts


def checker_height(
    x: ArrayLike, y: ArrayLike, *, cells: int, amplitude: float, smoothness: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height of the checker and its slope, in tile units.

    ``h = A/2 · (tanh(g/s) / tanh(1/s) − 1)`` with ``g = sin(π c x) sin(π c y)``: a checker for s → 0, an egg
    box for s → ∞, −A in the middle of a low square and 0 in the middle of a raised one.

    Parameters
    ----------
    x, y : array_like
        Tile coordinates, any real; period 1 for even ``cells``.
    cells : int
        Squares along one side.
    amplitude : float
        A, depth from the top to the bottom.
    smoothness : float
        s > 0, width of the slope.

    Returns
    -------
    height, slope_x, slope_y : ndarray
        Height in [−A, 0] and its two derivatives.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    k = np.pi * cells
    # Reduced to one period first, so that x and x + 1 give the very same bits: the tile closes exactly.
    sx, cx = np.sin(k * (x - np.floor(x))), np.cos(k * (x - np.floor(x)))
    sy, cy = np.sin(k * (y - np.floor(y))), np.cos(k * (y - np.floor(y)))
    g = sx * sy / smoothness
    scale = 0.5 * amplitude / np.tanh(1.0 / smoothness)
    height = np.minimum(scale * np.tanh(g) - 0.5 * amplitude, 0.0)
    slope = scale * k / smoothness / np.cosh(g) ** 2
    return height, slope * cx * sy, slope * sx * cy


def _plastic(colour: Sequence[float], roughness: float) -> Facts:
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": float(roughness),
        "diffuse_reflectance": {"type": "rgb", "value": [float(value) for value in colour]},
    }


def checker(
    *,
    cells: int = 2,
    amplitude: float = 0.15,
    smoothness: float = 0.35,
    resolution: int = 128,
    raised_colour: Sequence[float] = (0.80, 0.25, 0.42),
    low_colour: Sequence[float] = (0.06, 0.13, 0.48),
    raised_roughness: float = 0.1,
    low_roughness: float = 0.4,
) -> Mesostructure:
    """The checker: pink, more specular squares rise above blue, rougher ones.

    The material changes at half height, in the middle of the slope, along straight lines x, y = i/cells.

    Parameters
    ----------
    cells : int
        Squares along one side of the tile, even.
    amplitude : float
        Depth in tile units, (0, 1].
    smoothness : float
        Width of the slopes, [0.05, 10]: small is steep.
    resolution : int
        Quads along one side, a multiple of 2·cells (then the highest points are vertices).
    raised_colour, low_colour : sequence of 3 floats
        Diffuse albedos, linear RGB in [0, 1].
    raised_roughness, low_roughness : float
        GGX α in [0.01, 1].

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    if cells != int(cells) or not 2 <= cells <= 64 or cells % 2:
        raise InputError(
            "parameter of the checker", field="cells", got=cells, expected="an even number in [2, 64]"
        )
    if resolution != int(resolution) or resolution <= 0 or resolution > 2048 or resolution % (2 * cells):
        raise InputError(
            "parameter of the checker",
            field="resolution",
            got=resolution,
            expected=f"a multiple of {2 * int(cells)}, at most 2048",
        )
    number("the checker", "amplitude", amplitude, 1e-6, 1.0)
    number("the checker", "smoothness", smoothness, 0.05, 10.0)
    for name, roughness in (("raised_roughness", raised_roughness), ("low_roughness", low_roughness)):
        number("the checker", name, roughness, 0.01, 1.0)
    for name, colour in (("raised_colour", raised_colour), ("low_colour", low_colour)):
        check_colour("the checker", name, colour)

    n, cells = int(resolution), int(cells)
    line = np.arange(n + 1) / n
    x, y = np.meshgrid(line, line)
    height, slope_x, slope_y = checker_height(x, y, cells=cells, amplitude=amplitude, smoothness=smoothness)
    vertices = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    row, column = (index.ravel() for index in np.mgrid[0:n, 0:n])
    first, second = grid_faces(n, n)
    # Material borders are grid lines, so a quad's centre says which square all of it belongs to.
    raised = (column * cells // n + row * cells // n) % 2 == 0

    def part(mask: np.ndarray, bsdf: Facts) -> Part:
        faces = np.concatenate([first[mask], second[mask]])
        used, faces = np.unique(faces, return_inverse=True)
        return Part(vertices[used], faces.reshape(-1, 3), bsdf, normals=normals[used])

    parameters = {
        "cells": cells,
        "amplitude": float(amplitude),
        "smoothness": float(smoothness),
        "resolution": n,
        "raised_colour": [float(value) for value in raised_colour],
        "low_colour": [float(value) for value in low_colour],
        "raised_roughness": float(raised_roughness),
        "low_roughness": float(low_roughness),
    }
    parts = (
        part(raised, _plastic(raised_colour, raised_roughness)),
        part(~raised, _plastic(low_colour, low_roughness)),
    )
    return Mesostructure("checker", parameters, parts)
