"""Shapes that the page shows materials on: those of the shipped scenes, and a user's mesh."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.mesh import read_mesh, with_area
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.readers.pieces import Piece
from btfref.rendering.gl.raster import triangle_table
from btfref.scene.shapes import MeshDescription
from btfref.scene.shipped import scene_file
from btfref.scene.shipped.meshes import surface_mesh
from btfref.types import Facts, PathLike
from btfref.view.packing import Packed

#: Scenes whose shapes are shown.
SHIPPED = ("plane", "sphere", "cloth")

#: Field of view in degrees for a user's mesh, from where it is seen, and how far away in radii.
_FOV, _FROM, _RADII = 37.0, np.array([1.2, -3.1, 1.8]), 3.4


@dataclass(frozen=True)
class Shape:
    """A shape, and how it is first seen.

    Parameters
    ----------
    name : str
    mesh : MeshDescription
        In world space, z up.
    tiling : float
        Tiles of the BTF along a unit of its texture coordinates.
    origin, target : ndarray, shape (3,)
        Of the camera.
    fov : float
        Field of view of the picture's shorter side, in degrees.
    """

    name: str
    mesh: MeshDescription
    tiling: float
    origin: np.ndarray
    target: np.ndarray
    fov: float


def shipped_shapes() -> list[Shape]:
    """Plane, sphere and cloth of the shipped scenes, with their cameras and tilings."""
    return [_shipped(name) for name in SHIPPED]


def _shipped(name: str) -> Shape:
    if name == "plane":
        # Mitsuba's rectangle.
        uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        positions = np.concatenate([2 * uv - 1, np.zeros((4, 1))], 1)
        normals, faces = np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]])
    else:
        positions, normals, uv, faces = surface_mesh(name)
    scene = ElementTree.parse(scene_file(name)).getroot()
    look, fov, tiling = (
        {} if found is None else found.attrib
        for found in (
            scene.find(".//lookat"),
            scene.find("sensor/float[@name='fov']"),
            scene.find("default[@name='tiling']"),
        )
    )
    origin, target = (np.array(look[key].split(","), float) for key in ("origin", "target"))
    mesh = _described(name, positions, normals, uv, faces)
    return Shape(name, mesh, float(tiling["value"]), origin, target, float(fov["value"]))


def mesh_shape(path: PathLike) -> Shape:
    """A user's mesh as a shape.

    Parameters
    ----------
    path : path-like
        OBJ, PLY, GLB, glTF, STL or OFF, with texture coordinates; glTF's y axis becomes z.

    Returns
    -------
    Shape
        One tile of the BTF for a unit of texture coordinates; the camera sees all of it.

    Raises
    ------
    InputError
        For a file that cannot be read, or has no triangle or no texture coordinates.
    """
    path = Path(path)
    pieces, parts = [with_area(piece) for piece in read_mesh(path, Notes())], []
    if not any(len(piece.faces) for piece in pieces):
        raise InputError("no triangle with an area", file=path)
    smooth = all(piece.normals is not None for piece in pieces)
    for piece in pieces:
        if piece.uv is None:
            raise InputError("no texture coordinates", file=path, expected="vt, TEXCOORD_0, or u and v")
        if not np.isfinite(piece.uv).all():
            raise InputError("texture coordinate that is not finite", file=path)
        parts.append(piece.uv)
    first = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    positions = np.concatenate([piece.vertices for piece in pieces])
    normals = np.concatenate([_normals(piece) for piece in pieces]) if smooth else None
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, first, strict=False)])
    mesh = _described(path.stem, positions, normals, np.concatenate(parts), faces)
    centre, radius = _ball(mesh)
    origin = centre + _RADII * radius * _FROM / np.linalg.norm(_FROM)
    return Shape(path.name, mesh, 1.0, origin, centre, _FOV)


def _normals(piece: Piece) -> np.ndarray:
    assert piece.normals is not None
    return piece.normals


def _described(
    name: str, positions: np.ndarray, normals: np.ndarray | None, uv: np.ndarray, faces: np.ndarray
) -> MeshDescription:
    return MeshDescription(
        name=name,
        plugin="ply",
        positions=positions,
        normals=normals,
        uv=uv,
        faces=faces,
        flip=False,
        material=None,
        bsdf="btf",
        to_world=np.eye(4),
    )


def _ball(mesh: MeshDescription) -> tuple[np.ndarray, float]:
    """Centre and radius of a ball around a mesh."""
    used = mesh.positions[np.unique(mesh.faces)]
    centre = (used.min(0) + used.max(0)) / 2
    return centre, float(np.linalg.norm(used - centre, axis=1).max())


def shapes_data(shapes: Sequence[Shape], packed: Packed) -> list[Facts]:
    """Shapes as the page reads them; their triangles go to ``packed``."""
    found = []
    for shape in shapes:
        centre, radius = _ball(shape.mesh)
        table = triangle_table(shape.mesh)
        found.append(
            {
                "name": shape.name,
                "tiling": shape.tiling,
                "origin": shape.origin.tolist(),
                "target": shape.target.tolist(),
                "fov": shape.fov,
                "centre": centre.tolist(),
                "radius": radius,
                "count": len(table),
                "triangles": packed.add(table.reshape(-1)),
            }
        )
    return found
