"""Mitsuba scenes as plain data: camera, meshes, BTF materials, lights; all that real-time rendering needs."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType

import numpy as np

from btfref.errors import InputError, MissingDependencyError
from btfref.platform import prepare_llvm
from btfref.scene import parsing
from btfref.scene.emitters.area_lights import area_lights
from btfref.scene.emitters.lights import Light, is_area, light_of
from btfref.scene.environment import SUN_APERTURE, Environment, from_emitter
from btfref.scene.reading.instances import drawn_nodes, drawn_shapes
from btfref.scene.reading.supported import check
from btfref.scene.shapes import BtfMaterial, MeshDescription, triangles_of
from btfref.scene.surfaces.materials import PlainMaterials, bitmap_of
from btfref.types import Facts, JitArray, SceneLike

__all__ = ["BtfMaterial", "Camera", "Light", "MeshDescription", "SceneDescription", "read_scene"]

#: Reading scenes needs no LLVM: this variant is compiled ahead of time.
VARIANT = "scalar_rgb"


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Parameters
    ----------
    to_world : ndarray, shape (4, 4)
        Columns: left, up, forward, origin, as Mitsuba's look-at.
    x_fov : float
        Horizontal field of view in radians.
    width, height : int
        Of the film in pixels.
    near, far : float
        Clipping distances along the optical axis.
    """

    to_world: np.ndarray
    x_fov: float
    width: int
    height: int
    near: float
    far: float

    @property
    def origin(self) -> np.ndarray:
        """Position in world space, shape (3,)."""
        return self.to_world[:3, 3]

    @property
    def tangents(self) -> tuple[float, float]:
        """Half extents of the image at distance 1: horizontal, vertical."""
        x = np.tan(0.5 * self.x_fov)
        return x, x * self.height / self.width

    def ray_basis(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions of film points: ``corner + x · right + y · down``, in pixels from the top left.

        Returns
        -------
        corner, right, down : ndarray of float64, shape (3,)
            Not normalised: the component along the optical axis is 1.
        """
        left, up, forward = (self.to_world[:3, i] / np.linalg.norm(self.to_world[:3, i]) for i in range(3))
        tan_x, tan_y = self.tangents
        corner = forward + tan_x * left + tan_y * up
        return corner, -2 * tan_x / self.width * left, -2 * tan_y / self.height * up

    @property
    def pixel_angle(self) -> float:
        """Angle that a pixel at the middle of the image subtends, in radians."""
        return 2 * self.tangents[0] / self.width

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distances of points along the optical axis, shape (..., 3) -> (...)."""
        forward = self.to_world[:3, 2] / np.linalg.norm(self.to_world[:3, 2])
        return (points - self.origin) @ forward


@dataclass(frozen=True)
class SceneDescription:
    """A scene as data.

    Parameters
    ----------
    camera : Camera
    meshes : tuple of MeshDescription
    lights : tuple of Light
    source : str
        The scene file, for messages.
    environment : btfref.scene.environment.Environment or None
    facts : dict
        How many points stand for the area lights, and their estimated error: JSON-able.
    notes : tuple of str
        What is drawn otherwise than its name says, a line each.
    """

    camera: Camera
    meshes: tuple[MeshDescription, ...]
    lights: tuple[Light, ...]
    source: str
    environment: Environment | None = None
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def read_scene(
    scene: SceneLike,
    parameters: Mapping[str, object] | None = None,
    *,
    size: tuple[int, int] | None = None,
    missing_btf: bool = False,
) -> SceneDescription:
    """Read a Mitsuba scene.

    Parameters
    ----------
    scene : path-like or dict
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    size : (int, int), optional
        Width and height of the film in place of the scene's.
    missing_btf : bool
        Accept BTF files that do not exist yet.

    Returns
    -------
    SceneDescription

    Raises
    ------
    InputError
        In one line with file and field: missing or malformed files, no or several sensors, a camera that is
        not ``perspective`` or is cropped, a light or shape of an unsupported kind, a shape without texture
        coordinates, a missing BTF file.
    """
    # Importing Mitsuba loads some LLVM, whatever the variant: where there is a good one, it shall be that.
    # Reading itself needs none.
    with contextlib.suppress(MissingDependencyError):
        prepare_llvm()
    types = parsing.scalar_types()
    parsed = parsing.parse(scene, parameters, variant=VARIANT, size=size, missing_btf=missing_btf)
    roots = parsed.children(parsed.state.root)
    nodes = {kind: [n for _, n in roots if parsing.is_kind(n, kind)] for kind in ("Sensor", "Emitter")}
    drawn = drawn_nodes(parsed, [(i, n) for i, n in roots if parsing.is_kind(n, "Shape")])
    check(parsed, nodes, [one.node for one in drawn])
    apart = [(parsed.location(n), n.props.plugin_name(), _aperture(n)) for n in nodes["Emitter"]]
    materials = [parsing.material_of(parsed, one.node) for one in drawn]
    bitmaps = [bitmap_of(parsed, one.node) for one in drawn]
    parsing.plain(parsed, btf_alone=True)
    made = parsed.instantiate()
    if not isinstance(made, types.Scene) or len(made.shapes()) != len({one.where.number for one in drawn}):
        raise InputError("the file does not describe one scene of separate shapes", file=parsed.source)
    shapes = [one.shape for one in drawn_shapes(made, [one.where for one in drawn])]
    meshes, plain = [], PlainMaterials(types)
    for shape, one, (bsdf, material), bitmap in zip(shapes, drawn, materials, bitmaps, strict=True):
        name, file = one.name(shape.id() or one.node.props.plugin_name()), parsed.location(one.node)
        looked_up = {"btf": material is not None, "bitmap": bitmap is not None}
        data = triangles_of(shape, one.node, file=file, name=name, outer=one.outer, **looked_up)
        if material is None:
            data["plain"] = plain.of(shape, bitmap, file=file, name=name)
            parsed.notes += plain.note(data["plain"], name, bsdf)
        plugin = one.node.props.plugin_name()
        data["emission"] = _emission(shape, types)
        data |= {"name": name, "plugin": plugin, "bsdf": bsdf, "material": material, "where": one.where}
        meshes.append(MeshDescription(**data))
    lights, environment = [], None
    emitters = [emitter for emitter in made.emitters() if not is_area(emitter)]
    for (file, kind, aperture), emitter in zip(apart, emitters, strict=True):
        if kind in parsing.SURROUNDINGS:
            environment = from_emitter(kind, emitter, types, file=file, aperture=aperture)
        else:
            lights.append(light_of(kind, emitter, types))
    areas = area_lights(made, types)
    lights += areas.lights()
    camera = _camera(made.sensors()[0])
    return SceneDescription(
        camera, tuple(meshes), tuple(lights), parsed.source, environment, areas.facts, tuple(parsed.notes)
    )


def _camera(sensor: JitArray) -> Camera:
    import mitsuba as mi

    values = mi.traverse(sensor)
    width, height = (int(n) for n in sensor.film().size())
    to_world = np.array(values["to_world"].matrix, float)
    clip = float(values["near_clip"]), float(values["far_clip"])
    return Camera(to_world, float(np.radians(float(values["x_fov"]))), width, height, *clip)


def _emission(shape: JitArray, types: ModuleType) -> np.ndarray:
    """Radiance of a shape's own light, shape (3,)."""
    if not shape.is_emitter():
        return np.zeros(3)
    si = types.SurfaceInteraction3f()
    si.wi = [0.0, 0.0, 1.0]
    return np.array(shape.emitter().eval(si, True), float).ravel()[:3]


def _aperture(node: JitArray) -> float:
    """Angle that the sun of a sky subtends, in degrees: Mitsuba's emitter does not tell it."""
    return float(node.props["sun_aperture"]) if "sun_aperture" in node.props else SUN_APERTURE
