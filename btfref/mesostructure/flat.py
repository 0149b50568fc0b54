"""A flat tile: the mesostructure whose BTF is known in closed form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, square_below

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.types import Facts


def flat(*, reflectance: ArrayLike = 0.5, bsdf: Facts | None = None) -> Mesostructure:
    """A plane at z = 0.

    Parameters
    ----------
    reflectance : float or sequence of 3 floats
        Lambertian albedo ρ in [0, 1], linear RGB: B = ρ/π · cos θ_light.
    bsdf : dict, optional
        Any Mitsuba BSDF (JSON types) in place of the Lambertian one.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        Reflectance outside [0, 1].
    """
    rho = (
        np.broadcast_to(np.asarray(reflectance, dtype=np.float64), 3)
        if np.size(reflectance) in (1, 3)
        else None
    )
    if rho is None or not ((rho >= 0) & (rho <= 1)).all():
        raise InputError(
            "albedo of the flat tile",
            field="reflectance",
            got=reflectance,
            expected="1 or 3 values in [0, 1]",
        )
    colour = [float(value) for value in rho]
    material = bsdf or {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
    parameters = {"reflectance": colour, "bsdf": bsdf}
    return Mesostructure("flat", parameters, (square_below(0.0, material),))
