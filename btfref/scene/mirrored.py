"""Textures that a scene shows mirrored: right as the scene says it, and seldom what its author meant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.scene.hits import Surface
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.scene.shapes import MeshDescription

#: How a mirrored texture is turned.
CURE = (
    "a to_uv with a scale of -1 in y turns it; an OBJ's flip_tex_coords=false does too, "
    "since Mitsuba's reader turns v over by default"
)


def seen_mirrored(scene: JitArray) -> list[str]:
    """Names of shapes with a BTF whose texture the camera sees mirrored, at the middles of its pixels.

    Parameters
    ----------
    scene : mitsuba.Scene
        Of a JIT variant.
    """
    from mitsuba_plugins.protocol import shown_by

    surface, found = Surface(scene, (0.5, 0.5)), []
    for shape in scene.shapes():
        hands = {one.turn.hand for one in shown_by(shape.bsdf())}
        if hands and np.isin(-surface.hand[surface.sees(shape)], list(hands)).any():
            found.append(shape.id())
    return found


def mirrored_meshes(meshes: Sequence[MeshDescription]) -> list[str]:
    """Names of shapes with a BTF whose texture is mirrored somewhere."""
    return [
        mesh.name
        for mesh in meshes
        if mesh.material is not None and (mesh.hands() * mesh.material.turn.hand < 0).any()
    ]


def line(names: Sequence[str]) -> str:
    """What is said of such shapes, in one line."""
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"mirrored texture coordinates: {shown} ({CURE})"
