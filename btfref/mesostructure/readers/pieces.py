"""What readers of meshes hand on: triangles with everything that their materials ask of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from btfref.mesostructure.base import Part

if TYPE_CHECKING:
    from btfref.types import Facts


@dataclass
class Look:
    """A material with all that it looks up: what `Part` has besides triangles.

    Attributes
    ----------
    bsdf : dict
    textures : dict of str to ndarray
    uv : ndarray (V, 2) or None
        Texture coordinates as Mitsuba has them; None takes those of the piece.
    attributes : dict of str to ndarray (V, k)
    faces : ndarray (F,) bool or None
        Which faces of the piece look so; None for all.
    """

    bsdf: Facts
    textures: dict[str, np.ndarray] = field(default_factory=dict)
    uv: np.ndarray | None = None
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    faces: np.ndarray | None = None


@dataclass
class Piece:
    """Triangles of one material.

    Attributes
    ----------
    vertices : ndarray (V, 3)
        In the file's units.
    faces : ndarray (F, 3)
    normals : ndarray (V, 3) or None
        Unit shading normals.
    uv : ndarray (V, 2) or None
        First set of texture coordinates, v = 0 the first row of an image.
    looks : callable
        ``looks(piece) -> list of Look``: the file's own material; raises InputError where it cannot be had.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    looks: Looks

    def moved(self, matrix: np.ndarray, offset: np.ndarray) -> Piece:
        """The piece with ``vertices @ matrix.T + offset``; the matrix is a rotation times a number."""
        normals = self.normals
        if normals is not None:
            normals = normals @ (matrix / np.linalg.norm(matrix[0])).T
        return Piece(self.vertices @ matrix.T + offset, self.faces, normals, self.uv, self.looks)

    def only(self, faces: np.ndarray) -> Piece:
        """The piece with some of its faces, by a mask."""
        return Piece(self.vertices, self.faces[faces], self.normals, self.uv, self.looks)

    def parts(self, shared: Look | None) -> list[Part]:
        """Parts with the file's own material, or with another."""
        parts = []
        for look in self.looks(self) if shared is None else [shared]:
            parts.append(
                Part(
                    self.vertices,
                    self.faces if look.faces is None else self.faces[look.faces],
                    look.bsdf,
                    normals=self.normals,
                    uv=self.uv if look.uv is None else look.uv,
                    textures=look.textures,
                    attributes=look.attributes,
                )
            )
        return parts


Looks: TypeAlias = Callable[[Piece], list[Look]]


def mirrored(piece: Piece, uv: np.ndarray) -> np.ndarray:
    """Faces whose images are seen mirrored, v pointing down in images.

    Parameters
    ----------
    piece : Piece
    uv : ndarray (V, 2)
        v = 0 is an image's first row.

    Returns
    -------
    ndarray (F,) bool
    """
    corners, place = piece.vertices[piece.faces], uv[piece.faces]
    facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Mitsuba turns a face to the side of its shading normals.
    turned = 1.0 if piece.normals is None else np.einsum("fx,fx->f", facet, piece.normals[piece.faces].sum(1))
    d1, d2 = place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]
    return (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) * turned > 0
