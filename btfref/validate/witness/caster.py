"""A small ray caster in float64: Mitsuba says which triangle a ray meets, the definition B; the rest is here.

Nothing of the renderers' cameras, frames or lights is used. Axes come from finite differences of the position over the
texture coordinates, the second one on the side of ∂p/∂v; what a texture transform does to them is its polar factor, by
a singular value decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.validate.witness.scene import GRID, SIZE

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.types import JitArray
    from btfref.validate.witness.scene import WitnessScene

#: Step of the finite differences in texture coordinates: position is linear on a triangle, so that any step is exact.
STEP = 0.01

#: Pixels by which a rasterizer may see a sample elsewhere: such pixels are left out.
BESIDE = 1 / 512


@dataclass(frozen=True, eq=False)
class Lookups:
    """What the samples of all pixels ask the definition for, one for each hit and light.

    Attributes
    ----------
    uv, w_light, w_view : ndarray of float64, shape (N, 2), (N, 3), (N, 3)
    power : ndarray, shape (N, 3)
        Irradiance perpendicular to the direction of light, over the number of a pixel's samples.
    pixel : ndarray of int, shape (N,)
        Flat index.
    sure : ndarray of bool, shape (SIZE, SIZE)
        Pixels of which some sample hits and none passes within a rounding of an edge.
    """

    uv: np.ndarray
    w_light: np.ndarray
    w_view: np.ndarray
    power: np.ndarray
    pixel: np.ndarray
    sure: np.ndarray

    def picture(self, evaluate: Callable[..., np.ndarray], some: np.ndarray | None = None) -> np.ndarray:
        """Radiance, shape (SIZE, SIZE, 3): sums of ``power · evaluate(uv, w_light, w_view)``.

        ``some``, bool of shape (SIZE, SIZE), chooses pixels; the others stay black.
        """
        chosen = np.ones(len(self.pixel), bool) if some is None else some.ravel()[self.pixel]
        at = np.flatnonzero(chosen)
        value = self.power[at] * evaluate(self.uv[at], self.w_light[at], self.w_view[at])
        sums = [np.bincount(self.pixel[at], value[:, c], SIZE * SIZE) for c in range(3)]
        return np.stack(sums, -1).reshape(SIZE, SIZE, 3)


def cast(scene: WitnessScene, folder: Path) -> Lookups:
    """Cast the rays of a regular sub-pixel grid.

    Parameters
    ----------
    scene : WitnessScene
    folder : Path
        For the patches' files.

    Returns
    -------
    Lookups
    """
    from btfref.sampling.variant import mitsuba_variant

    polar = np.linalg.svd(scene.to_uv)
    turn = polar[0] @ polar[2]
    parts: list[list[np.ndarray]] = []
    sure, seen = np.ones(SIZE * SIZE, bool), np.zeros(SIZE * SIZE, bool)
    with mitsuba_variant("llvm_ad_rgb") as mi:
        made = mi.load_dict({"type": "scene", **scene.write(folder)})
        triangles = [_triangles(mi, shape) for shape in made.shapes()]
        for number in range(GRID * GRID):
            offset = np.array([number % GRID, number // GRID]) + 0.5
            ray = _rays(scene, offset / GRID)
            found = _met(mi, made, scene, ray)
            for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
                beside = _rays(scene, offset / GRID + BESIDE * np.array([x, y]))
                sure &= (_met(mi, made, scene, beside) == found).all(0)
            for which, corners in enumerate(triangles):
                at = np.flatnonzero(found[0] == which)
                seen[at] = True
                parts += _shaded(scene, [c[found[1, at]] for c in corners], ray[at], turn, at)
    uv, w_light, w_view, power, pixel = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Lookups(uv, w_light, w_view, power / GRID**2, pixel, (sure & seen).reshape(SIZE, SIZE))


def _rays(scene: WitnessScene, offset: np.ndarray) -> np.ndarray:
    """Unit directions through the point ``offset`` of every pixel, from its top left corner, row by row."""
    forward = _unit(np.subtract(scene.target, scene.origin))
    right = _unit(np.cross(forward, scene.up))
    up = np.cross(right, forward)
    row, column = np.divmod(np.arange(SIZE * SIZE), SIZE)
    half = np.tan(np.radians(scene.fov) / 2)
    x, y = half * (2 * (column + offset[0]) / SIZE - 1), half * (1 - 2 * (row + offset[1]) / SIZE)
    return _unit(forward + x[:, None] * right + y[:, None] * up)


def _met(mi: JitArray, made: JitArray, scene: WitnessScene, ray: np.ndarray) -> np.ndarray:
    """Number of the shape and of its triangle that each ray meets, −1 for none; shape (2, N)."""
    import drjit as dr

    rays = mi.Ray3f(mi.Point3f(list(scene.origin)), mi.Vector3f(np.ascontiguousarray(ray.T, np.float32)))
    found = made.ray_intersect_preliminary(rays, False)
    shape = dr.full(mi.Int32, -1, len(ray))
    for number, one in enumerate(made.shapes()):
        shape = dr.select(found.is_valid() & (found.shape == mi.ShapePtr(one)), number, shape)
    triangle = dr.select(shape >= 0, mi.Int32(found.prim_index), -1)
    return np.stack([np.array(shape), np.array(triangle)])


def _triangles(mi: JitArray, shape: JitArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, shading normals and texture coordinates of the corners, as Mitsuba holds them in world space."""
    values = mi.traverse(shape)
    faces = np.array(values["faces"]).reshape(-1, 3).astype(int)
    columns = {"vertex_positions": 3, "vertex_normals": 3, "vertex_texcoords": 2}
    position, normal, uv = (
        np.array(values[name], float).reshape(-1, n)[faces] for name, n in columns.items()
    )
    return position, -normal if shape.has_flipped_normals() else normal, uv


def _shaded(
    scene: WitnessScene, corners: list[np.ndarray], ray: np.ndarray, turn: np.ndarray, pixel: np.ndarray
) -> list[list[np.ndarray]]:
    """Lookups of hits: for each light uv, direction of light, of view, power, pixel."""
    position, normals, corner_uv = corners
    origin = np.array(scene.origin)
    edges = position[:, 1:] - position[:, :1]
    # The ray meets the triangle's plane at origin + t ray = position 0 + b · edges.
    system = np.stack([edges[:, 0], edges[:, 1], -ray], -1)
    b1, b2, _ = np.linalg.solve(system, (origin - position[:, 0])[..., None])[..., 0].T
    weight = np.stack([1 - b1 - b2, b1, b2], -1)
    point, uv = ((weight[..., None] * array).sum(1) for array in (position, corner_uv))
    normal = _unit((weight[..., None] * normals).sum(1))

    def place(at: np.ndarray) -> np.ndarray:
        """Where the triangle's plane has texture coordinates."""
        rows = np.swapaxes(corner_uv[:, 1:] - corner_uv[:, :1], 1, 2)
        b = np.linalg.solve(rows, (at - corner_uv[:, 0])[..., None])[..., 0]
        return position[:, 0] + (b[:, :, None] * edges).sum(1)

    along_u, along_v = ((place(uv + step) - place(uv - step)) / (2 * STEP) for step in STEP * np.eye(2))
    x = _unit(along_u - normal * (along_u * normal).sum(1, keepdims=True))
    y = np.cross(normal, x)
    y *= np.where((y * along_v).sum(1, keepdims=True) < 0, -1.0, 1.0)

    def local(w: np.ndarray) -> np.ndarray:
        across = np.stack([(w * x).sum(1), (w * y).sum(1)], -1) @ turn.T
        return np.concatenate([across, side * (w * normal).sum(1, keepdims=True)], 1)

    # Two-sided: seen from behind, both directions are mirrored at the surface.
    side = np.where((-ray * normal).sum(1, keepdims=True) < 0, -1.0, 1.0)
    texture, w_view = uv @ scene.to_uv.T, local(-ray)
    towards_sun = np.broadcast_to(_unit(-np.array(scene.sun)), point.shape)
    lookups = [[texture, local(towards_sun), w_view, np.broadcast_to(scene.irradiance, point.shape), pixel]]
    for place_of_lamp, intensity in scene.lamps:
        towards = np.array(place_of_lamp) - point
        squared = (towards**2).sum(1, keepdims=True)
        lookups.append([texture, local(towards / np.sqrt(squared)), w_view, intensity / squared, pixel])
    return lookups


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
