"""Spheres, disks and cylinders as such, as Mitsuba 3.9 draws them: the frames in which rays meet them exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

#: Plugins of Mitsuba that are drawn as such, and their numbers in ``shaders/lib/surface/quadric.glsl``.
KINDS = {"sphere": 0, "disk": 1, "cylinder": 2}


@dataclass(frozen=True)
class Quadric:
    """A sphere, disk or cylinder.

    Its canonical frame has the sphere of radius 1 about the origin, the disk of radius 1 in the plane z = 0, or the
    cylinder of radius 1 about the z axis from z = 0 to 1. Of a disk and a cylinder this is the shape's own frame, in
    which coordinates are taken; a sphere is round in world space whatever its transform, as in Mitsuba.

    Parameters
    ----------
    plugin : {"sphere", "disk", "cylinder"}
    to_world : ndarray of float64, shape (4, 4)
        From the canonical frame.
    own_to_world : ndarray of float64, shape (3, 3)
        Vectors of the shape's own frame in world space.
    flip : bool
        The shading normal points inwards (of a disk: to its −z).
    """

    plugin: str
    to_world: np.ndarray
    own_to_world: np.ndarray
    flip: bool

    @classmethod
    def of(cls, plugin: str, matrix: np.ndarray, flip: bool) -> Quadric:
        """From the matrix that takes the own frame of a shape of the scene to world space, and its ``flip_normals``."""
        own = matrix[:3, :3]
        if plugin != "sphere":
            return cls(plugin, matrix, own, flip)
        # sphere.cpp of Mitsuba 3.9: the x axis is as long as the radius, and what mirrors turns the sphere inside out.
        to_world = np.eye(4)
        to_world[:3, :3] *= np.linalg.norm(own[:, 0])
        to_world[:3, 3] = matrix[:3, 3]
        return cls(plugin, to_world, own, flip != mirrors(matrix))

    def moved(self, transform: np.ndarray) -> Quadric:
        """The same in another place, as an instance has it; ``transform`` is affine, shape (4, 4)."""
        return replace(
            self, to_world=transform @ self.to_world, own_to_world=transform[:3, :3] @ self.own_to_world
        )

    @property
    def to_own(self) -> np.ndarray:
        """Vectors of the canonical frame in the shape's own one, shape (3, 3)."""
        return np.linalg.solve(self.own_to_world, self.to_world[:3, :3])

    @property
    def sides(self) -> tuple[float, float]:
        """Signs against the outward normal (of a disk: that of +z) of the shading normal and of ∂p/∂u × ∂p/∂v."""
        # Azimuth, then polar angle: their cross product points inwards. A mirrored frame turns it around.
        side = -1.0 if self.plugin == "sphere" else 1.0
        return -1.0 if self.flip else 1.0, -side if np.linalg.det(self.own_to_world) < 0 else side

    def bounds(self) -> np.ndarray:
        """Corners of a box around it in world space, shape (8, 3)."""
        low = {"sphere": -1.0, "disk": 0.0, "cylinder": 0.0}[self.plugin]
        high = {"sphere": 1.0, "disk": 0.0, "cylinder": 1.0}[self.plugin]
        corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (low, high)])
        return corners @ self.to_world[:3, :3].T + self.to_world[:3, 3]


def mirrors(matrix: np.ndarray) -> bool:
    """Whether a transform, shape (4, 4), turns right hands into left ones."""
    return bool(np.linalg.det(matrix[:3, :3]) < 0)
