"""Leather: rounded cells with creases between them, under a soft gloss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from btfref.mesostructure.base import Mesostructure
from btfref.mesostructure.bodies.scattering import scattered
from btfref.mesostructure.checks import colour, number, whole
from btfref.mesostructure.relief.surface import cell_distances, random_waves, relief


def leather(
    *,
    cells: int = 60,
    amplitude: float = 0.05,
    crease: float = 0.35,
    grain: float = 0.08,
    albedo: Sequence[float] = (0.30, 0.11, 0.045),
    roughness: float = 0.28,
    resolution: int = 160,
    seed: int = 4,
) -> Mesostructure:
    """Cells around random places: the height rises with the distance from the border to the next cell, and saturates.

    ``h = A (1 − exp(−(d₂ − d₁) / (c w)))`` with d₁ and d₂ the distances to the nearest two middles and w = 1/√cells,
    after the cellular texture of Worley (1996).

    Parameters
    ----------
    cells : int
        On the tile, 4 to 400.
    amplitude : float
        A, depth of the creases in tile units, (0, 0.5].
    crease : float
        c, their width as a share of a cell's, [0.05, 2].
    grain : float
        Height of the fine waves on the cells as a share of A, [0, 1].
    albedo : sequence of 3 floats
        Diffuse, linear RGB in [0, 1].
    roughness : float
        GGX α, [0.01, 1].
    resolution : int
        Quads along one side.
    seed : int
        Of the places and the waves.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    parameters = {
        "cells": whole("leather", "cells", cells, 4, 400),
        "amplitude": number("leather", "amplitude", amplitude, 1e-6, 0.5),
        "crease": number("leather", "crease", crease, 0.05, 2.0),
        "grain": number("leather", "grain", grain, 0.0, 1.0),
        "albedo": colour("leather", "albedo", albedo),
        "roughness": number("leather", "roughness", roughness, 0.01, 1.0),
        "resolution": whole("leather", "resolution", resolution, 8, 512),
        "seed": whole("leather", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    square = np.partition(cell_distances(resolution, scattered(rng, cells)), 1, axis=-1)
    border = np.sqrt(square[..., 1]) - np.sqrt(square[..., 0])
    height = 1 - np.exp(-border * np.sqrt(cells) / crease)
    height += 0.5 * grain * random_waves(rng, resolution, 12, 40, 0.8)
    height *= amplitude / np.ptp(height)
    bsdf = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": float(roughness),
        "diffuse_reflectance": {"type": "rgb", "value": parameters["albedo"]},
    }
    return relief("leather", parameters, height, bsdf)
