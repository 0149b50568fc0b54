"""A picture of a material: one tile from above and from the side, under two lights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.datasets.sets import MAP_SEED, MAX_DEPTH
from btfref.datasets.truth import centres
from btfref.numerics.sphere.directions import spherical
from btfref.querying.paths import PathSource
from btfref.querying.settings import QuerySettings
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure

#: Polar angle and azimuth of view and light of each picture, degrees.
SHOWN = (((0, 0), (35, 135)), ((0, 0), (65, 20)), ((55, 270), (40, 60)))

#: Pixels along a side of each, samples of a pixel, and what B is multiplied by: a white diffuse plane is bright.
SIDE, SPP, EXPOSURE = 128, 24, 0.85 * np.pi


def picture(mesostructure: Mesostructure, variant: str) -> np.ndarray:
    """Pictures side by side.

    Parameters
    ----------
    mesostructure : Mesostructure
    variant : str
        Of Mitsuba.

    Returns
    -------
    ndarray, uint8 (SIDE, 3 · SIDE, 3)
        sRGB, rows from the top: v grows upwards.
    """
    from btfref.numerics.colour import encode_srgb

    settings = QuerySettings(
        n=1, spp=SPP, seed=MAP_SEED, max_depth=MAX_DEPTH, footprint="square", variant=variant
    )
    uv = centres(SIDE)
    shown = []
    with mitsuba_variant(variant):
        source = PathSource(mesostructure, settings)
        for view, light in SHOWN:
            w_view, w_light = (spherical(*np.radians(pair)) for pair in (view, light))
            rows = {
                "uv": uv,
                "radius": np.full(len(uv), 0.5 / SIDE),
                "w_view": np.broadcast_to(w_view, (len(uv), 3)),
                "w_light": np.broadcast_to(w_light, (len(uv), 3)),
            }
            rows = {key: np.ascontiguousarray(value, np.float32) for key, value in rows.items()}
            found = source.paths.samples(rows, np.arange(len(uv)), SPP)[0].reshape(SIDE, SIDE, 3)
            # Of a sun that stands low there is less: all pictures are as bright as if it stood high.
            shown.append(found[::-1] * EXPOSURE / w_light[2])
    pixels = encode_srgb(np.clip(np.concatenate(shown, 1), 0, 1))
    return np.rint(255 * pixels).astype(np.uint8)
