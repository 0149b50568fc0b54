"""UTIA: one picture per pair, ``tvTTT_pvPPP/tlTTT_plPPP_tvTTT_pvPPP.png`` (sRGB) or ``.exr`` (CIE XYZ, D65, white 100).

The values are reflectance factors: the owners' plugin for Mitsuba multiplies them by cos θ_light / π. So f = value / π
and B = f · cos θ_light. XYZ are divided by 100 and turned into linear Rec. 709; unlike that plugin we keep the
negative channels of colours outside that gamut.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.formats.image_sets.reader import opener, pick, recogniser
from btfref.formats.parts import one_view
from btfref.formats.source import Format
from btfref.numerics.colour import RGB_TO_XYZ, decode_srgb, encode_srgb, rgb_from_xyz
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

#: XYZ of a perfect diffuser has this Y.
WHITE = 100.0

#: Factor from a reflectance factor to 1/sr.
SCALE = 1 / np.pi

#: Linear values of 8-bit codes.
_CURVE = decode_srgb(np.arange(256) / 255).astype(np.float32)


def xyz_to_rgb(pixels: ArrayLike) -> np.ndarray:
    """Linear Rec. 709 of UTIA's XYZ (white at Y = 100), same shape, float32."""
    return rgb_from_xyz(np.asarray(pixels, np.float32) / np.float32(WHITE)).astype(np.float32)


def rgb_to_xyz(values: ArrayLike) -> np.ndarray:
    """UTIA's XYZ of linear Rec. 709, same shape."""
    return np.asarray(values) @ RGB_TO_XYZ.T * WHITE


def _to_linear(pixels: np.ndarray, channels: tuple[str, ...], where: PathLike) -> np.ndarray:
    if pixels.dtype == np.uint8:
        return _CURVE[pixels]
    # Writers that know three channels only call X, Y and Z by the names of colours.
    names = ("X", "Y", "Z") if "X" in channels else ("R", "G", "B")
    return xyz_to_rgb(pixels[..., pick(channels, names, where)])


def export(btf: BTFStore | SampledBTF, path: PathLike, **settings: Any) -> Facts:
    """Write pictures: `btfref.formats.image_sets.export.export_images` with names of UTIA."""
    from btfref.formats.image_sets.export import export_images

    settings = {"image": "exr", **settings}
    if settings["image"] not in ("png", "exr"):
        raise InputError("kind of picture", field="image", got=settings["image"], expected="png or exr")

    def encode(values: np.ndarray) -> np.ndarray:
        return np.round(255 * encode_srgb(np.clip(values, 0, 1))).astype(np.uint8)

    def planes(values: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip("XYZ", np.moveaxis(rgb_to_xyz(values), -1, 0), strict=True))

    return export_images(
        btf, path, style="utia", encode=encode, planes=planes, divisor=SCALE, with_cosine=False, **settings
    )


FORMAT = Format(
    "utia",
    "UTIA folders and archives of pictures",
    recogniser("utia"),
    opener("utia", _to_linear, cosine_included=False, scale=SCALE),
    options=frozenset({"allow_missing", "pattern"}),
    export=export,
    peak=one_view,
    settings=frozenset({"image", "scale", "moved"}),
)
