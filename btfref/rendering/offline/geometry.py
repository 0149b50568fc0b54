"""Geometry truth: a flat scene whose BTF is replaced by the mesostructure that it was made from, path traced.

What a BTF cannot show — parallax inside a texel, the exact direction at every point — is in this picture; its
difference to a render of the BTF is the error that no representation removes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.rendering import RenderResult
from btfref.scene.description import read_scene
from btfref.types import Facts, JitArray, PathLike, SceneLike

if TYPE_CHECKING:
    from btfref.mesostructure import Mesostructure
    from btfref.scene.description import Camera, Light, SceneDescription


#: Independent renders that a picture is the mean of; their spread gives the variance.
ROUNDS = 16

#: How far (in depths of the mesostructure) light that was reflected once is taken to come from when pixels
#: near the border are set apart: of cosine-distributed rays that rise by the depth, 1 in 5 comes from beyond
#: 2 depths, and that light is a small share of a small share.
INDIRECT_REACH = 2.0

#: Relative slack within which a surface counts as flat and its texture axes as equal and at right angles.
_SLACK = 1e-4


@dataclass(frozen=True)
class _Plane:
    """A flat BTF in tile coordinates: world = origin + s·x + t·y + z·normal·size."""

    origin: np.ndarray
    x: np.ndarray
    y: np.ndarray
    normal: np.ndarray
    size: float
    low: np.ndarray
    high: np.ndarray
    filename: str

    @property
    def matrix(self) -> np.ndarray:
        """From tile coordinates to the world, (4, 4)."""
        matrix = np.eye(4)
        matrix[:3] = np.stack([self.x, self.y, self.normal * self.size, self.origin], axis=1)
        return matrix


def render_geometry(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    mesostructure: PathLike | Mesostructure | None = None,
    spp: int = 256,
    seed: int = 0,
    size: tuple[int, int] | None = None,
    max_depth: int | None = None,
    variant: str = "llvm_ad_rgb",
) -> RenderResult:
    """Path trace a flat BTF scene with the mesostructure in place of the BTF.

    Parameters
    ----------
    scene : path-like or dict
        Its only shape is flat, has a ``btf`` material of scale 1, and square tiles without rotation.
    parameters : dict of str to str, optional
        Values for ``$name`` in the scene file.
    mesostructure : str or Mesostructure, optional
        By default the one, with its parameters, that the file of the material says it comes from.
    spp : int
        Samples per pixel, at least 2.
    seed : int
    size : (int, int), optional
        Width and height of the film.
    max_depth : int, optional
        As in Mitsuba; by default that of the BTF's synthesis, else 8.
    variant : str
        Mitsuba variant.

    Returns
    -------
    RenderResult
        With the variance of the mean. All tiles that the shape touches are there in full, with the top of the
        mesostructure in the shape's plane; see `geometry_classes` for the pixels that are free of border
        effects.

    Raises
    ------
    InputError
        A scene that is not flat, or a BTF that does not say what it comes from.
    """
    import time

    from btfref.mesostructure.materials import load_bsdf
    from btfref.mesostructure.tiling import tiled_shapes
    from btfref.provenance import versions
    from btfref.sampling.variant import mitsuba_variant, no_collection

    if not isinstance(spp, int | np.integer) or spp < 2:
        raise InputError("samples per pixel", field="spp", got=spp, expected="a whole number, at least 2")
    description = read_scene(scene, parameters, size=size)
    plane = _plane(description)
    parent = _parent(plane.filename) if mesostructure is None or max_depth is None else {}
    geometry = _mesostructure(plane, parent, mesostructure)
    depth = parent.get("max_depth", 8) if max_depth is None else max_depth
    rounds = int(min(ROUNDS, spp // 2)) if spp >= 4 else 2
    start = time.perf_counter()
    with mitsuba_variant(variant) as mi, no_collection():
        # Whatever sticks out of its tile belongs to the neighbours as well.
        low = np.floor(plane.low - geometry.overhang + _SLACK).astype(int)
        high = np.ceil(plane.high + geometry.overhang - _SLACK).astype(int)
        to_world = mi.ScalarTransform4f(plane.matrix)
        bsdfs = [load_bsdf(part) for part in geometry.parts]
        shapes = tiled_shapes(geometry, range(low[0], high[0]), range(low[1], high[1]), to_world, bsdfs)
        lights = {f"light_{i}": _light(light) for i, light in enumerate(description.lights)}
        made = mi.load_dict({"type": "scene", "sensor": _sensor(mi, description.camera), **lights, **shapes})
        # The shadow rays of Mitsuba's path stop at masks, those of volpath do not.
        masked = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)
        integrator = mi.load_dict({"type": "volpath" if masked else "path", "max_depth": int(depth)})
        # Largest total not beyond spp that splits into equal rounds: their spread is then the variance.
        per_round = spp // rounds
        mean = np.zeros((description.camera.height, description.camera.width, 3))
        squares = np.zeros_like(mean)
        for k, word in enumerate(np.random.SeedSequence(seed).generate_state(rounds)):
            image = np.array(
                mi.render(made, integrator=integrator, spp=per_round, seed=int(word)), np.float64
            )
            # Welford's update: no cancellation where a pixel is bright and quiet.
            step = image - mean
            mean += step / (k + 1)
            squares += step * (image - mean)
    meta = {
        "renderer": "geometry",
        "variant": variant,
        "spp": per_round * rounds,
        "rounds": rounds,
        "seed": int(seed),
        "max_depth": int(depth),
        "mesostructure": {"name": geometry.name, "parameters": geometry.parameters},
        "versions": versions(("mitsuba", "drjit", "numpy")),
        "seconds": round(time.perf_counter() - start, 3),
    }
    variance = squares / (rounds * (rounds - 1))
    return RenderResult(mean.astype(np.float32), variance.astype(np.float32), meta)


def geometry_classes(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    mesostructure: PathLike | Mesostructure | None = None,
    size: tuple[int, int] | None = None,
    grid: int = 4,
) -> np.ndarray:
    """Where the geometry truth of a flat BTF scene may be compared with the BTF.

    Parameters
    ----------
    scene, parameters, mesostructure, size
        As for `render_geometry`.
    grid : int
        Sub-pixel positions per axis that are looked at, beside the pixel's corners.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        0: no sub-pixel sees the plane; 1: all do, so far from its border that neither parallax nor shadow nor
        near interreflection reaches it; 2: the others.

    Raises
    ------
    InputError
        As `render_geometry`.
    """
    description = read_scene(scene, parameters, size=size)
    plane = _plane(description)
    parent = _parent(plane.filename) if mesostructure is None else {}
    depth = -_mesostructure(plane, parent, mesostructure).height[0]
    camera = description.camera
    corner, right, down = camera.ray_basis()
    offset = np.linspace(0.0, 1.0, grid + 1)
    x = (np.arange(camera.width)[:, None] + offset).ravel()
    y = (np.arange(camera.height)[:, None] + offset).ravel()
    ray = corner + x[None, :, None] * right + y[:, None, None] * down
    facing = ray @ plane.normal
    distance = (plane.origin - camera.origin) @ plane.normal
    sees = (facing < 0) & (distance < 0)
    t = distance / np.where(sees, facing, 1.0)
    point = camera.origin + t[..., None] * ray
    local = point - plane.origin
    tile = np.stack([local @ plane.x, local @ plane.y], -1) / plane.size**2
    hit = sees & ((tile >= plane.low) & (tile <= plane.high)).all(-1)

    reach = np.full(hit.shape, INDIRECT_REACH) + np.where(hit, _tangent(-ray, plane.normal), 0.0)
    for light in description.lights:
        to_light = light.position if light.kind == "directional" else light.position - point
        # The farthest-reaching light decides; one below the horizon lights nothing.
        tangent = _tangent(np.broadcast_to(to_light, point.shape), plane.normal)
        reach = np.maximum(reach, INDIRECT_REACH + tangent)
    border = np.minimum(tile - plane.low, plane.high - tile).min(-1)
    inner = hit & (border > depth * reach)

    def per_pixel(mask: np.ndarray, reduce: Callable[..., np.ndarray]) -> np.ndarray:
        blocks = mask.reshape(camera.height, grid + 1, camera.width, grid + 1)
        return reduce(blocks, axis=(1, 3))

    classes = np.full((camera.height, camera.width), PixelClass.SILHOUETTE, np.uint8)
    classes[~per_pixel(hit, np.any)] = PixelClass.BACKGROUND
    classes[per_pixel(inner, np.all)] = PixelClass.INTERIOR
    return classes


def _tangent(w: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Tangent of the angle to the normal; 0 below the horizon, where nothing is lit or seen."""
    z = w @ normal
    length = np.einsum("...i,...i->...", w, w)
    across = np.sqrt(np.maximum(length - z * z, 0.0))
    return np.where(z > 0, across / np.where(z > 0, z, 1.0), 0.0)


def _plane(description: SceneDescription) -> _Plane:
    """The scene's only shape as a plane in tile coordinates."""
    source = description.source
    mesh = description.meshes[0] if len(description.meshes) == 1 else None
    if mesh is None or mesh.material is None:
        raise InputError(
            "geometry truth wants one flat shape with a btf material",
            file=source,
            got=f"{len(description.meshes)} shapes",
        )
    material = mesh.material
    if material.scale != 1:
        raise InputError("geometry has no scale", file=source, field="scale", got=material.scale, expected=1)
    positions = np.asarray(mesh.positions, np.float64)
    uv = np.concatenate([np.asarray(mesh.uv, np.float64), np.ones((len(positions), 1))], 1)
    tile = uv @ np.asarray(material.to_uv, np.float64).T
    # world = origin + s·x + t·y, fitted: exact for a flat shape with affine texture coordinates.
    basis, _, rank, _ = np.linalg.lstsq(
        np.concatenate([tile, np.ones((len(tile), 1))], 1), positions, rcond=None
    )
    x, y, origin = basis
    extent = np.ptp(positions, axis=0).max()
    residual = np.abs(tile @ basis[:2] + origin - positions).max()
    if rank < 3 or residual > _SLACK * extent:
        raise InputError(
            "the shape is not flat with affine texture coordinates", file=source, field=mesh.name
        )
    size = float(np.linalg.norm(x))
    if abs(np.linalg.norm(y) / size - 1) > _SLACK or abs(x @ y) > _SLACK * size**2:
        raise InputError("tiles are not square", file=source, field="to_uv", got=f"{x}, {y}")
    if mesh.normals is None:
        a, b, c = positions[mesh.faces[0]]
        normal = np.cross(b - a, c - a)
    else:
        normal = np.asarray(mesh.normals, np.float64).mean(0)
    normal = normal / np.linalg.norm(normal) * (-1 if mesh.flip else 1)
    linear = np.asarray(material.to_uv, np.float64)[:, :2]
    if abs(linear[1, 0]) > _SLACK * abs(linear[0, 0]):
        # Whole tiles cannot fill a shape whose border runs across them; mirrored ones can.
        raise InputError("tiles are turned", file=source, field="to_uv", got=linear.tolist())
    return _Plane(origin, x, y, normal, size, tile.min(0), tile.max(0), material.filename)


def _parent(filename: PathLike) -> Facts:
    """Mesostructure and depth that the BTF behind a representation was made from."""
    from btfref.representations.file.container import read_info

    ancestor = read_info(filename)["parent"]
    depth = ancestor.get("parameters", {}).get("max_depth", 8)
    while isinstance(ancestor, dict) and ancestor.get("kind") != "mesostructure":
        ancestor = ancestor.get("parent")
    return {"max_depth": depth, **(ancestor or {})}


def mesostructure_of(filename: PathLike) -> tuple[Mesostructure, int]:
    """The mesostructure that a representation was made from, and the path depth of its synthesis.

    Parameters
    ----------
    filename : path-like

    Returns
    -------
    Mesostructure, int

    Raises
    ------
    InputError
        When the file does not say, or the geometry that it names has changed.
    """
    parent = _parent(filename)
    return _built(filename, parent), parent.get("max_depth", 8)


def _mesostructure(plane: _Plane, parent: Facts, given: PathLike | Mesostructure | None) -> Mesostructure:
    from btfref.mesostructure import build

    return _built(plane.filename, parent) if given is None else build(given)


def _built(filename: PathLike, parent: Facts) -> Mesostructure:
    from btfref.mesostructure import FROM_FILES, build
    from btfref.sampling.job import fingerprint

    if "name" not in parent:
        raise InputError(
            "the BTF does not say which mesostructure it shows",
            file=filename,
            field="parent",
            expected="a synthetic BTF",
        )
    built = build(parent["name"], **parent.get("parameters", {}))
    if parent["name"] in FROM_FILES and fingerprint(built) != parent.get("geometry"):
        raise InputError(
            "the file that the BTF was made from has changed",
            file=parent["parameters"]["file"],
            field="geometry",
        )
    return built


def _sensor(mi: JitArray, camera: Camera) -> dict[str, Any]:
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(np.asarray(camera.to_world, np.float64)),
        "fov": float(np.degrees(camera.x_fov)),
        "fov_axis": "x",
        "near_clip": camera.near,
        "far_clip": camera.far,
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }


def _light(light: Light) -> dict[str, Any]:
    import mitsuba as mi

    power = {"type": "rgb", "value": [float(value) for value in light.power]}
    position = [float(value) for value in light.position]
    if light.kind == "directional":
        return {"type": "directional", "direction": [-value for value in position], "irradiance": power}
    if light.kind == "spot":
        # The beam is round: whichever way is up.
        up = np.eye(3)[np.abs(light.axis).argmin()].tolist()
        target = (light.position + light.axis).tolist()
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(position, target, up),
            "intensity": power,
            "cutoff_angle": float(np.degrees(light.cutoff)),
            "beam_width": float(np.degrees(light.beam_width)),
        }
    return {"type": "point", "position": position, "intensity": power}
