"""Kinds of lights: those that are seen from one direction at each point, and those that surround the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from btfref.errors import InputError

if TYPE_CHECKING:
    import mitsuba as mi


def is_delta(emitter: mi.Emitter) -> bool:
    """Whether an emitter shines on each point from one direction alone."""
    import mitsuba as mi

    return bool(int(emitter.flags()) & int(mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection))


def distant_or_delta(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene; those that have an area at a finite distance are refused.

    Raises
    ------
    InputError
        For an area light.
    """
    import mitsuba as mi

    for emitter in scene.emitters():
        if not (is_delta(emitter) or int(emitter.flags()) & int(mi.EmitterFlags.Infinite)):
            raise InputError(
                "unsupported light",
                field="emitter",
                got=emitter.class_name(),
                expected="delta lights or an environment: point, directional, constant or envmap",
            )
    return scene.emitters()
