"""What can stand between a light and a surface: whether a scene has cast shadows, and which of its shapes cast them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.scene.emitters.lights import is_area, is_delta

if TYPE_CHECKING:
    from btfref.scene.description import Light, SceneDescription
    from btfref.scene.shapes import MeshDescription
    from btfref.types import JitArray


#: Share of a scene's size within which points lie in one plane: float32 vertices round by less.
FLAT = 1e-6

#: Shapes of Mitsuba, beside meshes, that are flat.
_FLAT_PLUGINS = ("Rectangle", "Disk")


def in_one_plane(points: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The plane that holds all points.

    Parameters
    ----------
    points : ndarray, shape (n, 3)

    Returns
    -------
    (ndarray, float) or None
        Unit normal n and offset d with n · p = d; None where no plane holds them to rounding. Points on a line have
        many.
    """
    points = np.asarray(points, float).reshape(-1, 3)
    if not len(points):
        return np.array([0.0, 0.0, 1.0]), 0.0
    centre = points.mean(0)
    away = points - centre
    # Of many points a small matrix has the same least axis, at half of the digits: the distances decide.
    normal = np.linalg.eigh(away.T @ away)[1][:, 0]
    size = max(float(np.abs(points).max()), float(np.abs(away).max()))
    if np.abs(away @ normal).max() > FLAT * size:
        return None
    return normal, float(centre @ normal)


def has_occluders(scene: SceneDescription) -> bool:
    """Whether a shape of a scene can hide a light from another one or from itself: not where all lie in one plane.

    Instances count as if they could.
    """
    if any(mesh.where.group is not None for mesh in scene.meshes):
        return True
    return in_one_plane(_corners(scene.meshes)) is None


def casts_shadows(scene: JitArray) -> bool:
    """The same of a scene of Mitsuba; light from all round counts as hidden by any shape.

    Parameters
    ----------
    scene : mitsuba.Scene
    """
    import mitsuba as mi

    if not all(is_delta(emitter) or is_area(emitter) for emitter in scene.emitters()):
        return True
    corners = []
    for shape in scene.shapes():
        values = mi.traverse(shape)
        if "vertex_positions" in values:
            corners.append(np.array(values["vertex_positions"], float).reshape(-1, 3))
        elif shape.class_name() in _FLAT_PLUGINS:
            matrix = np.array(values["to_world"].matrix, float).reshape(4, 4)
            corners.append((matrix[:3, :2] @ [[1, -1, 0], [0, 0, 1]]).T + matrix[:3, 3])
        else:
            return True
    return in_one_plane(np.concatenate(corners) if corners else np.zeros((0, 3))) is None


def casters(light: Light, meshes: Sequence[MeshDescription]) -> list[int]:
    """Indices of the meshes that may stand between a light and a surface: see :func:`casters_of`."""
    return casters_of([light], meshes)[0]


def casters_of(lights: Sequence[Light], meshes: Sequence[MeshDescription]) -> list[list[int]]:
    """Indices of the meshes that may stand between each light and a surface.

    A flat one does not, where nothing lies on its side away from the light: a floor.

    Parameters
    ----------
    lights : sequence of Light
    meshes : sequence of MeshDescription

    Returns
    -------
    list of list of int
        One for each light.
    """
    points = [_corners([mesh]) for mesh in meshes]
    everything = np.concatenate(points) if points else np.zeros((0, 3))
    room = FLAT * np.abs(everything).max(initial=0.0)
    position = np.array([light.position for light in lights], float).reshape(-1, 3)
    directional = np.array([light.kind == "directional" for light in lights], bool)
    casts = np.zeros((len(lights), len(meshes)), bool)
    for number, own in enumerate(points):
        plane = in_one_plane(own)
        casts[:, number] = len(own) > 0
        if plane is not None:
            normal, offset = plane
            side = np.sign(position @ normal - np.where(directional, 0.0, offset))
            beyond = everything @ normal - offset
            free = beyond.min(initial=0.0) >= -room, beyond.max(initial=0.0) <= room
            casts[:, number] &= ~np.where(side > 0, free[0], (side < 0) & free[1])
    return [np.flatnonzero(row).tolist() for row in casts]


def _corners(meshes: Sequence[MeshDescription]) -> np.ndarray:
    """Vertices that faces use, shape (n, 3)."""
    used = [np.asarray(mesh.positions, float)[np.unique(mesh.faces)] for mesh in meshes if len(mesh.faces)]
    return np.concatenate(used) if used else np.zeros((0, 3))
