"""Meshes of the formats that trimesh reads (PLY, OBJ, STL, OFF), with the materials of OBJ files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.materials import linear_colours, texture
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.readers.pieces import Look, Piece

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from PIL.Image import Image
    from trimesh.visual.material import SimpleMaterial

    from btfref.types import Facts

#: What an MTL file may say that has no part in the BSDF, and what it is.
_UNUSED = {
    "map_bump": "bump map",
    "bump": "bump map",
    "norm": "normal map",
    "disp": "displacement map",
    "map_ks": "map of Ks",
    "map_ns": "map of Ns",
    "map_d": "map of opacity",
    "map_ke": "map of emission",
}


def read_plain(path: Path, notes: Notes) -> list[Piece]:
    """Pieces of a file.

    Parameters
    ----------
    path : Path
    notes : Notes
        Takes what is ignored.

    Returns
    -------
    list of Piece

    Raises
    ------
    InputError
        A file that cannot be read.
    """
    import trimesh

    source: Any = path
    options: dict[str, Any] = {}
    if path.suffix.lower() == ".obj" and (text := _counted_from_the_start(path)) is not None:
        resolver = trimesh.resolvers.FilePathResolver(str(path))
        source, options = io.StringIO(text), {"file_type": "obj", "resolver": resolver}
    try:
        scene: Any = trimesh.load_scene(source, process=False, **options)
    except Exception as error:  # every format has exceptions of its own
        raise InputError("cannot read the mesh", file=path, field="file", got=error) from None
    pieces = []
    for node in scene.graph.nodes_geometry:
        # Taken by hand: trimesh's own way of placing geometry drops its normals.
        matrix, name = scene.graph[node]
        found = scene.geometry[name]
        faces = np.asarray(getattr(found, "faces", np.zeros((0, 3))))  # points have none
        if not len(faces):
            continue
        vertices = np.asarray(found.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        # The property computes normals where the file has none; only its cache tells which.
        has_normals = "vertex_normals" in found._cache.cache
        normals = _unit(np.asarray(found.vertex_normals, np.float64)) if has_normals else None
        uv = getattr(found.visual, "uv", None)
        if uv is not None:
            uv = np.asarray(uv, np.float64).copy()
            if path.suffix.lower() == ".obj":  # its v points up
                uv[:, 1] = 1 - uv[:, 1]
        pieces.append(Piece(vertices, faces, normals, uv, _looks(found.visual, path, notes)))
    return pieces


def _unit(normals: np.ndarray) -> np.ndarray | None:
    """Normals of length 1; None where one is missing."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / length if np.isfinite(length).all() and (length > 0).all() else None


def _counted_from_the_start(path: Path) -> str | None:
    """Text of an OBJ file with indices of faces from the start of their lists; None where all are already.

    Negative ones count back from the line that they stand on; trimesh counts back from the end of the file.
    """
    try:
        lines = path.read_text("utf-8", errors="replace").replace("\\\n", " ").splitlines()
    except OSError as error:
        raise InputError("cannot read the mesh", file=path, field="file", got=error) from None
    count, changed = {"v": 0, "vt": 0, "vn": 0}, False
    for number, line in enumerate(lines):
        word, *rest = line.split("#", 1)[0].split() or [""]
        if word in count:
            count[word] += 1
        elif word == "f" and any("-" in corner for corner in rest):
            corners = []
            for corner in rest:
                places = []
                for kind, place in zip(count, corner.split("/"), strict=False):
                    if place.startswith("-") and place[1:].isdigit():
                        found = count[kind] + 1 + int(place)
                        if found < 1:
                            raise InputError(
                                "index of a face before the first one",
                                file=path,
                                field=f"line {number + 1}",
                                got=place,
                                expected=f"at least -{count[kind]}",
                            )
                        place = str(found)
                    places.append(place)
                corners.append("/".join(places))
            lines[number], changed = "f " + " ".join(corners), True
    return "\n".join(lines) + "\n" if changed else None


def _looks(visual: Any, path: Path, notes: Notes) -> Any:
    """The look of a piece, made when it is asked for."""

    def looks(piece: Piece) -> list[Look]:
        from trimesh.visual.material import SimpleMaterial

        material = getattr(visual, "material", None)
        if not isinstance(material, SimpleMaterial):
            raise InputError(
                "the mesh has no material (vertex colours are read from glTF alone)",
                file=path,
                field="bsdf",
                expected="a Mitsuba XML file",
            )
        textures: dict[str, np.ndarray] = {}
        if material.image is not None and piece.uv is None:
            raise InputError(
                "texture on faces without texture coordinates",
                file=path,
                field=str(getattr(material, "name", None) or "material"),
                expected="vt of every corner, or --bsdf",
            )
        inner = _wavefront(material, textures, path, notes)
        return [Look({"type": "twosided", "bsdf": inner}, textures)]

    return looks


def _image(image: Image, path: Path, what: str) -> np.ndarray:
    """A texture of a mesh as uint8 (rows, columns, 3)."""
    if image.mode in ("RGBA", "LA", "PA") and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
        raise InputError(
            "material with holes (transparent texels)", file=path, field=what, expected="an opaque texture"
        )
    return np.asarray(image.convert("RGB"))


def _factor(value: ArrayLike | None, default: float) -> np.ndarray:
    """A factor of a material as three floats; trimesh keeps colours as bytes."""
    if value is None:
        return np.full(3, default)
    value = np.asarray(value)
    scale = 255.0 if value.dtype.kind == "u" else 1.0
    return value[:3].astype(np.float64) / scale


def _coloured(
    image: Image | None, factor: np.ndarray, name: str, textures: dict[str, np.ndarray], path: Path
) -> Facts:
    """Colour of a material: linear factor times sRGB image."""
    if image is None:
        return {"type": "rgb", "value": [float(value) for value in factor]}
    pixels = _image(image, path, name)
    textures[name] = (linear_colours(pixels) * factor).astype(np.float32)
    return texture(name)


def _wavefront(material: SimpleMaterial, textures: dict[str, np.ndarray], path: Path, notes: Notes) -> Facts:
    """``Kd``, ``map_Kd``, ``Ks`` and ``Ns`` of a Wavefront material."""
    image, values = material.image, material.kwargs
    name = str(getattr(material, "name", None) or "material")
    if np.any(_factor(values.get("ke"), 0.0)):
        raise InputError(
            "material that emits light: a BTF tells what is reflected",
            file=path,
            field=f"{name}: Ke",
            got=values["ke"],
            expected="a material without emission, or --bsdf",
        )
    for key, what in _UNUSED.items():
        if key in values:
            notes.add(f"{what} of a Wavefront material", name)
    if float(np.ravel(values.get("d", 1.0))[0]) < 1 or float(np.ravel(values.get("tr", 0.0))[0]) > 0:
        notes.add("opacity (d, Tr) of a Wavefront material", name)
    diffuse = _factor(values.get("kd"), 1.0 if image is not None else 0.5)
    colour = _coloured(image, diffuse, "diffuse", textures, path)
    if not np.any(_factor(values.get("ks"), 0.0)):
        return {"type": "diffuse", "reflectance": colour}
    alpha = np.sqrt(2.0 / (float(np.ravel(values.get("ns", 0.0))[0]) + 2.0))
    return {
        "type": "principled",
        "base_color": colour,
        "roughness": float(np.sqrt(min(alpha, 1.0))),
        "specular": 0.5,
    }
