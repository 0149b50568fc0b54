"""What all of Bonn's binary BTFs start with: signature, measurement, directions, texels, rotations."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np

from btfref.formats.reading import Reader
from btfref.formats.source import LARGEST_COUNT, direction_set
from btfref.numerics.sphere.directions import DirectionSet
from btfref.types import Facts, PathLike

#: Signature -> family. Of two that match the longer counts.
SIGNATURES = {
    b"!DFMF08FCR": "DFMF",
    b"!FMF12FCER": "FMF",
    b"!FMF06FCR": "FMF",
    b"!FMF06FC": "FMF",
    b"!PVF06FCR": "PVF",
    b"!PVF06FC": "PVF",
    b"!BDIF06R2!": "BDI",
}

#: Starts a PVF file of the old form, in place of the measurement block.
LEGACY_PVF = 301074

_TEXT = 80
_LARGEST_SIDE = 1 << 16
_LARGEST_CHANNELS = 256


@dataclass
class Header:
    """Facts in front of the values.

    Parameters
    ----------
    signature : bytes
    family : {"DFMF", "FMF", "PVF", "BDI"}
    views, lights : DirectionSet
        Missing until read.
    texels : tuple of int
        Rows and columns; (0, 0) until read.
    channels : tuple of str
    cosine_included : bool
    facts : dict
        For people.
    """

    signature: bytes
    family: str
    views: DirectionSet = field(init=False)
    lights: DirectionSet = field(init=False)
    texels: tuple[int, int] = (0, 0)
    channels: tuple[str, ...] = ("R", "G", "B")
    cosine_included: bool = False
    facts: Facts = field(default_factory=dict)

    @property
    def n_pairs(self) -> int:
        """Views × lights."""
        return len(self.views) * len(self.lights)

    @property
    def n_texels(self) -> int:
        """Rows × columns."""
        return self.texels[0] * self.texels[1]


def signature_of(head: bytes) -> bytes | None:
    """The longest signature that bytes start with, or None."""
    return max((one for one in SIGNATURES if head.startswith(one)), key=len, default=None)


def read_header(reader: Reader) -> Header:
    """Header up to what is particular to a family; for BDI, which goes on differently, up to the directions.

    Raises
    ------
    InputError
        With the field and its offset.
    """
    signature = signature_of(reader.map[:16])
    if signature is None:
        reader.fail("no Bonn BTF", "signature", got=reader.map[:10], expected="!DFMF08FCR or the like")
    reader.take("signature", len(signature))
    header = Header(signature, SIGNATURES[signature])
    if header.family == "PVF" and _peek(reader) == LEGACY_PVF:
        reader.take("legacy number", 4)
        header.facts["legacy_components"] = reader.number("u32", "components", 1)
        _texels(reader, header)
        header.facts["legacy_slots"] = reader.number("u32", "view slots", 1, LARGEST_COUNT)
        _directions(reader, header)
        return header
    _measurement(reader, header)
    _directions(reader, header)
    if header.family != "BDI":
        _texels(reader, header)
        if signature.endswith(b"R"):
            read_rotations(reader, header)
    return header


def _peek(reader: Reader) -> int | None:
    return (
        struct.unpack_from("<i", reader.map, reader.offset)[0] if reader.size >= reader.offset + 4 else None
    )


def _measurement(reader: Reader, header: Header) -> None:
    start = reader.offset
    length = reader.number("u32", "length of the measurement block")
    version = reader.number("u32", "version", 1, 16)
    for name in ("measurement setup", "image sensor", "light source"):
        header.facts[name.replace(" ", "_")] = reader.text(name, _TEXT).strip()
    header.facts["pixels_per_mm"] = float(reader.floats("pixels per mm", (1,))[0])
    header.facts["rgb_scale_factor"] = reader.floats("rgb scale factor", (3,)).tolist()
    if version > 1:
        header.cosine_included = reader.number("u32", "cosine flag") != 0
    if version > 2:
        header.facts["xml_bytes"] = n = reader.number("u32", "length of the XML")
        reader.take("XML", n)
    if version > 3:
        n = reader.number("u32", "number of channels", 1, _LARGEST_CHANNELS)
        header.channels = tuple(
            reader.text(
                f"name of channel {i}", reader.number("u32", f"length of the name of channel {i}", 0, 256)
            )
            for i in range(n)
        )
    if reader.offset - start != length:
        reader.fail(
            "measurement block of another length",
            "length of the measurement block",
            at=start,
            got=length,
            expected=reader.offset - start,
        )


def _directions(reader: Reader, header: Header) -> None:
    n_views = reader.number("u32", "number of views", 1, LARGEST_COUNT)
    views, lights = np.zeros((n_views, 2)), np.zeros((0, 2))
    for view in range(n_views):
        views[view] = reader.floats(f"direction of view {view}", (2,))
        n_lights = reader.number("u32", f"number of lights of view {view}", 1, LARGEST_COUNT)
        at = reader.offset
        found = reader.floats(f"lights of view {view}", (n_lights, 2))
        if view and not (found.shape == lights.shape and np.allclose(found, lights, 0, 1e-5)):
            reader.fail(
                "light directions differ from view to view",
                f"lights of view {view}",
                at=at,
                expected="the same for all views",
            )
        lights = lights if view else found
    header.views = direction_set(views[:, 0], views[:, 1], reader.path)
    header.lights = direction_set(lights[:, 0], lights[:, 1], reader.path)


def _texels(reader: Reader, header: Header) -> None:
    width = reader.number("u32", "width", 1, _LARGEST_SIDE)
    height = reader.number("u32", "height", 1, _LARGEST_SIDE)
    header.texels = height, width


def read_rotations(reader: Reader, header: Header) -> None:
    """Local frames of texels: their number is reported, the owners' reader applies none either."""
    n = reader.number("u32", "number of rotations", 0, _LARGEST_SIDE * _LARGEST_SIDE - 1)
    reader.floats("rotations", (n, 9))
    header.facts["rotations"] = n


def to_rgb(channels: tuple[str, ...], file: PathLike) -> np.ndarray | None:
    """Weights (n, 3) from a file's channels to linear Rec. 709, or None where they are R, G and B.

    Raises
    ------
    InputError
        Channels that are neither colours nor wavelengths.
    """
    from btfref.formats.image_sets.spectral import wavelengths
    from btfref.numerics.colour import spectral_weights

    if channels == ("R", "G", "B"):
        return None
    if sorted(name.upper() for name in channels) == ["B", "G", "R"]:
        order = [[name.upper() for name in channels].index(name) for name in "RGB"]
        weights = np.zeros((3, 3), np.float32)
        weights[order, range(3)] = 1
        return weights
    return spectral_weights(wavelengths(channels, file)).astype(np.float32)
