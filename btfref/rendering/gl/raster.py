"""What the rasterizer is told: projection, triangles, footprints and lights as tables and uniforms."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.rendering.environment_light.lighting import PASS
from btfref.scene.emitters.lights import KINDS
from btfref.scene.shapes import neighbours

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.scene.description import Camera, Light
    from btfref.scene.shapes import MeshDescription, Shown
    from btfref.types import Facts


def material_uniforms(material: Shown, texels: tuple[int, int], angle: float) -> dict[str, Any]:
    """What ``shaders/hosts/mesh.frag`` and ``shaders/lib/surface/lod.glsl`` read of a material.

    Parameters
    ----------
    material : BtfMaterial or PlainMaterial
    texels : (int, int)
        Rows and columns of level 0.
    angle : float
        That a sample subtends, in radians.
    """
    (row0, row1), turn = material.to_uv, material.turn
    return {
        "uv_row0": row0,
        "uv_row1": row1,
        "uv_turn": (turn.cosine, turn.sine, turn.hand),
        "scale": material.scale,
        "two_sided": material.twosided,
        "lod_angle": angle if material.lod == "auto" else 0.0,
        "lod_unit": material.lod_unit if material.lod == "distance" else 0.0,
        "lod_bias": material.lod_bias,
        "lod_texels": np.array(texels[::-1], float),
    }


def triangle_table(mesh: MeshDescription) -> np.ndarray:
    """Triangles as ``shaders/lib/surface/triangle_table.glsl`` reads them.

    Parameters
    ----------
    mesh : MeshDescription

    Returns
    -------
    ndarray of float32, shape (m, 8, 4)
        Three positions with u, three normals with v, dp/du with the side of dp/du x dp/dv, neighbours.
    """
    positions, normals, uv, dp_du = mesh.corners()
    if len(positions) > 1 << 24:
        raise InputError("too many triangles for float32 indices", field=mesh.name, got=len(positions))
    table = np.zeros((len(positions), 8, 4), np.float32)
    table[:, 0:3, :3], table[:, 0:3, 3] = positions, uv[..., 0]
    table[:, 3:6, :3], table[:, 3:6, 3] = normals, uv[..., 1]
    # Only the direction counts; unit length keeps float32 far from overflow.
    table[:, 6, :3] = dp_du / np.linalg.norm(dp_du, axis=-1, keepdims=True)
    table[:, 6, 3] = mesh.uv_sides()
    table[:, 7, :3] = neighbours(mesh.positions, mesh.faces)
    return table


def world_to_clip(camera: Camera, offset: tuple[float, float], near: float, far: float) -> np.ndarray:
    """Projection that puts the film point at ``offset`` in each pixel on that pixel's centre.

    Parameters
    ----------
    camera : Camera
    offset : (float, float)
        From the pixel's top left corner, in pixels.
    near, far : float

    Returns
    -------
    ndarray of float64, shape (4, 4)
    """
    to_world = camera.to_world.copy()
    to_world[:3, :3] /= np.linalg.norm(to_world[:3, :3], axis=0)
    tan_x, tan_y = camera.tangents
    shift_x = 2 * (0.5 - offset[0]) / camera.width
    shift_y = -2 * (0.5 - offset[1]) / camera.height
    project = np.array(
        [
            # Mitsuba's camera space is left, up, forward.
            [-1 / tan_x, 0, shift_x, 0],
            [0, 1 / tan_y, shift_y, 0],
            [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )
    return project @ np.linalg.inv(to_world)


def clip_planes(camera: Camera, meshes: Sequence[MeshDescription]) -> tuple[float, float]:
    """Near and far planes around the scene: the depth buffer then resolves what is there."""
    depths = [camera.depth(mesh.positions[mesh.faces.ravel()]) for mesh in meshes if len(mesh.faces)]
    if not depths:
        return camera.near, camera.far
    low, high = min(d.min() for d in depths), max(d.max() for d in depths)
    near = max(camera.near, 0.99 * low)
    return near, max(min(camera.far, 1.01 * high), 1.01 * near)


def light_table(lights: Sequence[Light]) -> np.ndarray:
    """What ``shaders/lib/light/lights.glsl`` reads of lights.

    Parameters
    ----------
    lights : sequence of Light

    Returns
    -------
    ndarray of float32, shape (n ≥ 1, 3, 4)
    """
    table = np.zeros((max(len(lights), 1), 3, 4), np.float32)
    for row, light in zip(table, lights, strict=False):
        row[0, :3], row[0, 3] = light.position, KINDS.index(light.kind)
        row[1, :3], row[1, 3] = light.power, light.cutoff
        row[2, :3], row[2, 3] = light.axis, 1 / max(light.cutoff - light.beam_width, 1e-6)
    return table


def light_passes(
    light: Prepared | None, n_lights: int, n_faces: int, *, most: int = PASS
) -> list[tuple[Facts, int]]:
    """Pictures of a mesh that add up: uniforms, and the number of triangles.

    Parameters
    ----------
    light : btfref.rendering.environment_light.prepared.Prepared or None
        How an environment lights the mesh.
    n_lights : int
        Others.
    n_faces : int
        Of the mesh.
    most : int
        Lights of a picture.
    """
    parts = [(first, min(first + most, n_lights)) for first in range(0, n_lights, most)]
    ranges = [{"light_first": first, "light_end": end} for first, end in parts]
    nothing = {"light_first": 0, "light_end": 0}
    if light is None:
        return [(one, n_faces) for one in ranges or [nothing]]
    if light.bins is None:
        own = light.passes
        # What the last pass of the environment had stays set, and is not read.
        joined = zip_longest(own, ranges)
        counted = {"environment_passes": len(own)}
        return [({**(one or {}), **(other or nothing), **counted}, n_faces) for one, other in joined]
    found = []
    for values, count in zip(light.passes, np.diff(light.bins).tolist(), strict=True):
        # Clusters' bins overlap: the one of number -1 has every triangle once.
        found += [({**values, **one}, count) for one in (ranges if values["bin"] < 0 else [nothing])]
    return found
