"""Lights as data, and kinds of Mitsuba's emitters: seen from one direction at each point, of some extent, all round."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.types import JitArray

if TYPE_CHECKING:
    import mitsuba as mi

#: Kinds of lights, by the number that shaders know them by.
KINDS = ("directional", "point", "spot", "area")


@dataclass(frozen=True)
class Light:
    """A light that each point sees in one direction.

    Parameters
    ----------
    kind : {"directional", "point", "spot", "area"}
        "area": one point of an area light, which stands for a part of it.
    position : ndarray, shape (3,)
        Unit vector *towards* a directional light; position of another one.
    power : ndarray, shape (3,)
        Irradiance on a plane that faces the light in W/m², or radiant intensity in W/sr, the largest over directions;
        linear RGB.
    axis : ndarray, shape (3,)
        Unit vector along the middle of a spot's beam; normal of an area light.
    beam_width, cutoff : float
        Of a spot, in radians from its axis: its intensity falls linearly with the angle, from full to nothing.
    """

    kind: str
    position: np.ndarray
    power: np.ndarray
    axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    beam_width: float = 0.0
    cutoff: float = 0.0

    def incident(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the light brings to points, as ``shaders/lib/light/lights.glsl`` computes it.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            World space.

        Returns
        -------
        towards : ndarray of float64, shape (N, 3)
            Unit vectors towards the light.
        irradiance : ndarray of float64, shape (N, 3)
            Perpendicular to them, in W/m².
        """
        if self.kind == "directional":
            return np.broadcast_to(self.position, points.shape), np.broadcast_to(self.power, points.shape)
        offset = self.position - points
        square = (offset**2).sum(1)
        towards = offset / np.sqrt(square)[:, None]
        share = np.ones(len(points))
        if self.kind == "spot":
            # Mitsuba 3.9, src/emitters/spot.cpp.
            angle = np.arccos(np.clip(-towards @ self.axis, -1, 1))
            fall = (self.cutoff - angle) / max(self.cutoff - self.beam_width, 1e-12)
            share = np.where(angle <= self.beam_width, 1.0, np.clip(fall, 0, 1))
            share = np.where(angle < self.cutoff, share, 0.0)
        elif self.kind == "area":
            share = np.maximum(-towards @ self.axis, 0)
        return towards, self.power * (share / square)[:, None]


def light_of(kind: str, emitter: JitArray, types: ModuleType) -> Light:
    """What a delta emitter sends, asked of Mitsuba itself: spectra and transforms are then its own.

    Parameters
    ----------
    kind : {"directional", "point", "spot"}
        Its plugin.
    emitter : mitsuba.Emitter
        Of a scalar variant.
    types : module
        Mitsuba's types of that variant.
    """
    import mitsuba as mi

    point = types.SurfaceInteraction3f()
    point.p = [0.0, 0.0, 0.0]
    sample, weight = emitter.sample_direction(point, [0.5, 0.5], True)
    if kind == "directional":
        return Light(kind, np.array(sample.d, float), np.array(weight, float))
    axis, angles = np.array([1.0, 0.0, 0.0]), {}
    if kind == "spot":
        values = mi.traverse(emitter)
        matrix = np.array(values["to_world"].matrix, float).reshape(4, 4)
        position, axis = matrix[:3, 3], matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        names = {"beam_width": "beam_width", "cutoff": "cutoff_angle"}
        angles = {name: float(np.radians(float(values[theirs]))) for name, theirs in names.items()}
    else:
        position = np.array(sample.p, float)
    point.p = (position + axis).tolist()
    sample, weight = emitter.sample_direction(point, [0.5, 0.5], True)
    power = np.array(weight, float) * float(sample.dist) ** 2
    return Light(kind, position, power, axis, **angles) if kind == "spot" else Light(kind, position, power)


def is_delta(emitter: mi.Emitter) -> bool:
    """Whether an emitter shines on each point from one direction alone."""
    import mitsuba as mi

    flags = int(emitter.flags())
    return not flags & int(mi.EmitterFlags.Surface) and bool(
        flags & int(mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection)
    )


def is_area(emitter: mi.Emitter) -> bool:
    """Whether an emitter is the surface of a shape."""
    import mitsuba as mi

    return bool(int(emitter.flags()) & int(mi.EmitterFlags.Surface))


def checked_emitters(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene; those that direct light cannot be taken from are refused.

    Raises
    ------
    InputError
        For a scene without an emitter, or one that is neither a delta light, nor an area light, nor an environment.
    """
    import mitsuba as mi

    if not scene.emitters():
        raise InputError("the scene has no light", field="emitter")
    refuse_directed(scene)
    for emitter in scene.emitters():
        infinite = int(emitter.flags()) & int(mi.EmitterFlags.Infinite)
        if not (is_delta(emitter) or is_area(emitter) or infinite):
            raise InputError(
                "unsupported light",
                field="emitter",
                got=emitter.class_name(),
                expected="point, spot, directional, area, constant, envmap or sunsky",
            )
    return scene.emitters()


def refuse_directed(scene: mi.Scene) -> None:
    """Refuse area lights that shine in one direction: paths that start at the camera never meet their light.

    Raises
    ------
    InputError
    """
    if any(emitter.class_name() == "DirectionalArea" for emitter in scene.emitters()):
        raise InputError("unsupported light", field="emitter", got="directionalarea", expected=DIRECTED)


#: What takes the place of Mitsuba's ``directionalarea``.
DIRECTED = (
    "directional or area: a directionalarea shines along its normal alone, no direction that starts at a surface "
    "meets it, and Mitsuba shows it by tracing particles only"
)
