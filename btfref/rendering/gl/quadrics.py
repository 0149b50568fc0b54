"""What shaders read of spheres, disks and cylinders: ``shaders/lib/surface/quadric.glsl`` meets them exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.scene.surfaces.quadrics import KINDS

if TYPE_CHECKING:
    from btfref.scene.description import Camera
    from btfref.scene.surfaces.quadrics import Quadric

#: Of the rectangle that holds a shape: ``shaders/hosts/quadric.vert``.
TRIANGLES = 2

#: What a picture that is added to what is nearest is drawn nearer, in values of the depth buffer: programs round the
#: depths of fragments apart by some 1e-7.
SLACK = 1e-6


def quadric_uniforms(
    quadric: Quadric, camera: Camera, world_to_clip: np.ndarray, planes: tuple[float, float], *, adds: bool
) -> dict[str, Any]:
    """Uniforms of a shape, by name.

    Parameters
    ----------
    quadric : Quadric
    camera : Camera
    world_to_clip : ndarray, shape (4, 4)
        Of the sample.
    planes : (float, float)
        Depths at which the depth buffer begins and ends.
    adds : bool
        Whether the picture is added to surfaces whose depths are there.
    """
    matrix = quadric.to_world[:3, :3]
    corner, right, down = (np.linalg.solve(matrix, ray) for ray in camera.ray_basis())
    near, far = planes
    return {
        "quadric_kind": KINDS[quadric.plugin],
        "quadric_origin": np.linalg.solve(matrix, camera.origin - quadric.to_world[:3, 3]),
        "quadric_corner": corner,
        "quadric_right": right,
        "quadric_down": down,
        # GLSL has columns first.
        "quadric_to_world": matrix.T,
        "quadric_centre": quadric.to_world[:3, 3],
        "quadric_normals": np.linalg.inv(matrix),
        "quadric_to_own": quadric.to_own.T,
        "quadric_own_to_world": quadric.own_to_world.T,
        "quadric_sides": np.array(quadric.sides),
        "quadric_range": np.array([camera.near, camera.far]),
        "quadric_window": np.array(
            [far / (far - near) - (SLACK if adds else 0.0), -far * near / (far - near)]
        ),
        "quadric_bounds": bounds(quadric, camera, world_to_clip),
    }


def bounds(quadric: Quadric, camera: Camera, world_to_clip: np.ndarray) -> np.ndarray:
    """Left, lower, right and upper side in device coordinates of a rectangle that holds a shape, shape (4,)."""
    corners = quadric.bounds()
    if camera.depth(corners).min() <= camera.near:
        return np.array([-1.0, -1.0, 1.0, 1.0])
    clip = np.concatenate([corners, np.ones((len(corners), 1))], 1) @ world_to_clip.T
    place = clip[:, :2] / clip[:, 3:]
    # A pixel more on each side: rasterizers snap.
    margin = 2 / np.array([camera.width, camera.height])
    return np.concatenate([np.clip(place.min(0) - margin, -1, 1), np.clip(place.max(0) + margin, -1, 1)])
