"""glTF files for tests, written from arrays by code that shares nothing with the reader."""

import base64
import io
import json
import struct

import numpy as np
from PIL import Image

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])

#: v of glTF points down in images: the picture stands upright on the square.
UV = np.stack([SQUARE[:, 0], 1 - SQUARE[:, 1]], 1)

_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def picture(values):
    """A data URI of a PNG."""
    stream = io.BytesIO()
    Image.fromarray(np.asarray(values, np.uint8)).save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def gltf(
    path, material, images=(), *, sets=(UV,), vertices=SQUARE, faces=FACES, samplers=(), node=None, **more
):
    """Write a mesh with one material; z of the vertices is up.

    `more`: other attributes of vertices by name, and `top`: entries of the JSON's top level.
    """
    top = more.pop("top", {})
    blobs, views, accessors = b"", [], []

    def accessor(values, kind):
        nonlocal blobs
        data = np.ascontiguousarray(values, kind)
        views.append({"buffer": 0, "byteOffset": len(blobs), "byteLength": data.nbytes})
        blobs += data.tobytes() + bytes(-data.nbytes % 4)
        entry = {"bufferView": len(views) - 1, "count": len(data), "type": _TYPES[data[0].size]}
        if data.dtype == np.uint8:
            entry["normalized"] = True
        accessors.append(entry | {"componentType": {"f": 5126, "u2": 5123, "u1": 5121}[_kind(data)]})
        return len(accessors) - 1

    def up(values):
        return np.asarray(values) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])

    attributes = {"POSITION": accessor(up(vertices), np.float32)}
    for k, uv in enumerate(sets):
        attributes[f"TEXCOORD_{k}"] = accessor(uv, np.float32)
    for name, values in more.items():
        values = up(values) if name == "NORMAL" else np.asarray(values)
        attributes[name] = accessor(values, values.dtype if values.dtype == np.uint8 else np.float32)
    primitive = {"attributes": attributes, "indices": accessor(np.ravel(faces), np.uint16)}
    if material is not None:
        primitive["material"] = 0
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material or {}],
        "samplers": list(samplers) or [{}],
        "images": [{"uri": picture(image)} for image in images],
        "textures": [{"source": k, "sampler": min(k, max(len(samplers) - 1, 0))} for k in range(len(images))],
        "buffers": [{"byteLength": len(blobs)}],
        "bufferViews": views,
        "accessors": accessors,
        **top,
    }
    if path.suffix == ".glb":
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        chunks = (
            struct.pack("<II", len(text), 0x4E4F534A)
            + text
            + struct.pack("<II", len(blobs), 0x004E4942)
            + blobs
        )
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    else:
        header["buffers"][0]["uri"] = (
            "data:application/octet-stream;base64," + base64.b64encode(blobs).decode()
        )
        path.write_text(json.dumps(header))
    return path


def _kind(data):
    return "f" if data.dtype.kind == "f" else f"u{data.dtype.itemsize}"
