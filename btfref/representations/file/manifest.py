"""The manifest of a representation's file: JSON in an attribute of the first part, checked field by field.

Nothing here reads pixels, and nothing in it is taken on trust: every number that memory is asked for by, or that a port
is compiled with, has a type and a range, and the maps cannot be larger than what the file's bytes could hold.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from btfref.conventions import FILTER_TYPES, SCHEMA_VERSION
from btfref.errors import InputError
from btfref.representations.file.map_images import BLOCK, file_shape, image_size

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from btfref.representations.file.rows import RowReader
    from btfref.types import Facts, PathLike

#: Attributes of the first part: the manifest, and the checksum of its text.
ATTRIBUTE, CHECKSUM = "btfref", "btfref_crc32"

#: What the manifest says where the file has checksums; files of earlier versions lack them.
KIND_OF_CHECKSUM = "crc32"

#: The same of every row, of maps whose rows are read alone.
KIND_BY_ROW = "crc32_rows"

#: Rows of a block by the key of its checksums.
BLOCKS = {KIND_OF_CHECKSUM: BLOCK, KIND_BY_ROW: 1}

#: Types of maps; OpenEXR has no 8-bit channels, see :mod:`btfref.representations.file.map_images`.
TYPES = ("float16", "float32", "uint32", "uint8")

#: Texels along a side, and directions of a set, that ports can count in float32.
LARGEST_SIDE = 1 << 20

#: Axes of a map that any method needs, with room.
MOST_AXES = 8

#: Deflate makes at most 1032 bytes of one (RFC 1951: 258 bytes for two bits): more than that a file cannot hold.
EXPANSION = 1032

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")


class _Fields:
    """The fields of a manifest, each with what it must be."""

    def __init__(self, path: PathLike, data: object, where: str = "") -> None:
        self.path, self.data, self.where = path, data, where
        if not isinstance(data, dict):
            self.refuse("", data, "an object")

    def refuse(self, name: str, got: object, expected: str) -> NoReturn:
        field = ".".join(part for part in (self.where, name) if part) or ATTRIBUTE
        if isinstance(got, str | list | dict):
            text = json.dumps(got)
            got = text if len(text) <= 60 else f"{text[:57]}…"
        raise InputError("damaged manifest", file=self.path, field=field, got=got, expected=expected)

    def take(self, name: str, expected: str) -> Any:
        assert isinstance(self.data, dict)
        if name not in self.data:
            self.refuse(name, "nothing", expected)
        return self.data[name]

    def text(self, name: str, known: tuple[str, ...] | None = None) -> str:
        expected = "text" if known is None else " or ".join(known)
        value = self.take(name, expected)
        if not isinstance(value, str) or (known is not None and value not in known):
            self.refuse(name, value, expected)
        return value

    def whole(self, name: str, least: int, most: int) -> int:
        expected = f"a whole number in [{least}, {most}]"
        value = self.take(name, expected)
        if not _is_whole(value, least, most):
            self.refuse(name, value, expected)
        return value

    def wholes(self, name: str, least: int, most: int, counts: range) -> list[int]:
        value = self.take(name, "a list of whole numbers")
        good = isinstance(value, list) and len(value) in counts
        if not good or not all(_is_whole(n, least, most) for n in value):
            least_count, most_count = counts.start, counts.stop - 1
            number = f"{least_count}" if least_count == most_count else f"{least_count} to {most_count}"
            expected = f"{number} whole numbers in [{least}, {most}]"
            self.refuse(name, value, expected)
        return value

    def inner(self, name: str) -> _Fields:
        where = ".".join(part for part in (self.where, name) if part)
        return _Fields(self.path, self.take(name, "an object"), where)


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def text_of(manifest: Facts) -> dict[str, str]:
    """Attributes that hold a manifest: its text, and the checksum of that."""
    text = json.dumps({**manifest, "checksum": KIND_OF_CHECKSUM}, sort_keys=True)
    return {ATTRIBUTE: text, CHECKSUM: f"{zlib.crc32(text.encode()):08x}"}


def parsed(attributes: Mapping[str, bytes], path: PathLike) -> Facts:
    """The manifest of a file, checked.

    Parameters
    ----------
    attributes : dict of str to bytes
        Of the first part.
    path : path-like

    Returns
    -------
    dict
        ``schema``, ``kind``, ``meta``, ``arrays``.

    Raises
    ------
    InputError
        With the field, what it holds and what was expected.
    """
    if ATTRIBUTE not in attributes:
        raise InputError(
            "not a btfref representation", file=path, field=ATTRIBUTE, expected="a manifest attribute"
        )
    data = attributes[ATTRIBUTE]
    try:
        manifest = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        # An older or foreign file has no checksum: what JSON says of it is all there is.
        raise InputError("damaged manifest", file=path, field=ATTRIBUTE, got=repr(error)) from error
    fields = _Fields(path, manifest)
    checksum = attributes.get(CHECKSUM)
    if checksum is None and manifest.get("checksum") is not None:
        raise InputError("damaged manifest", file=path, field=CHECKSUM, expected="a checksum")
    if checksum is not None and checksum != f"{zlib.crc32(data):08x}".encode():
        raise InputError(
            "damaged manifest: its checksum differs",
            file=path,
            field=CHECKSUM,
            got=checksum.decode("ascii", "replace"),
            expected=f"{zlib.crc32(data):08x}",
        )
    schema = fields.whole("schema", 1, 2**31)
    if schema > SCHEMA_VERSION:
        raise InputError(
            "written by a newer btfref", file=path, field="schema", got=schema, expected=f"≤ {SCHEMA_VERSION}"
        )
    fields.text("kind", ("representation",))
    _check_meta(fields.inner("meta"))
    arrays = fields.inner("arrays")
    if not arrays.data:
        arrays.refuse("", {}, "at least one map")
    for name in manifest["arrays"]:
        if not _NAME.fullmatch(name):
            arrays.refuse(name, name, "a name of letters, digits and _")
        _check_entry(arrays.inner(name))
    _check_size(fields, Path(path).stat().st_size)
    return manifest


def _check_meta(meta: _Fields) -> None:
    meta.text("method")
    meta.text("filter_type", FILTER_TYPES)
    meta.wholes("texels", 1, LARGEST_SIDE, range(2, 3))
    for kind in ("views", "lights"):
        meta.inner(kind).whole("count", 1, LARGEST_SIDE)
        meta.inner(kind).text("name")
    for name in ("parameters", "parent", "versions", "constants"):
        meta.inner(name)
    assert isinstance(meta.data, dict)
    for name, value in meta.data["constants"].items():
        if not _NAME.fullmatch(name):
            meta.inner("constants").refuse(name, name, "a name of letters, digits and _")
        if isinstance(value, float) and not math.isfinite(value):
            meta.inner("constants").refuse(name, value, "a finite number")
    if "fit" in meta.data:
        meta.inner("fit")
    if "published_layout" in meta.data:
        meta.inner("published_layout")
    if not isinstance(meta.data.get("partial", False), bool):
        meta.refuse("partial", meta.data["partial"], "true or false")
    for name in ("resident_views", "resident_lights", "resident_entries", "resident_levels"):
        if name in meta.data:
            meta.wholes(name, 0, LARGEST_SIDE, range(1, LARGEST_SIDE))
    if "index_bytes" in meta.data:
        widths = meta.inner("index_bytes")
        for name in meta.data["index_bytes"]:
            widths.whole(name, 1, 4)


def _check_entry(entry: _Fields) -> None:
    shape = entry.wholes("shape", 1, 2**31 - 1, range(2, MOST_AXES + 1))
    entry.text("dtype", TYPES)
    assert isinstance(entry.data, dict)
    if "rows" in entry.data:
        rows = entry.wholes("rows", 0, len(shape) - 2, range(1, len(shape)))
        if len(set(rows)) != len(rows):
            entry.refuse("rows", rows, "axes that differ")
    for kind, block in BLOCKS.items():
        if kind in entry.data:
            blocks = -(-image_of_entry(entry.data)[0] // block)
            text = entry.text(kind)
            if len(text) != 8 * blocks or re.fullmatch(r"[0-9a-f]+", text) is None:
                entry.refuse(kind, text, f"{8 * blocks} hexadecimal digits")


def _check_size(fields: _Fields, file_bytes: int) -> None:
    """More than a file of so many bytes can hold is refused before memory is asked for."""
    assert isinstance(fields.data, dict)
    total = sum(math.prod(e["shape"]) * np.dtype(e["dtype"]).itemsize for e in fields.data["arrays"].values())
    if total > EXPANSION * file_bytes:
        raise InputError(
            "the maps are larger than the file can hold",
            file=fields.path,
            field="arrays",
            got=f"{total} bytes in {file_bytes}",
            expected=f"at most {EXPANSION} times",
        )


def image_of_entry(entry: Facts) -> tuple[int, int, int]:
    """Rows, columns and channels of the image that holds a map."""
    shape = file_shape(entry)
    return (*image_size(shape, len(entry.get("rows", ()))), shape[-1])


def stored_type(entry: Facts) -> np.dtype:
    """Type of the channels that hold a map."""
    return np.dtype("float16" if entry["dtype"] == "uint8" else entry["dtype"])


def checksums(planes: Sequence[np.ndarray], block: int = BLOCK) -> str:
    """Checksums of the blocks of rows of an image, eight hexadecimal digits each.

    Parameters
    ----------
    planes : sequence of ndarray, shape (rows, columns)
        Its channels, as they are stored.
    block : int
        Rows of a block.

    Returns
    -------
    str
    """
    starts = range(0, len(planes[0]), block)
    return "".join(_checksum(np.stack([p[first : first + block] for p in planes], -1)) for first in starts)


def _checksum(block: np.ndarray) -> str:
    little = np.ascontiguousarray(block, block.dtype.newbyteorder("<"))
    return f"{zlib.crc32(little.reshape(-1).view(np.uint8).data):08x}"


def block_of(entry: Facts) -> int:
    """Rows of a map's image that one checksum is of, and that are read together."""
    return next((block for kind, block in BLOCKS.items() if kind in entry), BLOCK)


def refuse_changed(path: PathLike, name: str, entry: Facts, number: int, pixels: np.ndarray) -> None:
    """InputError for a block of an image whose pixels are not those that were written.

    Parameters
    ----------
    path : path-like
    name : str
        Of the map.
    entry : dict
        What the manifest says of it; without checksums, as in files of earlier versions, nothing is refused.
    number : int
        Of the block.
    pixels : ndarray, shape (rows, columns, channels)
    """
    text = next((entry[kind] for kind in BLOCKS if kind in entry), None)
    if text is None:
        return
    found, expected = _checksum(pixels), text[8 * number : 8 * (number + 1)]
    if found != expected:
        raise InputError(
            "a map is damaged: its checksum differs", file=path, field=name, got=found, expected=expected
        )


def check_parts(manifest: Facts, reader: RowReader, path: PathLike) -> None:
    """InputError for a part that is missing or whose header does not fit what the manifest says of its map."""
    for name, entry in manifest["arrays"].items():
        part = reader.parts.get(name)
        if part is None:
            raise InputError("a map is missing", file=path, field=name)
        rows, columns, channels = image_of_entry(entry)
        kind = stored_type(entry)
        if (part.rows, part.columns, len(part.channels)) != (rows, columns, channels) or part.kind != kind:
            raise InputError(
                "a map is damaged",
                file=path,
                field=name,
                got=f"{part.kind} {part.rows} × {part.columns}, {len(part.channels)} channels",
                expected=f"{kind} {rows} × {columns}, {channels} channels",
            )
