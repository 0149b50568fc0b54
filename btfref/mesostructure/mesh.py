"""A user's mesh: any file that trimesh reads, with its own materials or a Mitsuba BSDF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure import FROM_FILES
from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.materials import bsdf_from_xml, linear_colours, texture
from btfref.mesostructure.seams import bounds_seams, mesh_seams, refuse

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from PIL.Image import Image
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    from btfref.types import Facts, PathLike

#: Formats whose y axis points up by definition (glTF 2.0, sec. 3.4), and those whose texture coordinates count
#: rows from the bottom when trimesh hands them out.
_Y_UP = (".glb", ".gltf")
_V_UP = (".obj", ".glb", ".gltf")


#: Vertices, faces, normals, texture coordinates, trimesh's visual.
_Piece: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, Any]


def mesh(
    *,
    file: PathLike,
    bsdf: PathLike | None = None,
    tile: str | Sequence[float] = (0.0, 0.0, 1.0, 1.0),
    up: str | None = None,
    allow_seams: bool = False,
) -> Mesostructure:
    """Triangles from a file, one square of which is the tile; its highest point touches the sampling plane.

    Parameters
    ----------
    file : str
        PLY, OBJ, GLB, glTF, STL or OFF. Shading normals are the file's where it has them, else the facets'.
    bsdf : str, optional
        Mitsuba XML file with one BSDF for the whole mesh. None takes the materials of OBJ and glTF files:
        metallic-roughness becomes ``principled`` (base colour, metallic, roughness, and their textures),
        ``Kd`` and ``map_Kd`` become ``diffuse``, or ``principled`` with GGX α = √(2 / (Ns + 2)) where ``Ks``
        is not 0; all two-sided.
    tile : sequence of 4 floats, or "bounds"
        Smallest x and y and largest x and y of one tile, in the mesh's units; a square. "bounds" takes the
        mesh's own bounds.
    up : {"z", "y"}, optional
        Which axis of the file points away from the surface; by default y for glTF, z otherwise.
    allow_seams : bool
        Take a mesh that does not meet its copies.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A file that cannot be read, has no material, or does not tile.
    """
    path = Path(file)
    if up not in (None, "y", "z"):
        raise InputError("axis that points up", field="up", got=repr(up), expected="y or z")
    pieces = _read(path)
    if (up or ("y" if path.suffix.lower() in _Y_UP else "z")) == "y":
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
        pieces = [(v @ turn.T, f, None if n is None else n @ turn.T, *rest) for v, f, n, *rest in pieces]
    square = _square(tile, pieces, path)
    pieces = [((v - square[0]) / square[1], *rest) for v, *rest in pieces]
    top = max(v[np.unique(f), 2].max() for v, f, *_ in pieces)
    pieces = [(v - [0, 0, top], *rest) for v, *rest in pieces]

    count = np.cumsum([0, *(len(piece[0]) for piece in pieces)])
    vertices = np.concatenate([piece[0] for piece in pieces])
    faces = np.concatenate([piece[1] + first for piece, first in zip(pieces, count, strict=False)])
    used = vertices[np.unique(faces), :2]
    seams = bounds_seams(used.min(0), used.max(0)) or mesh_seams(vertices, faces)
    refuse(seams, file=path, allow=allow_seams)

    shared = None if bsdf is None else bsdf_from_xml(bsdf)
    parts = []
    for vertices, faces, normals, uv, visual in pieces:
        material, textures = shared or _own_material(visual, path)
        parts.append(Part(vertices, faces, material, normals=normals, uv=uv, textures=textures))
    parameters = {
        "file": str(file),
        "bsdf": None if bsdf is None else str(bsdf),
        "tile": tile if isinstance(tile, str) else [float(value) for value in tile],
        "up": up,
        "allow_seams": bool(allow_seams),
    }
    return Mesostructure("mesh", parameters, tuple(parts))


def _read(path: Path) -> list[_Piece]:
    """Pieces of a file as (vertices, faces, normals or None, uv or None, trimesh's visual)."""
    import trimesh

    if not path.is_file():
        raise InputError("no such file", file=path, field="file")
    if path.suffix.lower() not in FROM_FILES["mesh"]:
        expected = f"one of {', '.join(FROM_FILES['mesh'])}"
        raise InputError("kind of mesh", file=path, field="file", expected=expected)
    try:
        # Attributes of a piece depend on its kind, which trimesh does not state: points have no faces.
        meshes: list[Any] = trimesh.load_scene(path, process=False).dump()
    except Exception as error:  # every format has exceptions of its own
        raise InputError("cannot read the mesh", file=path, field="file", got=error) from None
    pieces = []
    for piece in meshes:
        faces = np.asarray(getattr(piece, "faces", np.zeros((0, 3))))
        vertices = np.asarray(piece.vertices, np.float64)
        if not len(faces):
            continue
        if not np.isfinite(vertices).all():
            raise InputError("vertex that is not finite", file=path, field="file")
        # The property computes normals where the file has none; only its cache tells which.
        has_normals = "vertex_normals" in piece._cache.cache
        normals = np.asarray(piece.vertex_normals, np.float64) if has_normals else None
        uv = getattr(piece.visual, "uv", None)
        if uv is not None:
            uv = np.asarray(uv, np.float64).copy()
            if path.suffix.lower() in _V_UP:
                uv[:, 1] = 1 - uv[:, 1]
        pieces.append((vertices, faces, normals, uv, piece.visual))
    if not pieces:
        raise InputError("no triangles", file=path, field="file")
    return pieces


def _square(tile: str | Sequence[float], pieces: list[_Piece], path: Path) -> tuple[np.ndarray, float]:
    """Corner of the tile in the file's units, (3,), and its side."""
    used = np.concatenate([v[np.unique(f), :2] for v, f, *_ in pieces])
    if isinstance(tile, str):
        if tile != "bounds":
            raise InputError("tile of the mesh", field="tile", got=repr(tile), expected="4 numbers or bounds")
        corners = np.array([used.min(0), used.max(0)])
    else:
        corners = np.asarray(tile, np.float64)
        if corners.shape != (4,) or not np.isfinite(corners).all():
            raise InputError("tile of the mesh", field="tile", got=tile, expected="4 numbers or bounds")
        corners = corners.reshape(2, 2)
    side = corners[1] - corners[0]
    if side.min() <= 0 or abs(side[0] / side[1] - 1) > 1e-4:
        got = f"{side[0]:.6g} x {side[1]:.6g}"
        raise InputError("tile of the mesh", file=path, field="tile", got=got, expected="a square")
    return np.append(corners[0], 0.0), float(side.max())


def _own_material(visual: Any, path: Path) -> tuple[Facts, dict[str, np.ndarray]]:
    """BSDF and textures of a piece's material."""
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    material = getattr(visual, "material", None)
    textures: dict[str, np.ndarray] = {}
    if isinstance(material, PBRMaterial):
        inner = _metallic_roughness(material, textures, path)
    elif isinstance(material, SimpleMaterial):
        inner = _wavefront(material, textures, path)
    else:
        raise InputError(
            "the mesh has no material (vertex colours are not read)",
            file=path,
            field="bsdf",
            expected="a Mitsuba XML file",
        )
    return {"type": "twosided", "bsdf": inner}, textures


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


def _metallic_roughness(material: PBRMaterial, textures: dict[str, np.ndarray], path: Path) -> Facts:
    """The metallic-roughness model of glTF 2.0 (sec. 3.9.2) as ``principled``; absent factors are 1."""
    result = {
        "type": "principled",
        "base_color": _coloured(
            material.baseColorTexture, _factor(material.baseColorFactor, 1.0), "base_color", textures, path
        ),
        "specular": 0.5,
    }
    packed = material.metallicRoughnessTexture
    # Green is roughness, blue metallic, both plain numbers; principled's α is the square of its roughness too.
    for name, factor, channel in (
        ("roughness", material.roughnessFactor, 1),
        ("metallic", material.metallicFactor, 2),
    ):
        factor = 1.0 if factor is None else float(factor)
        if packed is None:
            result[name] = factor
        else:
            pixels = _image(packed, path, name)[..., channel : channel + 1]
            textures[name] = (pixels * (factor / 255.0)).astype(np.float32)
            result[name] = texture(name)
    return result


def _wavefront(material: SimpleMaterial, textures: dict[str, np.ndarray], path: Path) -> Facts:
    """``Kd``, ``map_Kd``, ``Ks`` and ``Ns`` of a Wavefront material."""
    image, values = material.image, material.kwargs
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
