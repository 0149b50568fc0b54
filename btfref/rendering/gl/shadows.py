"""What shaders need to cast shadows: maps of triangles, a tree of boxes, and the exact shapes.

A shadow map has the triangle that is nearest to a light, in tiles of one texture. It holds no depths (Williams 1978)
but triangles, and ``shaders/lib/light/shadows.glsl`` meets them with the shadow ray itself: the map only finds
candidates. What is wholly lit or wholly in shadow is then as a ray tracer has it, without a bias, and the border of a
shadow is as sharp as the picture's samples. A light with a direction has one tile around what casts shadows; one with a
position has one as well where that fits a cone, and the six of a cube otherwise.

Hundreds of points that stand for an area light have no maps: their tiles would be few texels wide, and hide what is
finer. Their shadow rays go through a tree of boxes instead, as a ray tracer's do, and so do those of lights for whose
tiles there is no room. Spheres, disks and cylinders are in neither: each of them is met as such.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.rendering.gl import device
from btfref.rendering.gl.box_tree import box_tree
from btfref.scene.shadows.occluders import casters_of
from btfref.scene.shapes import neighbours
from btfref.scene.surfaces.quadrics import KINDS
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.scene.description import Light, SceneDescription
    from btfref.scene.shapes import MeshDescription
    from btfref.scene.surfaces.quadrics import Quadric


#: Texels along a tile for each pixel along the picture, and at least and at most: where both show the same, what hides
#: between texels is narrower than the border of a shadow in :mod:`btfref.scene.shadows.borders`.
PER_PIXEL, LEAST, MOST = 8, 1024, 4096

#: Side of all tiles together at most, in texels.
ATLAS = 8192

#: Share of a tile's side that is left free at each border, four texels of the smallest: lookups read the neighbours.
RIM = 4 / LEAST

#: Tangent of half the angle of the widest cone that one tile shows: 60°, where a texel at the rim sees a quarter of the
#: angle that one in the middle sees.
WIDEST = 3**0.5

#: Lights of one picture where rays go through the tree: llvmpipe ends a fragment's loops after 65 535 steps together,
#: and a ray has hundreds.
TRACED = 16

#: Share by which a sphere around a scene is larger in Mitsuba: math::RayEpsilon.
_LARGER = 1 + 1500 * 2.0**-24


@dataclass(frozen=True)
class View:
    """What one tile shows.

    Parameters
    ----------
    matrix : ndarray of float64, shape (4, 4)
        From the world: x, y and w in clip coordinates, −w … w; z is the depth between 0 and 1, linear.
    texel : float
        Size of a texel at w = 1 as a share of the tile: its larger side in world units.
    """

    matrix: np.ndarray
    texel: float


class ShadowMaps:
    """What casts the shadows of a scene, on the GPU; maps are drawn once: neither scene nor lights move.

    Parameters
    ----------
    ctx : moderngl.Context
    scene : SceneDescription

    Attributes
    ----------
    defines : dict
        For the composer; empty where nothing casts a shadow.
    textures : dict of str to moderngl.Texture
        By sampler name.
    uniforms : dict
    traced : int
        Number of lights whose rays go through the tree.
    milliseconds : float
        That it took to draw the maps, without compilation.
    """

    def __init__(self, ctx: JitArray, scene: SceneDescription) -> None:
        self.defines: dict[str, int] = {}
        self.textures: dict[str, JitArray] = {}
        self.uniforms: dict[str, Any] = {}
        self.milliseconds, self.traced = 0.0, 0
        by_light = casters_of(scene.lights, scene.meshes)
        chosen = sorted(set().union(*by_light))
        if not chosen:
            return
        exact = [number for number in chosen if scene.meshes[number].quadric is not None]
        self._quadrics = {number: k for k, number in enumerate(exact)}
        drawn = [number for number in chosen if number not in self._quadrics]
        table, spans = occluder_table([scene.meshes[number] for number in drawn])
        limit = min(ctx.info["GL_MAX_TEXTURE_SIZE"], ATLAS)
        views: list[View] = []
        draws: list[list[tuple[int, int]]] = []
        ways, through_tree = [], set()
        for light, numbers in zip(scene.lights, by_light, strict=True):
            met = [number for number in numbers if number not in self._quadrics]
            points = _positions([scene.meshes[number] for number in met])
            own = light_views(light, points) if len(points) and light.kind != "area" else []
            if len(views) + len(own) > (limit // LEAST) ** 2:
                own = []
            traced = len(points) > 0 and not own
            if traced:
                through_tree |= set(met)
                self.traced += 1
            ways.append((len(views), len(views) + len(own), float(traced), 0.0))
            views += own
            draws += [[spans[drawn.index(number)] for number in met]] * len(own)
        columns = math.ceil(len(views) ** 0.5)
        wanted = 2 ** math.ceil(math.log2(PER_PIXEL * max(scene.camera.width, scene.camera.height)))
        size = min(max(wanted, LEAST), MOST, limit // max(columns, 1))
        corners = [(size * (k % columns), size * (k // columns)) for k in range(len(views))]
        tiles = [(*c, size, view.texel / size) for c, view in zip(corners, views, strict=True)]
        tree, leaves = _tree(table, [spans[drawn.index(number)] for number in sorted(through_tree)])
        rays = _rays(scene.lights, _positions(scene.meshes))
        parts = [
            table,
            np.stack([rays, np.array(ways)], 1),
            np.array([[*view.matrix, tile] for view, tile in zip(views, tiles, strict=True)]),
            quadric_table([quadric for n in exact if (quadric := scene.meshes[n].quadric) is not None]),
            tree,
            leaves,
        ]
        texels = [np.asarray(part, np.float32).reshape(-1, 4) for part in parts]
        starts = np.cumsum([0, *map(len, texels)]).tolist()
        self.defines = {"SHADOWS": 1, "SHADOW_VIEWS": len(views), "SHADOW_QUADRICS": len(exact)}
        self.defines["SHADOW_TRACED"] = int(self.traced > 0)
        self.uniforms = {"shadow_at": tuple(starts[1:5])}
        self._leaves = starts[5]
        self.textures["occluders"] = device.upload(ctx, np.concatenate(texels), "occluders")
        if views:
            atlas = size * columns, size * -(-len(views) // columns)
            self.textures["shadow_map"] = texture = ctx.texture(atlas, 1, dtype="f4")
            texture.filter = (ctx.NEAREST, ctx.NEAREST)
            self._draw(ctx, views, draws, corners, size)

    def uniforms_of(self, mesh: int) -> dict[str, Any]:
        """Uniforms of one mesh of the scene: which of the exact shapes it is."""
        return {"shadow_own": (self._quadrics.get(mesh, -1), self._leaves)} if self.defines else {}

    def _draw(
        self,
        ctx: JitArray,
        views: Sequence[View],
        draws: Sequence[Sequence[tuple[int, int]]],
        corners: Sequence[tuple[int, int]],
        size: int,
    ) -> None:
        """Fill the tiles; ``draws`` has the first triangle and the number of triangles of what each of them shows."""
        texture = self.textures["shadow_map"]
        depth = ctx.depth_renderbuffer(texture.size)
        target = ctx.framebuffer([texture], depth)
        program = device.compile_program(ctx, "hosts/shadow.vert", "hosts/shadow.frag")
        vertices = ctx.vertex_array(program, [])
        try:
            target.use()
            ctx.disable(ctx.BLEND | ctx.CULL_FACE)
            ctx.enable(ctx.DEPTH_TEST)
            ctx.depth_func = "<"
            ctx.finish()
            start = time.perf_counter()
            target.clear(0.0, 0.0, 0.0, 0.0)
            device.bind(program, {"occluders": self.textures["occluders"]})
            for view, spans, corner in zip(views, draws, corners, strict=True):
                target.viewport = (*corner, size, size)
                device.set_uniforms(program, {"view": view.matrix.T})
                for first, count in spans:
                    vertices.render(ctx.TRIANGLES, vertices=3 * count, first=3 * first)
            ctx.finish()
            self.milliseconds = 1e3 * (time.perf_counter() - start)
        finally:
            for thing in (vertices, program, target, depth):
                thing.release()

    def release(self) -> None:
        """Give the textures back."""
        for texture in self.textures.values():
            texture.release()


def occluder_table(meshes: Sequence[MeshDescription]) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Triangles of several meshes as ``shaders/lib/light/shadows.glsl`` reads them.

    Parameters
    ----------
    meshes : sequence of MeshDescription

    Returns
    -------
    table : ndarray of float32, shape (m, 4, 4)
        Three corners, then the triangles across the edges that are opposite to them; −1 where there is none.
    spans : list of (int, int)
        First triangle and number of triangles of each mesh.

    Raises
    ------
    InputError
        For more triangles than float32 counts.
    """
    counts = [len(mesh.faces) for mesh in meshes]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    if first[-1] >= 1 << 24:
        raise InputError("too many triangles for float32 indices", field="shadows", got=int(first[-1]))
    table = np.zeros((first[-1], 4, 4), np.float32)
    for mesh, start, count in zip(meshes, first, counts, strict=False):
        own = table[start : start + count]
        own[:, :3, :3] = mesh.positions[mesh.faces]
        across = neighbours(mesh.positions, mesh.faces)
        own[:, 3, :3] = np.where(across < 0, -1, across + start)
    return table, list(zip(first[:-1].tolist(), counts, strict=True))


def quadric_table(quadrics: Sequence[Quadric]) -> np.ndarray:
    """Spheres, disks and cylinders as ``shaders/lib/light/occluders.glsl`` reads them.

    Parameters
    ----------
    quadrics : sequence of Quadric

    Returns
    -------
    ndarray of float64, shape (n, 4, 4)
        Rows of the matrix to the canonical frame, without its shift; the origin of that in world space, and the kind.
    """
    table = np.zeros((len(quadrics), 4, 4))
    for row, quadric in zip(table, quadrics, strict=True):
        row[:3, :3] = np.linalg.inv(quadric.to_world[:3, :3])
        row[3, :3], row[3, 3] = quadric.to_world[:3, 3], KINDS[quadric.plugin]
    return table


def _tree(table: np.ndarray, spans: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and leaves of a tree of the triangles in some spans of an occluder table."""
    if not spans:
        return np.zeros((0, 2, 4)), np.zeros((0, 4))
    numbers = np.concatenate([first + np.arange(count) for first, count in spans])
    return box_tree(table[numbers, :3, :3], numbers)


def light_views(light: Light, points: np.ndarray) -> list[View]:
    """Tiles that show all points as a light sees them.

    Parameters
    ----------
    light : Light
        With a position, unless its kind is "directional".
    points : ndarray of float64, shape (n, 3)

    Returns
    -------
    list of View
    """
    if light.kind == "directional":
        frame = _frame(-light.position)
        seen = points @ frame.T
        low, high = seen.min(0), seen.max(0)
        matrix = np.eye(4)
        matrix[:3, :3] = frame
        return [_fitted(matrix, low, high)]
    away = points - light.position
    distance = np.linalg.norm(away, axis=1)
    far = float(distance.max())
    axis = 0.5 * (points.min(0) + points.max(0)) - light.position
    length = np.linalg.norm(axis)
    if length > 0:
        frame = _frame(axis / length)
        seen = away @ frame.T
        if (seen[:, 2] > 0).all() and (np.abs(seen[:, :2]) <= WIDEST * seen[:, 2:]).all():
            slopes = seen[:, :2] / seen[:, 2:]
            low, high = np.append(slopes.min(0), 0.0), np.append(slopes.max(0), far)
            return [_fitted(_from(light.position, frame), low, high)]
    return [
        _fitted(_from(light.position, _frame(sign * axis)), np.array([-1, -1, 0.0]), np.array([1, 1, far]))
        for axis in np.eye(3)
        for sign in (1.0, -1.0)
    ]


def _frame(forward: np.ndarray) -> np.ndarray:
    """Rows: two directions across and ``forward``."""
    from btfref.scene.shapes import coordinate_system

    s = coordinate_system(forward[None])[0]
    return np.stack([s, np.cross(forward, s), forward])


def _from(position: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Coordinates seen from a position; w is the distance along the axis."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = frame, -frame @ position
    matrix[3] = matrix[2]
    return matrix


def _fitted(matrix: np.ndarray, low: np.ndarray, high: np.ndarray) -> View:
    """The view of ``matrix`` whose x, y and depth between ``low`` and ``high`` fill the tile up to its border."""
    size = np.maximum(high - low, 1e-6 * max(1e-30, float((high - low).max())))
    inner = 1 - 2 * RIM
    scale, centre = 2 * inner / size[:2], 0.5 * (low + high)[:2]
    made = matrix.copy()
    made[:2] = scale[:, None] * (matrix[:2] - centre[:, None] * matrix[3])
    # Depths at both ends are kept off the clear value.
    made[2] = 0.98 * (matrix[2] - low[2] * np.eye(4)[3]) / size[2] + 0.01 * np.eye(4)[3]
    return View(made, float(size[:2].max() / inner))


def _rays(lights: Sequence[Light], points: np.ndarray) -> np.ndarray:
    """Position and 0, or direction and length of a ray, of every light; shape (n, 4).

    Mitsuba's shadow rays towards a directional light end twice the radius of a sphere around the scene away.
    """
    low, high = points.min(0), points.max(0)
    length = 2 * _LARGER * np.linalg.norm(0.5 * (high - low))
    return np.array([[*light.position, length if light.kind == "directional" else 0.0] for light in lights])


def _positions(meshes: Sequence[MeshDescription]) -> np.ndarray:
    """Corners of all triangles, shape (n, 3)."""
    used = [np.asarray(mesh.positions, float)[np.unique(mesh.faces)] for mesh in meshes]
    return np.concatenate(used) if used else np.zeros((0, 3))
