"""Bonn SPECTRAL: one OpenEXR picture per pair, ``tv045.0_pv020.0_tl015.0_pl120.0.exr``, its channels wavelengths.

The owners' reader takes the values without the light's cosine (their cosine flag is off): B = value · cos θ_light.
Reflectance becomes linear Rec. 709 under D65: `btfref.numerics.colour.spectral_weights`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache

import numpy as np

from btfref.errors import InputError
from btfref.formats.image_sets.reader import opener, pick, recogniser
from btfref.formats.source import Format
from btfref.numerics.colour import spectral_weights
from btfref.types import PathLike

_WAVELENGTH = re.compile(r"(?:[a-zA-Z]*[._])?(\d{3,4}(?:[.,]\d+)?) ?(?:nm)?")


def wavelengths(names: Sequence[str], where: PathLike | None) -> list[float]:
    """Wavelengths in nm of channel names such as "550", "550.0nm" or "S0.550,0nm".

    Raises
    ------
    InputError
        A name that is none, one beyond 300 to 1100 nm, or one twice.
    """
    matches = (_WAVELENGTH.fullmatch(re.sub(r"^S\d\.", "", name.strip())) for name in names)
    found = [match for match in matches if match]
    if not names or len(found) < len(names):
        raise InputError(
            "channels are no wavelengths",
            file=where,
            field="channels",
            got=", ".join(names)[:200],
            expected="names such as 550 or 550nm",
        )
    result = [float(match[1].replace(",", ".")) for match in found]
    if len(set(result)) < len(result) or not all(300 <= nm <= 1100 for nm in result):
        raise InputError(
            "wavelengths",
            file=where,
            field="channels",
            got=", ".join(names)[:200],
            expected="300 to 1100, once each",
        )
    return result


@cache
def _weights(names: tuple[str, ...]) -> np.ndarray:
    return spectral_weights(wavelengths(names, None)).astype(np.float32)


def _to_linear(pixels: np.ndarray, channels: tuple[str, ...], where: PathLike) -> np.ndarray:
    if pixels.dtype == np.uint8 or set(channels) == {"R", "G", "B"}:
        raise InputError(
            "picture without wavelengths",
            file=where,
            field="channels",
            got=", ".join(channels),
            expected="wavelengths, or --format ubo",
        )
    wavelengths(channels, where)
    return pixels[..., pick(channels, channels, where)] @ _weights(channels)


FORMAT = Format(
    "spectral",
    "Bonn SPECTRAL folders of OpenEXR pictures",
    recogniser("spectral"),
    opener("spectral", _to_linear, cosine_included=False, scale=1.0),
    options=frozenset({"allow_missing", "pattern"}),
)
