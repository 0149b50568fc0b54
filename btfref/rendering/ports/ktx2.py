"""Textures of a package as KTX 2.0 files, which engines and viewers of textures open.

Source: "KTX File Format Specification", version 2.0 (Khronos), and "Khronos Data Format Specification", version 1.3,
section 5 (the basic data format descriptor). No supercompression, one level, a 2D array.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from btfref.provenance import __version__

if TYPE_CHECKING:
    from btfref.rendering.ports.package import PortTexture

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"

#: Type of a table -> VkFormat, bytes of a channel, qualifiers of its samples (0x80 float, 0x40 signed), and the bits of
#: the numbers that stand for their lower and upper end.
_KINDS = {
    "float16": (97, 2, 0xC0, 0xBF800000, 0x3F800000),
    "float32": (109, 4, 0xC0, 0xBF800000, 0x3F800000),
    "uint32": (107, 4, 0x00, 0, 1),
    "uint8": (37, 1, 0x00, 0, 255),
}

#: Channels of the colour model RGBSDA: red, green, blue, alpha.
_CHANNELS = (0, 1, 2, 15)

#: Bytes of the header and of the index of one level.
_HEAD = 80 + 24


def ktx2(texture: PortTexture) -> bytes:
    """A texture as the bytes of a KTX 2.0 file.

    Parameters
    ----------
    texture : btfref.rendering.ports.package.PortTexture

    Returns
    -------
    bytes
    """
    table = texture.table
    vk_format, size, *_ = kind = _KINDS[table.values.dtype.name]
    descriptor = _descriptor(kind)
    pairs = _pair("KTXorientation", "rd") + _pair("KTXwriter", f"btfref {__version__}")
    # The level begins at a multiple of a texel.
    first = -(-(_HEAD + len(descriptor) + len(pairs)) // (4 * size)) * 4 * size
    data = texture.data
    head = IDENTIFIER + struct.pack(
        "<9I", vk_format, size, table.width, table.height, 0, table.layers, 1, 1, 0
    )
    head += struct.pack("<4I2Q", _HEAD, len(descriptor), _HEAD + len(descriptor), len(pairs), 0, 0)
    head += struct.pack("<3Q", first, len(data), len(data))
    return (head + descriptor + pairs).ljust(first, b"\0") + data


def _descriptor(kind: tuple[int, int, int, int, int]) -> bytes:
    """The data format descriptor: four channels of one texel, linear, with the primaries of Rec. 709."""
    _, size, qualifiers, lower, upper = kind
    samples = b"".join(
        struct.pack("<HBBIII", 8 * size * i, 8 * size - 1, channel | qualifiers, 0, lower, upper)
        for i, channel in enumerate(_CHANNELS)
    )
    # Model RGBSDA, primaries BT.709, transfer linear, straight alpha; version 2 of the block is that of 1.3.
    block = struct.pack("<IHH4B4B8B", 0, 2, 24 + len(samples), 1, 1, 1, 0, 0, 0, 0, 0, 4 * size, *[0] * 7)
    return struct.pack("<I", 4 + len(block) + len(samples)) + block + samples


def _pair(key: str, value: str) -> bytes:
    text = key.encode() + b"\0" + value.encode() + b"\0"
    return struct.pack("<I", len(text)) + text + b"\0" * (-len(text) % 4)
