"""Shapes as triangles in world space, with Mitsuba's parametrization and frames."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.frames import Turn, nearest_turn
from btfref.scene.reading.instances import Where
from btfref.scene.surfaces.materials import PlainMaterial
from btfref.scene.surfaces.quadrics import KINDS, Quadric
from btfref.types import JitArray, PathLike

#: Segments of a full turn of a tessellated sphere, disk or cylinder: chords lie within 4e-5 radii of the
#: surface.
SEGMENTS = 384


#: Positions, normals, texture coordinates, faces, and the matrix to the shape's own frame.
Tessellation = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class BtfMaterial:
    """What a ``btf`` BSDF says.

    Parameters
    ----------
    filename : str
        Absolute path of the representation.
    filter_type : str or None
        "nearest" or "bilinear"; None leaves it to the file.
    scale : float
        Factor on B.
    to_uv : ndarray, shape (2, 3)
        Texture coordinates of the lookup are ``to_uv @ (u, v, 1)``; the linear part is not singular and may mirror.
    twosided : bool
        Inside a ``twosided`` BSDF.
    lod : {"auto", "distance", "none"}
        How the level of detail is chosen, for methods with levels.
    lod_bias, lod_unit : float
        Added to it; distance at which it is 0 in mode "distance".
    interpolation : {"blended", "drawn"}
        Between measured views.
    """

    filename: str
    filter_type: str | None
    scale: float
    to_uv: np.ndarray
    twosided: bool
    lod: str = "auto"
    lod_bias: float = 0.0
    lod_unit: float = 1.0
    interpolation: str = "blended"

    #: Real time shows it as it is.
    exact: ClassVar[bool] = True

    @property
    def turn(self) -> Turn:
        """What takes local directions to the frame of the transformed texture."""
        return nearest_turn(self.to_uv[:, :2])


#: What a shape shows.
Shown = BtfMaterial | PlainMaterial


@dataclass(frozen=True)
class MeshDescription:
    """Triangles of one shape, in world space.

    Parameters
    ----------
    name : str
        Identifier in the scene.
    plugin : str
        Mitsuba plugin of the shape.
    positions : ndarray of float, shape (n, 3)
    normals : ndarray of float, shape (n, 3), or None
        Shading normals, to be normalised once they are interpolated: unit vectors but where an instance stretches them.
        None means geometric ones.
    uv : ndarray of float, shape (n, 2)
    faces : ndarray of int, shape (m, 3)
        Counter-clockwise around the geometric normal.
    flip : bool
        Both normals point to the other side.
    material : BtfMaterial or None
        None for any other BSDF.
    bsdf : str
        Plugin of the BSDF, for messages.
    to_world : ndarray, shape (4, 4)
        The shape's own transform, as written in the scene, and its instance's (the positions have it already).
    where : btfref.scene.reading.instances.Where
        Which of Mitsuba's shapes it is.
    emission : ndarray, shape (3,)
        Radiance of its own light on the side of its shading normal, in W/(m² sr).
    quadric : btfref.scene.surfaces.quadrics.Quadric or None
        Of a sphere, disk or cylinder, whose triangles are an approximation.
    plain : btfref.scene.surfaces.materials.PlainMaterial or None
        What is shown of a material that is no BTF.
    """

    name: str
    plugin: str
    positions: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray
    faces: np.ndarray
    flip: bool
    material: BtfMaterial | None
    bsdf: str
    to_world: np.ndarray
    where: Where = field(default_factory=lambda: Where(0))
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    quadric: Quadric | None = None
    plain: PlainMaterial | None = None

    @property
    def only_emits(self) -> bool:
        """Whether it is a light without a material: Mitsuba then makes it black."""
        return self.material is None and self.bsdf == "none" and bool(np.any(self.emission > 0))

    @property
    def shown(self) -> Shown:
        """What is shown: the BTF, or what stands for another material.

        Raises
        ------
        InputError
            When it has neither.
        """
        return self.plain if self.material is None and self.plain is not None else self.btf

    @property
    def btf(self) -> BtfMaterial:
        """The material of a shape that has a BTF.

        Raises
        ------
        InputError
            When it has none.
        """
        if self.material is None:
            raise InputError("a btf material is needed", field=self.name, got=self.bsdf)
        return self.material

    @property
    def twosided(self) -> bool:
        """Whether its back is seen as its front is."""
        material = self.material or self.plain
        return material is not None and material.twosided

    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Per-triangle data for shading as Mitsuba 3.9 does it.

        Returns
        -------
        positions, normals : ndarray of float64, shape (m, 3, 3)
            Triangle, corner, xyz.
        uv : ndarray of float64, shape (m, 3, 2)
        dp_du : ndarray of float64, shape (m, 3)
            Constant on each triangle. Where u and v do not span the triangle, the x axis of
            :func:`coordinate_system` around the geometric normal.
        """
        p = self.positions.astype(float)[self.faces]
        uv = self.uv.astype(float)[self.faces]
        dp0, dp1 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        d0, d1 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        geometric = _unit(np.cross(dp0, dp1))
        determinant = d0[:, 0] * d1[:, 1] - d0[:, 1] * d1[:, 0]
        spans = determinant != 0
        safe = np.where(spans, determinant, 1.0)
        dp_du = (d1[:, 1:] * dp0 - d0[:, 1:] * dp1) / safe[:, None]
        dp_du = np.where(spans[:, None], dp_du, coordinate_system(geometric))
        if self.normals is None:
            normals = np.repeat(geometric[:, None], 3, axis=1)
        else:
            normals = self.normals.astype(float)[self.faces]
        return p, -normals if self.flip else normals, uv, dp_du

    def uv_sides(self) -> np.ndarray:
        """On which side of each triangle ∂p/∂u × ∂p/∂v points, shape (m,).

        Returns
        -------
        ndarray of float64
            1: to the side from which its corners are counter-clockwise, as where u and v do not span it; −1: the other.
            The sign of det(∂p/∂u, ∂p/∂v, n) is that of this number times the shading normal's component on that side.
        """
        uv = self.uv.astype(float)[self.faces]
        d0, d1 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        return np.where(d0[:, 0] * d1[:, 1] < d0[:, 1] * d1[:, 0], -1.0, 1.0)

    def hands(self) -> np.ndarray:
        """Sign of det(∂p/∂u, ∂p/∂v, n) at the corners of every triangle, shape (m, 3): −1 where uv are mirrored."""
        p, normals, _, _ = self.corners()
        side = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        return np.where(self.uv_sides()[:, None] * (side[:, None] * normals).sum(-1) < 0, -1.0, 1.0)


def neighbours(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangle across each edge, by position, so that seams of the texture do not separate.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
    faces : ndarray of int, shape (m, 3)

    Returns
    -------
    ndarray of int64, shape (m, 3)
        Column k: across the edge opposite corner k; -1 at borders and where more than two triangles meet.
    """
    corner = np.unique(positions, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    edges = np.sort(np.concatenate([corner[:, [1, 2]], corner[:, [2, 0]], corner[:, [0, 1]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    _, edge, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    pairs = order[count[edge[order]] == 2].reshape(-1, 2)
    result = np.full(len(edges), -1, np.int64)
    result[pairs[:, 0]], result[pairs[:, 1]] = owner[pairs[:, 1]], owner[pairs[:, 0]]
    return result.reshape(3, len(faces)).T


def coordinate_system(n: np.ndarray) -> np.ndarray:
    """First tangent of Mitsuba's frame around unit vectors (Duff et al. 2017, listing 3), shape (..., 3)."""
    x, y, z = np.moveaxis(n, -1, 0)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], -1)


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)


def triangles_of(
    shape: JitArray,
    node: JitArray,
    *,
    file: PathLike,
    name: str,
    outer: np.ndarray,
    btf: bool = True,
    bitmap: bool = False,
) -> dict[str, Any]:
    """Vertices of a shape, read from the instantiated mesh or tessellated.

    Parameters
    ----------
    shape : mitsuba.Shape
        Of a scalar variant.
    node : mitsuba.parser.SceneNode
    file : str
        Scene and line, for messages.
    name : str
        Of the shape, likewise.
    outer : ndarray, shape (4, 4)
        Transform of the instance that shows the shape.
    btf, bitmap : bool
        Whether it shows a BTF, which needs texture coordinates of its own, or a bitmap.

    Returns
    -------
    dict
        ``positions``, ``normals``, ``uv``, ``faces``, ``flip``, ``to_world``, ``quadric`` of :class:`MeshDescription`.

    Raises
    ------
    InputError
        For a shape with a BTF and without texture coordinates, or of a kind that has no triangles here.
    """
    import mitsuba as mi

    props = node.props
    plugin = props.plugin_name()
    to_world = outer @ (np.array(props["to_world"].matrix, float) if "to_world" in props else np.eye(4))
    common = {"to_world": to_world}
    if shape.is_mesh() and plugin not in _TESSELLATIONS:
        if not shape.has_vertex_texcoords() and btf:
            raise InputError("the shape has no texture coordinates", file=file, field=name, got=plugin)
        if plugin == "obj" and (btf or bitmap):
            refuse_partial_uv(props["filename"], scene=file, name=name)
        arrays = mi.traverse(shape)
        normals, flip = None, bool(shape.has_flipped_normals())
        positions = np.array(arrays["vertex_positions"]).reshape(-1, 3)
        if shape.has_vertex_normals():
            normals = np.array(arrays["vertex_normals"]).reshape(-1, 3)
        if not np.array_equal(outer, np.eye(4)):
            positions = positions @ outer[:3, :3].T + outer[:3, 3]
            if normals is None:
                # A mirror turns the order of corners round, and Mitsuba's normals of instances not.
                flip ^= bool(np.linalg.det(outer[:3, :3]) < 0)
            else:
                # Mitsuba interpolates first and transforms then: a common factor keeps the weights of the corners.
                normals = normals @ np.linalg.inv(outer[:3, :3])
                normals /= np.linalg.norm(normals, axis=1).max(initial=1e-30)
        faces = np.array(arrays["faces"]).reshape(-1, 3).astype(np.int64)
        if shape.has_vertex_texcoords():
            uv = np.array(arrays["vertex_texcoords"]).reshape(-1, 2)
        else:
            # Mitsuba's own: barycentric coordinates, in each triangle anew.
            uv = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (len(faces), 1))
            positions = positions[faces].reshape(-1, 3)
            normals = None if normals is None else normals[faces].reshape(-1, 3)
            faces = np.arange(len(uv)).reshape(-1, 3)
        return common | {"positions": positions, "normals": normals, "uv": uv, "faces": faces, "flip": flip}
    if plugin not in _TESSELLATIONS:
        known = ", ".join(["meshes", *_TESSELLATIONS])
        raise InputError(
            "real-time rendering has no such shape", file=file, field=name, got=plugin, expected=known
        )
    positions, normals, uv, faces, local = _TESSELLATIONS[plugin](props)
    matrix = to_world @ local
    # Normals go with the inverse transpose.
    normals = _unit(normals @ np.linalg.inv(matrix[:3, :3]))
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    flip = "flip_normals" in props and bool(props["flip_normals"])
    own = np.linalg.solve(outer, matrix)
    quadric = Quadric.of(plugin, own, flip).moved(outer) if plugin in KINDS else None
    return common | {
        "positions": positions @ matrix[:3, :3].T + matrix[:3, 3],
        "normals": normals,
        "uv": uv,
        "faces": faces,
        "flip": quadric.flip if quadric else flip,
        "quadric": quadric,
    }


#: Faces of an OBJ file, one with texture coordinates, and a corner without.
_FACE = re.compile(rb"^[ \t]*f[ \t][^\r\n#]*", re.MULTILINE)
_UV_CORNER = re.compile(rb"^[ \t]*f[ \t][^\r\n#]*?\d/-?\d", re.MULTILINE)
_BARE_CORNER = re.compile(rb"[ \t]-?\d+(?://-?\d+|/{0,2})(?=\s|$)")


def refuse_partial_uv(file: PathLike, *, scene: PathLike, name: str) -> None:
    """Refuse a Wavefront OBJ some of whose faces have texture coordinates, and others not: Mitsuba makes them up.

    Parameters
    ----------
    file : path-like
        The OBJ.
    scene : str
        Scene and line, for the message.
    name : str
        Of the shape.

    Raises
    ------
    InputError
    """
    if not Path(file).is_file():
        return  # Mitsuba says so
    data = Path(file).read_bytes()
    if not _UV_CORNER.search(data):
        return  # no face has them: not for this message
    if found := next((face for face in _FACE.finditer(data) if _BARE_CORNER.search(face[0])), None):
        line = data.count(b"\n", 0, found.start()) + 1
        raise InputError(
            f"{Path(file).name}, line {line}: a face without texture coordinates among faces that have them",
            file=scene,
            field=name,
            expected="texture coordinates (vt) at every corner of every face",
        )


def _grid(n_u: int, n_v: int) -> tuple[np.ndarray, np.ndarray]:
    """Corner parameters in [0, 1]² of a grid, shape ((n_v + 1)(n_u + 1), 2), and its triangles."""
    u, v = np.meshgrid(np.linspace(0, 1, n_u + 1), np.linspace(0, 1, n_v + 1))
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([u.ravel(), v.ravel()], -1), faces


def _without_slivers(faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Drop the triangles of no area, such as those at a pole."""
    p = positions[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return faces[area > 1e-12 * area.max()]


def _rectangle(props: JitArray) -> Tessellation:
    # u = (x + 1)/2, v = (y + 1)/2: rectangle.cpp of Mitsuba 3.9 (whose texture coordinate buffer says
    # otherwise).
    uv, faces = _grid(1, 1)
    p = np.concatenate([2 * uv - 1, np.zeros((4, 1))], -1)
    return p, np.tile([0.0, 0.0, 1.0], (4, 1)), uv, faces, np.eye(4)


def _sphere(props: JitArray) -> Tessellation:
    # u = azimuth / 2π, v = polar angle / π: sphere.cpp of Mitsuba 3.9.
    uv, faces = _grid(SEGMENTS, SEGMENTS // 2)
    phi, theta = 2 * np.pi * uv[:, 0], np.pi * uv[:, 1]
    p = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    # A pole has every azimuth: its corner takes the middle of its triangle's.
    at_pole = (uv[:, 1] == 0) | (uv[:, 1] == 1)
    uv[:, 0] += np.where(uv[:, 1] == 0, -0.5 / SEGMENTS, np.where(at_pole, 0.5 / SEGMENTS, 0.0))
    local = np.eye(4)
    radius = float(props["radius"]) if "radius" in props else 1.0
    local[:3, :3] *= radius
    if "center" in props:
        local[:3, 3] = np.array(props["center"], float)
    # theta grows downwards, so the grid's order is clockwise from outside.
    return p, p.copy(), uv, _without_slivers(faces[:, ::-1], p), local


def _disk(props: JitArray) -> Tessellation:
    # u = radius, v = azimuth / 2π: disk.cpp of Mitsuba 3.9.
    uv, faces = _grid(1, SEGMENTS)
    phi = 2 * np.pi * uv[:, 1]
    p = np.stack([uv[:, 0] * np.cos(phi), uv[:, 0] * np.sin(phi), np.zeros(len(uv))], -1)
    return p, np.tile([0.0, 0.0, 1.0], (len(p), 1)), uv, _without_slivers(faces, p), np.eye(4)


def _cylinder(props: JitArray) -> Tessellation:
    # u = azimuth / 2π, v along the axis: cylinder.cpp of Mitsuba 3.9.
    uv, faces = _grid(SEGMENTS, 1)
    phi = 2 * np.pi * uv[:, 0]
    normals = np.stack([np.cos(phi), np.sin(phi), np.zeros(len(uv))], -1)
    p0 = np.array(props["p0"], float) if "p0" in props else np.zeros(3)
    p1 = np.array(props["p1"], float) if "p1" in props else np.array([0.0, 0.0, 1.0])
    radius = float(props["radius"]) if "radius" in props else 1.0
    axis = p1 - p0
    length = np.linalg.norm(axis)
    s = coordinate_system(axis / length)
    local = np.eye(4)
    local[:3] = np.stack([radius * s, radius * np.cross(axis / length, s), axis, p0], -1)
    return np.concatenate([normals[:, :2], uv[:, 1:]], -1), normals, uv, faces, local


_TESSELLATIONS = {"rectangle": _rectangle, "sphere": _sphere, "disk": _disk, "cylinder": _cylinder}
