"""A glTF 2.0 file: its JSON, its buffers, and the accessors and images in them, every index checked."""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.materials import decode_pixels
from btfref.types import Facts

#: componentType -> NumPy (glTF 2.0, sec. 3.6.2.2).
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}

#: type -> numbers of an element that vertices and indices can have.
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

#: Most elements of an accessor: 4 GiB of positions.
_MOST = 1 << 28

_GLB, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


class GltfFile:
    """JSON and bytes of a ``.gltf`` or ``.glb`` file.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    header : dict
        The JSON.

    Raises
    ------
    InputError
        A file that is missing or no glTF 2.0.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        data = path.read_bytes()
        self._binary: bytes | None = None
        text = data
        if data[:4] == b"glTF":
            text = self._chunks(data)
        try:
            header = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise self.refusal("cannot read the mesh", got=error, expected="JSON") from None
        version = header.get("asset", {}).get("version") if isinstance(header, dict) else None
        if not isinstance(version, str) or not version.startswith("2."):
            raise self.refusal("version of glTF", "asset.version", got=version, expected="2.0")
        self.header: Facts = header
        self._buffers: dict[int, bytes] = {}

    def refusal(
        self, message: str, field: str = "file", *, got: object = None, expected: object = None
    ) -> InputError:
        """InputError about this file."""
        return InputError(message, file=self.path, field=field, got=got, expected=expected)

    def _chunks(self, data: bytes) -> bytes:
        """JSON chunk of a GLB; keeps the binary one."""
        text, at = None, 12
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, at)
            if at + 8 + length > len(data):
                raise self.refusal("cannot read the mesh", f"chunk at byte {at}", got=f"{length} bytes")
            chunk = data[at + 8 : at + 8 + length]
            if kind == _JSON_CHUNK and text is None:
                text = chunk
            elif kind == _BINARY_CHUNK and self._binary is None:
                self._binary = chunk
            at += 8 + length
        if text is None:
            raise self.refusal("cannot read the mesh", got="no JSON chunk", expected="a GLB of version 2")
        return text

    def entry(self, kind: str, index: Any) -> Facts:
        """An entry of one of the JSON's lists.

        Parameters
        ----------
        kind : str
            Name of the list, "accessors".
        index : int

        Raises
        ------
        InputError
            When there is none.
        """
        entries = self.header.get(kind, [])
        whole = isinstance(index, int) and not isinstance(index, bool)
        if not whole or not isinstance(entries, list) or not 0 <= index < len(entries):
            raise self.refusal("index out of range", f"{kind}[{index}]", expected=f"below {len(entries)}")
        found = entries[index]
        if not isinstance(found, dict):
            raise self.refusal("damaged entry", f"{kind}[{index}]", got=type(found).__name__)
        return found

    def _uri(self, uri: str, field: str) -> bytes:
        """Bytes of a data URI, or of a file beside this one."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except (binascii.Error, ValueError) as error:
                raise self.refusal("damaged data", field, got=error) from None
        path = self.path.parent / urllib.parse.unquote(uri)
        if "://" in uri or not path.is_file():
            raise self.refusal("no such file", field, got=uri)
        return path.read_bytes()

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = self.entry("buffers", index).get("uri")
            if uri is None and (index or self._binary is None):
                raise self.refusal("buffer without bytes", f"buffers[{index}]")
            self._buffers[index] = (
                (self._binary or b"") if uri is None else self._uri(uri, f"buffers[{index}]")
            )
        return self._buffers[index]

    def _view(self, index: int) -> tuple[memoryview, int]:
        """Bytes of a buffer view, and its stride or 0."""
        view = self.entry("bufferViews", index)
        if extensions := view.get("extensions"):
            raise self.refusal("compressed geometry", f"bufferViews[{index}]", got=", ".join(extensions))
        data = memoryview(self._buffer(view["buffer"]))
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if start < 0 or length < 0 or start + length > len(data):
            raise self.refusal(
                "buffer too short", f"bufferViews[{index}]", got=len(data), expected=start + length
            )
        return data[start : start + length], int(view.get("byteStride", 0))

    def _elements(
        self, view: int, offset: int, component: int, width: int, count: int, field: str
    ) -> np.ndarray:
        dtype = np.dtype(_COMPONENTS[component])
        data, stride = self._view(view)
        stride = stride or dtype.itemsize * width
        need = offset + (stride * (count - 1) + dtype.itemsize * width if count else 0)
        if offset < 0 or stride < dtype.itemsize or need > len(data):
            raise self.refusal("buffer too short", field, got=len(data), expected=need)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()

    def accessor(self, index: int, kinds: tuple[str, ...]) -> np.ndarray:
        """Elements of an accessor.

        Parameters
        ----------
        index : int
        kinds : tuple of str
            Types that it may be of, "VEC3".

        Returns
        -------
        ndarray (count, numbers)
            float64 of floats and of normalized whole numbers, else as stored.

        Raises
        ------
        InputError
            Another type, or bytes that are not there.
        """
        accessor = self.entry("accessors", index)
        field = f"accessors[{index}]"
        kind, component = accessor.get("type"), accessor.get("componentType")
        count = accessor.get("count")
        if kind not in kinds or component not in _COMPONENTS:
            raise self.refusal("type of an accessor", field, got=kind, expected=" or ".join(kinds))
        if not isinstance(count, int) or not 0 <= count <= _MOST:
            raise self.refusal("elements of an accessor", field, got=count, expected=f"0 to {_MOST}")
        width = _WIDTHS[kind]
        if "bufferView" in accessor:
            offset = int(accessor.get("byteOffset", 0))
            values = self._elements(accessor["bufferView"], offset, component, width, count, field)
        else:
            values = np.zeros((count, width), _COMPONENTS[component])
        if sparse := accessor.get("sparse"):
            n, place, new = int(sparse["count"]), sparse["indices"], sparse["values"]
            rows = self._elements(
                place["bufferView"], int(place.get("byteOffset", 0)), place["componentType"], 1, n, field
            )
            if n and rows.max() >= count:
                raise self.refusal("sparse index out of range", field, got=int(rows.max()), expected=count)
            values[rows[:, 0]] = self._elements(
                new["bufferView"], int(new.get("byteOffset", 0)), component, width, n, field
            )
        if values.dtype.kind == "f":
            return values.astype(np.float64)
        if accessor.get("normalized"):
            return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
        return values

    def image(self, index: int) -> np.ndarray:
        """Pixels of an image, (rows, columns, 1 to 4) of uint8 or uint16, row 0 at the top."""
        image = self.entry("images", index)
        field = f"images[{index}]"
        data = (
            bytes(self._view(image["bufferView"])[0])
            if "bufferView" in image
            else self._uri(image["uri"], field)
        )
        return decode_pixels(data, self.path, image.get("name") or field)

    def texture(self, index: Any) -> tuple[int, Facts]:
        """Image of a texture, and its sampler."""
        texture = self.entry("textures", index)
        source = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source")
        source = texture.get("source") if source is None else source
        if source is None:
            named = ", ".join(texture.get("extensions", {})) or "no image"
            raise self.refusal("texture that cannot be read", f"textures[{index}]", got=named)
        sampler = self.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
        return int(source), sampler
