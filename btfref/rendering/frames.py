"""Frames of real time that are averaged: which materials draw views, and how often the sub-pixel grid is drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from btfref.errors import SAMPLES, InputError, refuse_above
from btfref.numerics.interpolations import INTERPOLATIONS

if TYPE_CHECKING:
    from btfref.scene.description import SceneDescription


def refuse_unknown(interpolation: str | None) -> None:
    """InputError for an interpolation that there is not; None is that of the scene."""
    if interpolation not in (None, *INTERPOLATIONS):
        expected = " or ".join(INTERPOLATIONS)
        raise InputError("unknown interpolation", field="interpolation", got=interpolation, expected=expected)


def interpolated(scene: SceneDescription, interpolation: str | None) -> SceneDescription:
    """A scene whose BTFs all interpolate in one way; None: as they are."""
    refuse_unknown(interpolation)
    if interpolation is None:
        return scene
    meshes = tuple(
        replace(mesh, material=replace(mesh.material, interpolation=interpolation)) if mesh.material else mesh
        for mesh in scene.meshes
    )
    return replace(scene, meshes=meshes)


def rounds_of(scene: SceneDescription, grid: int, frames: int | None) -> int:
    """How often the grid is drawn.

    Parameters
    ----------
    scene : SceneDescription
    grid : int
        n of the n × n sub-pixel samples, one a frame.
    frames : int or None
        A multiple of n²; None: once the grid.

    Raises
    ------
    InputError
        For another number, or frames that would all be the same.
    """
    if frames is None:
        return 1
    if not any(mesh.material and mesh.material.interpolation == "drawn" for mesh in scene.meshes):
        expected = "interpolation drawn"
        raise InputError("frames differ by draws alone", field="frames", got=frames, expected=expected)
    if frames < 1 or frames % grid**2:
        raise InputError(
            "all places of the sub-pixel grid need equally many frames",
            field="frames",
            got=frames,
            expected=f"a multiple of {grid**2}",
        )
    refuse_above(SAMPLES, frames, "frames")
    return frames // grid**2
