"""Rough plaster: a dull random height field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.base import Mesostructure
from btfref.mesostructure.checks import colour, number, whole
from btfref.mesostructure.relief.surface import random_waves, relief

if TYPE_CHECKING:
    from btfref.types import Facts


def plaster(
    *,
    amplitude: float = 0.12,
    lowest: int = 2,
    highest: int = 20,
    slope: float = 1.6,
    albedo: Sequence[float] = (0.72, 0.64, 0.52),
    resolution: int = 128,
    seed: int = 1,
) -> Mesostructure:
    """A Lambertian random surface with waves of a band of lengths.

    Parameters
    ----------
    amplitude : float
        Depth from the top to the bottom, tile units, (0, 1].
    lowest, highest : int
        Waves along the tile's side.
    slope : float
        How fast waves get lower as they get shorter, [0, 4].
    albedo : sequence of 3 floats
        Linear RGB in [0, 1].
    resolution : int
        Quads along one side.
    seed : int
        Of the random waves.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A value out of range.
    """
    parameters: Facts = {
        "amplitude": number("plaster", "amplitude", amplitude, 1e-6, 1.0),
        "lowest": whole("plaster", "lowest", lowest, 1, 64),
        "highest": whole("plaster", "highest", highest, lowest, 64),
        "slope": number("plaster", "slope", slope, 0.0, 4.0),
        "albedo": colour("plaster", "albedo", albedo),
        "resolution": whole("plaster", "resolution", resolution, 8, 2048),
        "seed": whole("plaster", "seed", seed, 0, 2**32 - 1),
    }
    rng = np.random.default_rng(parameters["seed"])
    height = random_waves(rng, parameters["resolution"], lowest, highest, slope)
    height *= amplitude / np.ptp(height)
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": parameters["albedo"]}}
    return relief("plaster", parameters, height, bsdf)
