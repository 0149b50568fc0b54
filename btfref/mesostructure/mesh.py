"""A user's mesh: glTF, and any file that trimesh reads, with its own materials or a Mitsuba BSDF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure import FROM_FILES
from btfref.mesostructure.base import Mesostructure
from btfref.mesostructure.coverage import refuse_gaps, refuse_undersides
from btfref.mesostructure.materials import bsdf_from_xml
from btfref.mesostructure.readers.gltf import read_gltf
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.readers.pieces import Look, Piece
from btfref.mesostructure.readers.plain import read_plain
from btfref.mesostructure.seams import bounds_seams, mesh_seams, refuse

if TYPE_CHECKING:
    from btfref.types import PathLike

#: Formats whose y axis points up by definition (glTF 2.0, sec. 3.4).
_Y_UP = (".glb", ".gltf")


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
        metallic-roughness becomes ``principled`` (base colour, metallic, roughness, their textures, colours of
        vertices, normal maps, and opacity by the alpha mode, see `btfref.mesostructure.readers.gltf_materials`),
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
        A file that cannot be read, has no material or one that emits light, does not tile, leaves a part of the
        tile empty, or shows the back of a material that reflects on its front alone.
    """
    path = Path(file)
    if up not in (None, "y", "z"):
        raise InputError("axis that points up", field="up", got=repr(up), expected="y or z")
    notes = Notes()
    pieces = read_mesh(path, notes, up=up)
    corner, side = _square(tile, pieces, path)
    pieces = [with_area(piece.moved(np.eye(3) / side, -corner / side)) for piece in pieces]
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise InputError("no triangle with an area", file=path, field="file")
    top = max(piece.vertices[np.unique(piece.faces), 2].max() for piece in pieces)
    pieces = [piece.moved(np.eye(3), np.array([0, 0, -top])) for piece in pieces]

    count = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    faces = np.concatenate([piece.faces + first for piece, first in zip(pieces, count, strict=False)])
    used = vertices[np.unique(faces), :2]
    seams = bounds_seams(used.min(0), used.max(0)) or mesh_seams(vertices, faces)
    refuse(seams, file=path, allow=allow_seams)
    refuse_gaps(vertices, faces, file=path, allow=allow_seams)

    shared = None if bsdf is None else Look(*bsdf_from_xml(bsdf))
    parts = [part for piece in pieces for part in piece.parts(shared)]
    refuse_undersides(parts, file=path)
    parameters = {
        "file": str(file),
        "bsdf": None if bsdf is None else str(bsdf),
        "tile": tile if isinstance(tile, str) else [float(value) for value in tile],
        "up": up,
        "allow_seams": bool(allow_seams),
    }
    return Mesostructure("mesh", parameters, tuple(parts), notes.lines())


def read_mesh(path: Path, notes: Notes, *, up: str | None = None) -> list[Piece]:
    """Pieces of a mesh file as it places them, z up.

    Parameters
    ----------
    path : Path
    notes : Notes
        Takes what is ignored.
    up : {"z", "y"}, optional
        Which axis of the file points up; by default y for glTF, z otherwise.

    Returns
    -------
    list of Piece

    Raises
    ------
    InputError
        For a file that cannot be read, or without triangles.
    """
    pieces = _read(path, notes)
    if (up or ("y" if path.suffix.lower() in _Y_UP else "z")) == "y":
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
        pieces = [piece.moved(turn, np.zeros(3)) for piece in pieces]
    return pieces


def with_area(piece: Piece) -> Piece:
    """The piece without triangles that have no area: nothing sees them, and they have no side."""
    corners = piece.vertices[piece.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    longest = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(1)
    # float32 is what is traced: a sliver thinner than its rounding has no area there.
    return piece if (kept := area > 1e-12 * np.maximum(longest, 1e-30)).all() else piece.only(kept)


def _read(path: Path, notes: Notes) -> list[Piece]:
    """Pieces of a file, in its own axes."""
    if not path.is_file():
        raise InputError("no such file", file=path, field="file")
    suffix = path.suffix.lower()
    if suffix not in FROM_FILES["mesh"]:
        expected = f"one of {', '.join(FROM_FILES['mesh'])}"
        raise InputError("kind of mesh", file=path, field="file", expected=expected)
    pieces = read_gltf(path, notes) if suffix in _Y_UP else read_plain(path, notes)
    for piece in pieces:
        if not np.isfinite(piece.vertices).all():
            raise InputError("vertex that is not finite", file=path, field="file")
    if not pieces:
        raise InputError("no triangles", file=path, field="file")
    return pieces


def _square(tile: str | Sequence[float], pieces: list[Piece], path: Path) -> tuple[np.ndarray, float]:
    """Corner of the tile in the file's units, (3,), and its side."""
    used = np.concatenate([piece.vertices[np.unique(piece.faces), :2] for piece in pieces])
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
