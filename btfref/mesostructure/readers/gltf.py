"""Meshes of glTF 2.0 files with the materials that the standard gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.readers.container import GltfFile
from btfref.mesostructure.readers.gltf_materials import Material
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.readers.pieces import Piece
from btfref.types import Facts

__all__ = ["read_gltf"]

#: Extensions that this reader knows.
_KNOWN = (
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "KHR_materials_emissive_strength",
    "EXT_texture_webp",
)

#: Nodes inside nodes: more than any scene has.
_DEEPEST = 256

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_gltf(path: Path, notes: Notes) -> list[Piece]:
    """Pieces of a file's scene, in its own axes (y up).

    Parameters
    ----------
    path : Path
        ``.gltf`` or ``.glb``.
    notes : Notes
        Takes what is ignored.

    Returns
    -------
    list of Piece

    Raises
    ------
    InputError
        A damaged file, an extension that is required and not known.
    """
    try:
        file = GltfFile(path)
        for name in file.header.get("extensionsRequired", []):
            if name not in _KNOWN:
                raise file.refusal(
                    "needs an extension that is not read", "extensionsRequired", got=name, expected=_KNOWN
                )
        for name in file.header.get("extensionsUsed", []):
            if name not in _KNOWN:
                notes.add(f"extension {name}")
        for kind in ("animations", "skins"):
            if file.header.get(kind):
                notes.add(f"{kind} (the mesh is taken as it rests)")
        pieces: list[Piece] = []
        for index, matrix in _nodes(file):
            node = file.entry("nodes", index)
            if "mesh" in node:
                for primitive in file.entry("meshes", node["mesh"]).get("primitives", []):
                    piece = _piece(file, primitive, matrix, notes)
                    if piece is not None:
                        pieces.append(piece)
        return pieces
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError("cannot read the mesh", file=path, field="file", got=repr(error)) from None


def _nodes(file: GltfFile) -> list[tuple[int, np.ndarray]]:
    """Nodes of the scene with their transformations to the world."""
    header = file.header
    if "scenes" in header:
        roots = file.entry("scenes", header.get("scene", 0)).get("nodes", [])
    else:  # then all nodes that no other holds
        held = {child for node in header.get("nodes", []) for child in node.get("children", [])}
        roots = [index for index in range(len(header.get("nodes", []))) if index not in held]
    found, waiting = [], [(index, np.eye(4), 0) for index in roots]
    while waiting:
        index, parent, depth = waiting.pop(0)
        if depth > _DEEPEST:
            raise file.refusal("nodes inside themselves", f"nodes[{index}]")
        node = file.entry("nodes", index)
        matrix = parent @ _local(node)
        found.append((index, matrix))
        waiting += [(child, matrix, depth + 1) for child in node.get("children", [])]
    return found


def _local(node: Facts) -> np.ndarray:
    """Transformation of a node: a matrix by columns, or translation, rotation (quaternion) and scale."""
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64)
    result = np.eye(4)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    result[:3, :3] = rotation * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result


def _piece(file: GltfFile, primitive: Facts, matrix: np.ndarray, notes: Notes) -> Piece | None:
    """A primitive with its material; None for points and lines."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        notes.add("points and lines")
        return None
    if extensions := [name for name in primitive.get("extensions", {}) if "compression" in name]:
        raise file.refusal("compressed geometry", "primitives", got=", ".join(extensions))
    attributes: dict[str, Any] = primitive["attributes"]
    vertices = file.accessor(attributes["POSITION"], ("VEC3",)).astype(np.float64)
    count = len(vertices)

    def read(name: str, kinds: tuple[str, ...]) -> np.ndarray:
        values = file.accessor(attributes[name], kinds).astype(np.float64)
        if len(values) != count or not np.isfinite(values).all():
            raise file.refusal("attribute of vertices", name, got=len(values), expected=f"{count} finite")
        return values

    faces = np.arange(count)
    if "indices" in primitive:
        faces = file.accessor(primitive["indices"], ("SCALAR",))[:, 0].astype(np.int64)
    if len(faces) and faces.max() >= count:
        raise file.refusal("index of a vertex out of range", "indices", got=int(faces.max()), expected=count)
    faces = _triangles(faces, mode)
    if not len(faces):
        return None
    linear = matrix[:3, :3]
    determinant = np.linalg.det(linear) if np.isfinite(matrix).all() else 0.0
    if determinant == 0:
        raise file.refusal("transformation of a node", "nodes", expected="one that can be inverted")
    normals = None
    if "NORMAL" in attributes:
        normals = read("NORMAL", ("VEC3",)) @ np.linalg.inv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 0, normals / np.maximum(length, 1e-300), [0.0, 1.0, 0.0])
    if determinant < 0:  # a mirrored mesh keeps its outside (sec. 3.7.4)
        faces = faces[:, ::-1]
    sets = {
        int(name[9:]): read(name, ("VEC2",))
        for name in attributes
        if name[:9] == "TEXCOORD_" and name[9:].isdigit()
    }
    colours = read("COLOR_0", ("VEC3", "VEC4")) if "COLOR_0" in attributes else None
    if primitive.get("targets"):
        notes.add("morph targets (the mesh is taken as it rests)")
    material = Material(file, primitive.get("material"), sets, colours, notes)
    if "TANGENT" in attributes and material.has_normals:
        notes.add("tangents of vertices: x of a normal map follows its texture coordinates")
    vertices = vertices @ linear.T + matrix[:3, 3]
    return Piece(vertices, faces, normals, sets.get(0), material.looks)


def _triangles(index: np.ndarray, mode: int) -> np.ndarray:
    """Triangles (F, 3) of a list, strip or fan of indices (sec. 3.7.2.1)."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if len(index) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        return np.stack([index[1:-1], index[2:], np.full(len(index) - 2, index[0])], 1)
    odd = np.arange(len(index) - 2) % 2
    first = np.arange(len(index) - 2)
    return np.stack([index[first], index[first + 1 + odd], index[first + 2 - odd]], 1)
