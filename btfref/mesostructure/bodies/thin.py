"""Thin materials that let diffuse light through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.types import Facts


def thin(colour: Sequence[float], roughness: float, transmission: float) -> Facts:
    """Mitsuba's ``principledthin`` without specular transmission.

    Parameters
    ----------
    colour : sequence of 3 floats
    roughness : float
    transmission : float
        Diffuse, [0, 2].

    Returns
    -------
    dict
    """
    return {
        "type": "principledthin",
        "base_color": {"type": "rgb", "value": list(colour)},
        "roughness": float(roughness),
        "diff_trans": float(transmission),
        "spec_trans": 0.0,
        "eta": 1.5,
    }
