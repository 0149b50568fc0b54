"""What the rasterizer is told: projection, triangles, footprints and lights as tables and uniforms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.scene.shapes import neighbours

if TYPE_CHECKING:
    from btfref.scene.description import Camera, Light
    from btfref.scene.shapes import BtfMaterial, MeshDescription


def material_uniforms(material: BtfMaterial, texels: tuple[int, int], angle: float) -> dict[str, Any]:
    """What ``shaders/hosts/mesh.frag`` and ``shaders/lib/surface/lod.glsl`` read of a material.

    Parameters
    ----------
    material : BtfMaterial
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


def light_uniforms(lights: Sequence[Light]) -> dict[str, np.ndarray]:
    """What ``shaders/lib/light/lights.glsl`` reads of directional and point lights."""
    position = [[*light.position, 0.0 if light.kind == "directional" else 1.0] for light in lights]
    return {"light_position": np.array(position), "light_power": np.array([light.power for light in lights])}
