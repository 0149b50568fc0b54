"""What a mesostructure is: triangle meshes with Mitsuba BSDFs on the periodic unit tile."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.types import Facts

#: How far (tile units) the top may miss z = 0 and geometry may stick out of the tile: float32 rounding of 1.
_SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class Part:
    """One triangle mesh with one material.

    Attributes
    ----------
    vertices : ndarray (V, 3) float64
        Tile units. Geometry may cross the tile's border when its copies fill the gap on the other side.
    faces : ndarray (F, 3) uint32
        Counter-clockwise seen from outside (from above for a height field).
    bsdf : dict
        A Mitsuba BSDF as for ``mi.load_dict``, made of plain JSON types; `materials.load_bsdf` makes it.
    normals : ndarray (V, 3) float64 or None
        Unit shading normals; None shades the facets.
    uv : ndarray (V, 2) float64 or None
        Texture coordinates as Mitsuba has them (v = 0 is an image's first row); None takes x and y.
    textures : dict of str to ndarray
        Images that the BSDF refers to by ``{"type": "bitmap", "array": NAME}``.
    attributes : dict of str to ndarray (V, 1 to 3)
        Numbers of the vertices that the BSDF refers to as ``vertex_NAME``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    bsdf: Facts
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    textures: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    attributes: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.uint32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise InputError("vertices of a mesostructure part", got=vertices.shape, expected="finite (V, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.size == 0 or faces.max() >= len(vertices):
            raise InputError(
                "faces of a mesostructure part", got=faces.shape, expected="(F, 3) vertex indices"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)


def square_below(z: float, bsdf: Facts) -> Part:
    """The whole tile as a flat part at height ``z``, seen from above."""
    square = np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return Part(square, faces, bsdf, normals=np.tile([0.0, 0.0, 1.0], (4, 1)))


@dataclass(frozen=True, eq=False)
class Mesostructure:
    """Periodic geometry on the unit tile; the sampling plane z = 0 touches its top.

    Attributes
    ----------
    name : str
    parameters : dict
        All parameters with defaults filled in, JSON types: they rebuild this mesostructure.
    parts : tuple of Part
    ignored : tuple of str
        What of the user's input has no part in it, one line of each kind.
    """

    name: str
    parameters: Facts = field(repr=False)
    parts: tuple[Part, ...] = field(repr=False)
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "parameters", json.loads(json.dumps(self.parameters)))
        except TypeError as error:
            raise InputError(
                f"parameters of mesostructure '{self.name}' are stored as JSON",
                got=error,
                expected="JSON types",
            ) from None
        if not self.parts:
            raise InputError(f"mesostructure '{self.name}' has no geometry", expected="at least one part")
        low, high = self.height
        if abs(high) > _SLACK:
            raise InputError(
                f"mesostructure '{self.name}' must touch the sampling plane",
                field="height",
                got=high,
                expected="top at z = 0",
            )
        if low < -4.0:
            raise InputError(
                f"mesostructure '{self.name}' is too deep",
                field="height",
                got=low,
                expected="at least -4 tile units",
            )

    @property
    def height(self) -> tuple[float, float]:
        """Lowest and highest z, tile units: ``(low, high)`` with high = 0."""
        z = [part.vertices[np.unique(part.faces), 2] for part in self.parts]
        return float(min(values.min() for values in z)), float(max(values.max() for values in z))

    @property
    def overhang(self) -> float:
        """How far (tile units, ≥ 0) the geometry sticks out of the unit tile on any side."""
        xy = np.concatenate([part.vertices[np.unique(part.faces), :2] for part in self.parts])
        return float(max(0.0, -xy.min(), xy.max() - 1.0))
