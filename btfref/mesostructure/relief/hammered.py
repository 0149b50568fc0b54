"""Hammered metal: round dents that meet in soft ridges, glossy."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure
from btfref.mesostructure.bodies.scattering import scattered
from btfref.mesostructure.checks import number, whole
from btfref.mesostructure.relief.surface import cell_distances, relief


def hammered(
    *,
    dents: int = 24,
    depth: float = 0.05,
    softness: float = 0.15,
    material: str = "Cu",
    roughness: float = 0.12,
    resolution: int = 160,
    seed: int = 2,
) -> Mesostructure:
    """A conductor with dents: the height is a soft minimum of the squared distances to their middles.

    ``h = −s log Σ exp(−d² / s)``: paraboloids, whose ridges are as soft as ``s`` says.

    Parameters
    ----------
    dents : int
        On the tile, 4 to 400.
    depth : float
        From the ridges' top to the deepest middle, tile units, (0, 0.5].
    softness : float
        s as a share of the area of a dent, [0.01, 1].
    material : str
        Conductor as named by Mitsuba, e.g. "Cu", "Au", "Al".
    roughness : float
        GGX α, [0.01, 1].
    resolution : int
        Quads along one side.
    seed : int
        Of the places.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    if not isinstance(material, str):
        raise InputError(
            "parameter of hammered", field="material", got=material, expected="a name such as Cu"
        )
    parameters = {
        "dents": whole("hammered", "dents", dents, 4, 400),
        "depth": number("hammered", "depth", depth, 1e-6, 0.5),
        "softness": number("hammered", "softness", softness, 0.01, 1.0),
        "material": material,
        "roughness": number("hammered", "roughness", roughness, 0.01, 1.0),
        "resolution": whole("hammered", "resolution", resolution, 8, 512),
        "seed": whole("hammered", "seed", seed, 0, 2**32 - 1),
    }
    square = cell_distances(resolution, scattered(np.random.default_rng(seed), dents))
    s = softness / dents
    nearest = square.min(-1, keepdims=True)
    height = nearest[..., 0] - s * np.log(np.exp((nearest - square) / s).sum(-1))
    height *= depth / np.ptp(height)
    bsdf = {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": float(roughness)}
    return relief("hammered", parameters, height, bsdf)
