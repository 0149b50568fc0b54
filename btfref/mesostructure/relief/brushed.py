"""Brushed metal: long shallow grooves along x on an anisotropic conductor."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure
from btfref.mesostructure.checks import number, whole
from btfref.mesostructure.relief.surface import random_waves, relief


def brushed(
    *,
    depth: float = 0.006,
    grooves: int = 40,
    length: float = 12.0,
    material: str = "Al",
    along: float = 0.08,
    across: float = 0.3,
    resolution: int = 192,
    seed: int = 3,
) -> Mesostructure:
    """A conductor whose microfacets are narrow along x and wide across, on grooves that run along x.

    Parameters
    ----------
    depth : float
        Of the grooves, tile units, (0, 0.1].
    grooves : int
        The finest of them along the tile's side, 4 to 64.
    length : float
        How many times longer than wide a groove is, [1, 64].
    material : str
        Conductor as named by Mitsuba.
    along, across : float
        GGX α along x and along y, [0.01, 1].
    resolution : int
        Quads along one side.
    seed : int
        Of the grooves.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    if not isinstance(material, str):
        raise InputError("parameter of brushed", field="material", got=material, expected="a name such as Al")
    parameters = {
        "depth": number("brushed", "depth", depth, 1e-6, 0.1),
        "grooves": whole("brushed", "grooves", grooves, 4, 64),
        "length": number("brushed", "length", length, 1.0, 64.0),
        "material": material,
        "along": number("brushed", "along", along, 0.01, 1.0),
        "across": number("brushed", "across", across, 0.01, 1.0),
        "resolution": whole("brushed", "resolution", resolution, 8, 2048),
        "seed": whole("brushed", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(seed)
    height = random_waves(rng, resolution, 2, grooves, 0.6, stretch=length)
    height *= depth / np.ptp(height)
    bsdf = {
        "type": "roughconductor",
        "material": material,
        "distribution": "ggx",
        "alpha_u": float(along),
        "alpha_v": float(across),
    }
    return relief("brushed", parameters, height, bsdf)
