"""A periodic grid of heights as a part, and the random heights that several reliefs share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.checks import grid_faces

if TYPE_CHECKING:
    from btfref.types import Facts


def relief_part(height: np.ndarray, bsdf: Facts) -> Part:
    """A height field of n × n quads whose highest point touches z = 0.

    Parameters
    ----------
    height : ndarray (n, n)
        At the grid's corners, row along y, tile units; the row after the last is the first again.
    bsdf : dict

    Returns
    -------
    Part
        Shading normals are those of central differences, so that they close over the seam as well.
    """
    n = len(height)
    height = height - height.max()
    slope_x, slope_y = (0.5 * n * (np.roll(height, -1, axis) - np.roll(height, 1, axis)) for axis in (1, 0))
    closed = [np.pad(values, ((0, 1), (0, 1)), "wrap") for values in (height, slope_x, slope_y)]
    line = np.arange(n + 1) / n
    x, y = np.meshgrid(line, line)
    vertices = np.stack([x, y, closed[0]], -1).reshape(-1, 3)
    normals = np.stack([-closed[1], -closed[2], np.ones_like(x)], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Part(vertices, np.concatenate(grid_faces(n, n)), bsdf, normals=normals)


def relief(name: str, parameters: Facts, height: np.ndarray, bsdf: Facts) -> Mesostructure:
    """A mesostructure of a single height field; see `relief_part`."""
    return Mesostructure(name, parameters, (relief_part(height, bsdf),))


def random_waves(
    rng: np.random.Generator, n: int, lowest: float, highest: float, slope: float, stretch: float = 1.0
) -> np.ndarray:
    """A Gaussian random field of unit variance on a periodic grid.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Samples along a side.
    lowest, highest : float
        Waves along the tile's side, inclusive: what is between has a power of |k|^(−2·slope).
    slope : float
    stretch : float
        How many times longer waves are along x than along y.

    Returns
    -------
    ndarray (n, n)
    """
    # Amplitudes of all waves that any grid has, in an order that no grid changes: a finer grid shows the same field.
    reach = int(np.ceil(highest))
    k = np.arange(-reach, reach + 1)
    kx, ky = np.meshgrid(k, np.arange(reach + 1))
    size = np.hypot(stretch * kx, ky)
    # Half of the waves of the row k_y = 0 repeat the other half.
    wanted = (size >= lowest) & (size <= highest) & ((ky > 0) | (kx > 0))
    phase = np.exp(2j * np.pi * rng.random(size.shape))
    amplitude = np.where(wanted, np.maximum(size, 1e-9) ** -slope, 0) * phase
    amplitude *= np.sqrt(2 / (np.abs(amplitude) ** 2).sum())
    line = np.arange(n) / n
    along = np.exp(2j * np.pi * np.outer(k, line))
    across = np.exp(2j * np.pi * np.outer(np.arange(reach + 1), line))
    return (across.T @ (amplitude @ along)).real


def cell_distances(n: int, centres: np.ndarray) -> np.ndarray:
    """Squared distances of the points of a periodic grid to all centres.

    Parameters
    ----------
    n : int
    centres : ndarray (m, 2)

    Returns
    -------
    ndarray (n, n, m)
        The shortest over the copies of a centre.
    """
    line = np.arange(n) / n
    x, y = ((line[:, None] - centres[:, axis] + 0.5) % 1 - 0.5 for axis in (0, 1))
    return x[None, :, :] ** 2 + y[:, None, :] ** 2
