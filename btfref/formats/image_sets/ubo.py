"""UBO2003 and ATRIUM: one picture per pair, ``tvTTT_pvPPP/NNNNN tlTTT plPPP tvTTT pvPPP.jpg``.

The pictures are photographs: they hold the light's cosine. JPEG and PNG codes c mean (c / 255)^2.2 as all readers
of these sets take them; Radiance and OpenEXR pictures are linear Rec. 709.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.formats.image_sets.reader import image_source, pick, recogniser
from btfref.formats.parts import one_view
from btfref.formats.source import Format, Source
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

GAMMA = 2.2


def open_ubo(
    path: PathLike, *, allow_missing: bool = False, gamma: float = GAMMA, pattern: str | None = None
) -> Source:
    """Open a folder or zip archive.

    Parameters
    ----------
    path : path-like
    allow_missing : bool
        Accept pairs without a picture.
    gamma : float
        Exponent that makes 8-bit codes linear.
    pattern : str, optional
        Of the names, see `btfref.formats.image_sets.pattern.angles_by`.

    Returns
    -------
    Source
    """
    if not (isinstance(gamma, int | float) and 0.1 <= gamma <= 10):
        raise InputError("exponent of 8-bit codes", field="gamma", got=gamma, expected="0.1 to 10")
    curve = (np.arange(256) / 255).astype(np.float64) ** gamma
    curve = curve.astype(np.float32)

    def to_linear(pixels: np.ndarray, channels: tuple[str, ...], where: PathLike) -> np.ndarray:
        if pixels.dtype == np.uint8:
            return curve[pixels]
        return pixels[..., pick(channels, ("R", "G", "B"), where)]

    return image_source(
        path,
        "ubo",
        to_linear,
        cosine_included=True,
        scale=1.0,
        allow_missing=allow_missing,
        pattern=pattern,
        facts={"gamma": gamma},
    )


def export(btf: BTFStore | SampledBTF, path: PathLike, **settings: Any) -> Facts:
    """Write pictures: `btfref.formats.image_sets.export.export_images` with names of UBO2003."""
    from btfref.formats.image_sets.export import export_images

    settings = {"image": "jpg", "gamma": GAMMA, **settings}
    if settings["image"] not in ("jpg", "png", "hdr", "exr"):
        raise InputError(
            "kind of picture", field="image", got=settings["image"], expected="jpg, png, hdr or exr"
        )
    gamma = settings.pop("gamma")

    def encode(values: np.ndarray) -> np.ndarray:
        return np.round(255 * np.clip(values, 0, 1) ** (1 / gamma)).astype(np.uint8)

    return export_images(btf, path, style="ubo", encode=encode, divisor=1.0, with_cosine=True, **settings)


FORMAT = Format(
    "ubo",
    "UBO2003 and ATRIUM folders and archives of pictures",
    recogniser("ubo"),
    open_ubo,
    options=frozenset({"allow_missing", "gamma", "pattern"}),
    export=export,
    peak=one_view,
    settings=frozenset({"image", "gamma", "quality", "scale", "moved"}),
)
