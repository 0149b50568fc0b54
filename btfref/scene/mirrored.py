"""Textures that a scene shows mirrored: right as the scene says it, and seldom what its author meant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.scene.camera import film_rays
from btfref.scene.reading.instances import every_shape
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
    import drjit as dr
    import mitsuba as mi

    from mitsuba_plugins.lib.frame import hand_of
    from mitsuba_plugins.protocol import shown_by

    turns = [(shape, {one.turn.hand for one in shown_by(shape.bsdf())}) for shape in every_shape(scene)]
    if not any(hands for _, hands in turns):
        return []
    si = scene.ray_intersect(film_rays(scene.sensors()[0], (0.5, 0.5))[0])
    shape_seen = dr.select(si.is_valid(), dr.reinterpret_array(mi.UInt32, si.shape), 0)
    hand = hand_of(si)
    dr.eval(shape_seen, hand)
    seen = set(zip(np.array(shape_seen).tolist(), np.array(hand).tolist(), strict=True))
    return [
        shape.id() or shape.class_name().lower()
        for shape, hands in turns
        if any((int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]), -h) in seen for h in hands)
    ]


def mirrored_meshes(meshes: Sequence[MeshDescription]) -> list[str]:
    """Names of shapes with a BTF whose texture is mirrored somewhere."""
    return [
        mesh.name
        for mesh in meshes
        if mesh.material is not None and (_hands(mesh) * mesh.material.turn.hand < 0).any()
    ]


def _hands(mesh: MeshDescription) -> np.ndarray:
    """Signs of det(∂p/∂u, ∂p/∂v, n) that occur."""
    return mesh.hands() if mesh.quadric is None else np.array(np.prod(mesh.quadric.sides))


def line(names: Sequence[str]) -> str:
    """What is said of such shapes, in one line."""
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"mirrored texture coordinates: {shown} ({CURE})"
