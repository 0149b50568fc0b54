"""UTIA's container MIF: chunks of images and an XML text that says which directions they belong to.

Facts of the layout: MIFlib 0.4. Values are UTIA's (`btfref.formats.image_sets.utia`): reflectance factors, without
the light's cosine; XYZ under D65 unless the XML names another colour space, 8 and 16 bits sRGB.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from btfref.errors import InputError
from btfref.formats.image_sets.angles import Angles, Direction, arrange
from btfref.formats.image_sets.utia import SCALE, WHITE
from btfref.formats.reading import Reader
from btfref.formats.source import LARGEST_COUNT, Format, Source
from btfref.numerics.colour import decode_srgb, rgb_from_xyz
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.formats.image_sets.files import Candidate

MAGIC = b"MIF FILE"
VERSION = 1
IMAGE, XML, EMPTY = 0, 1, (1 << 64) - 1

#: Number in the file -> type of the values.
TYPES = {1: "<u1", 2: "<u2", 9: "<f2", 10: "<f4", 11: "<f8"}

_LARGEST_XML = 64 << 20
_LARGEST_SIDE = 1 << 16


def recognises(candidate: Candidate) -> bool:
    """Whether the file starts with the magic chunk."""
    return candidate.head.startswith(MAGIC)


def open_mif(path: PathLike, *, allow_missing: bool = False) -> Source:
    """Open a container with one BTF; of several the first of the XML.

    Parameters
    ----------
    path : path-like
    allow_missing : bool
        Accept pairs without an image.

    Returns
    -------
    Source
    """
    reader = Reader(path)
    images, text = _chunks(reader)
    if text is None:
        reader.fail("no XML", "XML chunk", expected="one that gives the directions")
    root = _parse(text, path)
    btf = next(iter(root.iter("btf")), None)
    if btf is None:
        raise InputError("no BTF in the XML", file=path, field="btf")
    entries = {}
    for position, angles in _pairs(root, btf, path):
        if angles in entries:
            raise InputError(
                "two images of one pair of directions", file=path, field="directions", got=angles
            )
        if position in images:
            entries[angles] = images[position]
    if not entries:
        raise InputError("no image of the directions in the XML", file=path, field="index-map")
    shapes = {image.shape for image in entries.values()}
    if len(shapes) > 1:
        raise InputError("images of different sizes", file=path, field="image", got=sorted(shapes)[:3])
    found = arrange(entries, path, allow_missing=allow_missing)
    rows, columns, planes = shapes.pop()
    if planes != 3:
        raise InputError("planes of the images", file=path, field="planes", got=planes, expected=3)
    space, white = _colours(root, btf, path)

    def colours(view: int, first: int, last: int) -> np.ndarray:
        result = np.zeros((last - first, rows, columns, 3), np.float32)
        for slot, light in enumerate(range(first, last)):
            if (view, light) in found.images:
                result[slot] = _linear(found.images[view, light], space, white)
        return result

    return Source(
        path=reader.path,
        format="mif",
        views=found.views,
        lights=found.lights,
        texels=(rows, columns),
        colours=colours,
        cosine_included=False,
        scale=SCALE,
        facts={"images": len(images), "colour_space": space, "file_bytes": reader.size},
        present=found.present,
        moved=found.moved,
        fingerprint=reader.digest,
        release=reader.release,
    )


def _chunks(reader: Reader) -> tuple[dict[int, np.ndarray], bytes | None]:
    """Images by index, as arrays into the file, and the XML text."""
    images: dict[int, np.ndarray] = {}
    text: bytes | None = None
    first = True
    while reader.offset < reader.size:
        at = reader.offset
        kind = reader.number("u64", "chunk type")
        length = reader.number("u64", "chunk length")
        if first and (kind.to_bytes(8, "little") != MAGIC or length != 8):
            reader.fail("no MIF file", "magic chunk", at=at, got=kind, expected=MAGIC.decode())
        end = reader.take("chunk", length) + length
        reader.offset = end - length
        if first:
            reader.number("u64", "version", VERSION, VERSION)
            first = False
        elif kind == IMAGE:
            index, array = _image(reader, length, len(images))
            if index in images:
                reader.fail("two images of one index", "index", at=at + 16, got=index)
            images[index] = array
        elif kind == XML:
            if text is not None or length > _LARGEST_XML:
                reader.fail(
                    "XML chunk", "chunk length", at=at + 8, got=length, expected="one, of at most 64 MiB"
                )
            text = reader.map[reader.offset : end]
        reader.offset = end
    if first:
        reader.fail("no MIF file", "magic chunk")
    return images, text


def _image(reader: Reader, length: int, n: int) -> tuple[int, np.ndarray]:
    name = f"image {n}"
    if length < 48:
        reader.fail("chunk too short for an image", f"{name}, chunk length", got=length, expected="≥ 48")
    index = reader.number("u64", f"{name}, index")
    reader.number("u64", f"{name}, flags")
    at = reader.offset
    kind = reader.number("u64", f"{name}, type of the values")
    if kind not in TYPES:
        known = ", ".join(map(str, TYPES))
        reader.fail("type of the values", f"{name}, type of the values", at=at, got=kind, expected=known)
    shape = [
        reader.number("u64", f"{name}, {side}", 1, largest)
        for side, largest in (("height", _LARGEST_SIDE), ("width", _LARGEST_SIDE), ("planes", 256))
    ]
    size = np.dtype(TYPES[kind]).itemsize * shape[0] * shape[1] * shape[2]
    if length != 48 + size:
        reader.fail(
            "chunk of another size", f"{name}, chunk length", at=at - 24, got=length, expected=48 + size
        )
    return index, reader.array(name, TYPES[kind], shape)


def _parse(text: bytes, path: PathLike) -> ElementTree.Element:
    # Definitions in a document can expand without end; MIF has none.
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", text):
        raise InputError("XML with a document type", file=path, field="XML")
    try:
        return ElementTree.fromstring(text.rstrip(b"\0"))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError("damaged XML", file=path, field="XML", got=error) from None


def _referred(
    root: ElementTree.Element, element: ElementTree.Element, name: str
) -> ElementTree.Element | None:
    """A child, or what it refers to by the id of an element at the top."""
    child = element.find(name)
    reference = child.get("reference") if child is not None else None
    if reference is None:
        return child
    return next((one for one in root.iter(name) if one.get("id") == reference), None)


def _pairs(
    root: ElementTree.Element, btf: ElementTree.Element, path: PathLike
) -> Iterator[tuple[int, Angles]]:
    """(index of the image, (θ_l, φ_l, θ_v, φ_v) in degrees) of each pair."""
    table = _referred(root, btf, "directions")
    items = [] if table is None else table.findall("directions-item")
    if table is None or not 0 < len(items) <= LARGEST_COUNT**2:
        raise InputError("no list of directions", file=path, field="directions", got=len(items))
    listed = btf.find("index-map")
    try:
        offset = int(btf.findtext("index-offset") or 0)
        order = None if listed is None else [int(word) for word in (listed.text or "").split(",")]
        for number, item in enumerate(items):
            position = int(item.get("index", number))
            ends: dict[str | None, Direction] = {}
            for one in item.findall("direction"):
                unit = one.get("units", item.get("units", table.get("units", "deg")))
                factor = {"deg": 1.0, "rad": 180 / np.pi}[unit]
                theta, phi = (float(one.attrib[key]) * factor for key in ("theta", "phi"))
                if one.get("type") in ends or not (0 <= theta <= 90 and np.isfinite(phi)):
                    raise ValueError(f"directions-item {position}: {one.attrib}")
                ends[one.get("type")] = (round(theta, 6), round(phi % 360, 6) % 360 if theta else 0.0)
            yield (offset + position if order is None else order[position]), ends["source"] + ends["sensor"]
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        raise InputError(
            "damaged list of directions", file=path, field="directions", got=repr(error)
        ) from None


def _colours(root: ElementTree.Element, btf: ElementTree.Element, path: PathLike) -> tuple[str, float]:
    """Colour space and the Y of white."""
    element = _referred(root, btf, "colors")
    space = "XYZ" if element is None else (element.findtext("color_space") or "XYZ").strip()
    point = None if element is None else element.find("white_point")
    try:
        white = WHITE if point is None else float(point.get("Y", WHITE))
    except ValueError:
        white = 0.0
    if space not in ("XYZ", "RGB", "sRGB") or not 1e-6 < white < 1e6:
        raise InputError(
            "colour space",
            file=path,
            field="colors",
            got=f"{space}, white at {white}",
            expected="XYZ, RGB or sRGB",
        )
    return space, white


def _linear(image: np.ndarray, space: str, white: float) -> np.ndarray:
    if image.dtype.kind == "u":
        return decode_srgb(image / np.iinfo(image.dtype).max).astype(np.float32)
    values = image.astype(np.float32)
    return rgb_from_xyz(values / np.float32(white)).astype(np.float32) if space == "XYZ" else values


FORMAT = Format(
    "mif",
    "UTIA's container MIF",
    recognises,
    open_mif,
    options=frozenset({"allow_missing"}),
)
