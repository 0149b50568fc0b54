"""One picture per pair: folders and archives as UBO2003's and UTIA's, which peers' programs read."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from btfref.errors import InputError
from btfref.formats.image_sets.reader import NOTE
from btfref.formats.parts import PartReader, open_parts
from btfref.images import decoding, radiance
from btfref.numerics.sphere.directions import DirectionSet
from btfref.outputs import new_file, new_folder
from btfref.types import Facts, PathLike, Progress

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

#: How names are written: pattern of folder and file, and whether it starts with a number.
_NAMES = {
    "ubo": ("tv{tv:03d}_pv{pv:03d}", "{n:05d} tl{tl:03d} pl{pl:03d} tv{tv:03d} pv{pv:03d}.{image}"),
    "utia": ("tv{tv:03d}_pv{pv:03d}", "tl{tl:03d}_pl{pl:03d}_tv{tv:03d}_pv{pv:03d}.{image}"),
}


def export_images(
    btf: BTFStore | SampledBTF,
    path: PathLike,
    *,
    style: str,
    image: str,
    encode: Callable[[np.ndarray], np.ndarray],
    divisor: float,
    with_cosine: bool,
    planes: Callable[[np.ndarray], Mapping[str, np.ndarray]] | None = None,
    quality: int = 95,
    scale: float = 1.0,
    moved: int = 0,
    progress: Progress | None = None,
) -> Facts:
    """Write a folder (or, when the path ends in ``.zip``, an archive) of pictures.

    Parameters
    ----------
    btf : BTFStore or SampledBTF
    path : path-like
    style : {"ubo", "utia"}
    image : {"jpg", "png", "hdr", "exr"}
    encode : callable
        8-bit codes of the format's quantity.
    divisor : float
        1/sr per unit of that quantity.
    with_cosine : bool
        Whether that quantity holds the light's cosine.
    planes : callable, optional
        Channels of OpenEXR pictures; R, G, B by default.
    quality : int
        Of JPEG, 1 to 100, without chroma subsampling.
    scale : float
        The values are divided by it, so that 8 bits and half floats hold them; it stands in ``btfref.json``.
    moved : int
        Degrees by which the light is moved (in θ, towards the horizon, or from it where it would fall below 75°)
        where it coincides with the camera, as in measurements; 0 leaves it.

    Returns
    -------
    dict
        ``images``, ``clipped`` (share of channels beyond 8 bits' range), ``lights_moved``.

    Raises
    ------
    InputError
        Directions that are no whole degrees, values below zero in a format that cannot hold them.
    """
    source = open_parts(btf)
    if not (isinstance(scale, int | float) and 1e-12 < scale < 1e12):
        raise InputError("scale", field="scale", got=scale, expected="a positive number")
    if isinstance(quality, bool) or not isinstance(quality, int) or not 1 <= quality <= 100:
        raise InputError("quality of JPEG", field="quality", got=quality, expected="1 to 100")
    angles = {name: _whole_degrees(getattr(source, name), name) for name in ("views", "lights")}
    path = Path(path)
    counts: dict[str, float] = {"images": 0, "clipped": 0, "channels": 0, "lights_moved": 0}
    archive = path.suffix.lower() == ".zip"
    new = new_file if archive else new_folder
    with new(path) as draft, _Sink(draft, archive, image in ("jpg", "png", "exr")) as sink:
        note = {"scale": scale * divisor, "cosine_included": with_cosine, "written_by": "btfref"}
        sink.add(NOTE, json.dumps(note, indent=1).encode())
        for view, (tv, pv) in enumerate(angles["views"]):
            values = source.view(view)
            for light, (tl, pl) in enumerate(angles["lights"]):
                where, picture = (tl, pl), values[light].astype(np.float32)
                if moved and (tl, pl) == (tv, pv):
                    where, picture = _moved_light(source, values, where, moved)
                    counts["lights_moved"] += 1
                cosine = 1.0 if with_cosine else max(float(np.cos(np.radians(where[0]))), 1e-6)
                picture = picture / np.float32(scale * divisor * cosine)
                counts["images"] += 1
                folder, file = _NAMES[style]
                keys = {"n": counts["images"], "tl": where[0], "pl": where[1], "tv": tv, "pv": pv}
                name = f"{folder}/{file}".format(image=image, **keys)
                # Row 0 of a picture is its top, v = 1.
                sink.add(name, _bytes(picture[::-1], image, encode, planes, quality, counts))
            if progress is not None:
                progress(view + 1, len(angles["views"]), "export")
    counts["clipped"] /= max(counts.pop("channels"), 1)
    return {"format": style, "pictures": image, "scale": scale, **counts}


def _whole_degrees(directions: DirectionSet, name: str) -> list[tuple[int, int]]:
    """Polar angles and azimuths as whole degrees, which these names are made of."""
    angles = np.degrees([directions.theta, directions.phi]).T
    whole = np.round(angles).astype(int)
    whole[:, 1] %= 360
    if np.abs((angles - whole + 180) % 360 - 180).max() > 1e-3:
        odd = angles[np.abs((angles - whole + 180) % 360 - 180).max(1) > 1e-3][0]
        raise InputError(
            "directions that this format cannot name",
            field=name,
            got=f"θ {odd[0]:.4g}°, φ {odd[1]:.4g}°",
            expected="whole degrees, such as ubo81",
        )
    return [(int(theta), int(phi) if theta else 0) for theta, phi in whole]


def _moved_light(
    source: PartReader, values: np.ndarray, light: tuple[int, int], degrees: int
) -> tuple[tuple[int, int], np.ndarray]:
    """Where the light goes, and the picture under it: interpolated between its neighbours."""
    from btfref.numerics.sphere.directions import spherical

    theta = light[0] + degrees if light[0] + degrees <= 75 else light[0] - degrees
    theta, phi = (theta, light[1]) if theta >= 0 else (-theta, (light[1] + 180) % 360)
    index, weight = source.lights.stencil(spherical(np.radians(theta), np.radians(phi)), hold=False)
    return (theta, phi), np.tensordot(weight, values[index].astype(np.float64), 1).astype(np.float32)


def _bytes(
    values: np.ndarray,
    image: str,
    encode: Callable[[np.ndarray], np.ndarray],
    planes: Callable[[np.ndarray], Mapping[str, np.ndarray]] | None,
    quality: int,
    counts: dict[str, float],
) -> bytes:
    """One picture as bytes; ``counts`` learns how many channels were clipped."""
    counts["channels"] += values.size
    if image in ("jpg", "png"):
        from PIL import Image

        counts["clipped"] += int(((values > 1) | (values < 0)).sum())
        stream = io.BytesIO()
        settings = {"quality": quality, "subsampling": 0} if image == "jpg" else {"compress_level": 3}
        kind = {"jpg": "JPEG", "png": "PNG"}[image]
        Image.fromarray(encode(values)).save(stream, kind, **settings)
        return stream.getvalue()
    if image == "hdr":
        counts["clipped"] += int((values < 0).sum())
        return radiance.encode(np.maximum(values, 0), reversed_line=True)
    channels = planes(values) if planes else dict(zip("RGB", np.moveaxis(values, -1, 0), strict=True))
    if any(np.abs(plane).max() > 65504 for plane in channels.values()):
        raise InputError("values beyond half floats", field="scale", expected="a larger scale")
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        decoding.write_exr(channels, file.name)
        return Path(file.name).read_bytes()


class _Sink:
    """Files of a folder that is there, or of an archive that is made."""

    def __init__(self, target: Path, archive: bool, packed: bool) -> None:
        self.target = target
        method = zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED
        self._zip = zipfile.ZipFile(target, "w", method) if archive else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def add(self, name: str, data: bytes) -> None:
        if self._zip is not None:
            # A fixed time, so that the same BTF gives the same bytes.
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.compress_type = self._zip.compression
            self._zip.writestr(info, data)
            return
        target = self.target / name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(data)
