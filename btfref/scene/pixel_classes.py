"""Pixel classes: where two renderers can be compared point by point, and where they cannot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from btfref.conventions import PixelClass
from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.emitters.lights import is_delta
from btfref.scene.loading import loaded
from btfref.scene.reading.instances import every_shape
from btfref.scene.shadows.borders import COARSE, NEAR, shadow_borders
from btfref.scene.surfaces.materials import is_exact
from btfref.types import JitArray, SceneLike

#: A step between neighbouring samples that leaves the tangent plane by more than this share of a pixel's
#: footprint is an edge. A smooth surface of curvature κ leaves it by κ s²/2 (s the distance of the samples),
#: which is far less; a fold in front of another surface leaves it by their distance.
STEP = 0.25

#: Distance in pixels, along each axis, within which a rasterizer may decide otherwise whether a sample hits a surface:
#: vertices are rounded to multiples of 1/256 pixel (Direct3D 11.3 functional specification, 3.4.1; GPUs and
#: llvmpipe follow it).
SNAP = 0.5 / 256

#: Angle, in radians, within which two renderers may give a sample to one or the other of two triangles that meet, over
#: the cosine at which they are seen. Which one the rasterizer draws does not matter, since shaders follow the ray
#: (``lib/surface/triangle_table.glsl``), so that rounding is left: positions at a distance of some units are good to
#: 5e-7 of it in float32, in each renderer; a foreshortened triangle's determinant loses by its cosine.
ROUNDING = 1e-6

#: Step in depth, in pixels, between rays `SNAP` apart that is an edge: a smooth surface leaves its tangent plane by far
#: less, unless it is seen at grazing.
NEAR_STEP = 8 * SNAP

#: z of the view, in the shading frame, below which renderers may differ on which side is seen.
HORIZON = 1e-5

#: Change of the texture coordinates between rays `ROUNDING` apart that is a seam.
SEAM = 1e-3

#: Distance in uv, along each axis and both diagonals, within which two renderers may hit different points of a
#: displaced surface: interpolated texture coordinates round by 1e-6 of their range, which repeats several times.
HIT = 1e-5

#: Change of a sample within that distance that is an edge of the mesostructure (its silhouettes, borders of its
#: shadows) and no rounding: it moves its pixel by this share of the value that errors are relative to. That is the
#: pixel's own, but at least `DARK` of the largest; both as "image.noise_free" has them.
EDGE, DARK = 1e-3, 1e-3

#: Pixels whose changes are looked at together.
TOGETHER = 1 << 17

#: Turn of the shading frame, in radians, below which the neighbouring triangle shows the same value.
TURN = 1e-4

#: Turn of the frame of one sphere, disk or cylinder between such rays that is none of its curvature: at a pole, or the
#: centre of a disk, tangents take every direction.
POLE = 1e-3


def pixel_classes(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    size: tuple[int, int] | None = None,
    grid: int = 4,
    variant: str = "llvm_ad_rgb",
    follows_rays: bool = True,
    shadows: bool = False,
) -> np.ndarray:
    """Class of every pixel, from the primary hits of a regular sub-pixel grid.

    A sample *may be seen otherwise* by another renderer where rays half a step of 1/256 pixel beside it, by which
    rasterizers snap vertices, hit something else: nothing, another shape, a surface at another depth, or the other side
    of the shading normal, at whose horizon B jumps to zero; and where rays within float32 rounding hit a triangle with
    another frame or other texture coordinates, since ∂p/∂u is constant on a triangle and B jumps there, or the pole or
    the seam of a sphere, disk or cylinder. A pixel with such a sample is *silhouette*. An *edge* pixel has none, but
    its samples or those of its eight neighbours meet an edge: they mix hit and miss or several shapes, the surface
    jumps in depth between two of them (a fold in front of the cloth itself), or turns away from the view.
    *Mesostructure* are other pixels in which a material with a geometry of its own (a g-BRDF) jumps within `HIT` of a
    sample, under one of the scene's delta lights; *shadow border* those, in a picture with cast shadows, in which the
    border of one is near to a sample (:func:`btfref.scene.shadows.borders.shadow_borders`). All other pixels that are
    hit are *interior*, be they lit or in shadow. *Other* is every pixel with a sample that sees a material of which
    real time shows the mean albedo (:mod:`btfref.scene.surfaces.materials`).

    Parameters
    ----------
    scene : path-like or dict
    parameters : dict of str to str, optional
    size : (int, int), optional
        Width and height in place of the scene's.
    grid : int
        n of the n × n samples.
    variant : str
        A JIT variant of Mitsuba.
    follows_rays : bool
        Whether the renderer to be judged decides by rays between triangles that meet, as btfref's does. False: by its
        rasterizer, which snaps inner edges as it does silhouettes; and on shadows by depths in a map.
    shadows : bool
        Whether the picture has cast shadows.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        Codes of `PixelClass`.
    """
    with loaded(
        scene, parameters, variant=variant, size=size, sampled=False, interpolation="blended"
    ) as made:
        shape, point, normal, front, footprint, ambiguous = _hits(
            made, grid, ROUNDING if follows_rays else np.inf
        )
        jumps = _displaced_edges(made, grid)
        other = _other_materials(made, grid)
        border = shadow_borders(made, grid, NEAR if follows_rays else COARSE) if shadows else False
    hit = shape > 0
    edge = np.zeros(shape.shape, bool)
    for axis in (0, 1):
        a, b = (_part(shape.ndim, axis, part) for part in (slice(None, -1), slice(1, None)))
        both = hit[a] & hit[b]
        step = point[b] - point[a]
        away = np.maximum(abs((normal[a] * step).sum(-1)), abs((normal[b] * step).sum(-1)))
        differs = (shape[a] != shape[b]) | (both & (front[a] != front[b]))
        differs |= both & (away > STEP * footprint[a])
        edge[a] |= differs
        edge[b] |= differs
    pixels = (shape.shape[0] // grid, grid, shape.shape[1] // grid, grid)
    any_edge = _spread(np.any(edge.reshape(pixels), axis=(1, 3)))
    any_hit = hit.reshape(pixels).any((1, 3))
    seen = np.where(any_hit, np.where(any_edge, PixelClass.EDGE, PixelClass.INTERIOR), PixelClass.BACKGROUND)
    seen = np.where(border & any_hit, PixelClass.SHADOW_BORDER, seen)
    seen = np.where(jumps & any_hit, PixelClass.MESOSTRUCTURE, seen)
    seen = np.where(np.any(ambiguous.reshape(pixels), axis=(1, 3)), PixelClass.SILHOUETTE, seen)
    return np.where(other, PixelClass.OTHER, seen).astype(np.uint8)


def _other_materials(scene: JitArray, grid: int) -> np.ndarray | bool:
    """Pixels with a sample that sees a material that real time shows otherwise, bool (H, W), or False without any."""
    import drjit as dr
    import mitsuba as mi

    others = [bsdf for bsdf in {id(b): b for b in _materials(scene)}.values() if not is_exact(bsdf)]
    if not others:
        return False
    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    found = np.zeros(width * height, bool)
    for offset in grid_offsets(grid):
        si = scene.ray_intersect(film_rays(sensor, offset)[0])
        seen = dr.reinterpret_array(mi.UInt32, si.bsdf())
        dr.eval(seen)
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in others]
        found |= np.array(si.is_valid()) & np.isin(np.array(seen), numbers)
    return found.reshape(height, width)


def _materials(scene: JitArray) -> list[JitArray]:
    """Materials of all shapes."""
    return [shape.bsdf() for shape in every_shape(scene)]


def _displaced_edges(scene: JitArray, grid: int) -> np.ndarray | bool:
    """Pixels with a sample where a displaced material jumps, bool (H, W), or False where there is none."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_plugins.protocol import is_displaced

    if not any(is_displaced(shape.bsdf()) for shape in every_shape(scene)):
        return False
    lights = [light for light in scene.emitters() if is_delta(light)]
    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    spread, total = np.zeros(width * height), np.zeros((3, width * height))
    context = mi.BSDFContext()
    moves = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)]
    steps = [HIT * np.array(axis, float) for axis in zip(*moves, strict=True)]
    pixels = width * height
    for offset in grid_offsets(grid):
        ray, _ = film_rays(sensor, offset)
        si = scene.ray_intersect(ray)
        dr.eval(si)
        for first in range(0, pixels, TOGETHER):
            part = slice(first, min(first + TOGETHER, pixels))
            # All moves of a sample beside each other: one launch, not nine.
            lane = dr.arange(mi.UInt32, (part.stop - first) * len(moves))
            index = lane // len(moves)
            moved = dr.gather(mi.SurfaceInteraction3f, si, index + dr.opaque(mi.UInt32, first))
            moved.uv += mi.Point2f(
                [dr.gather(mi.Float, mi.Float(s), lane - index * len(moves)) for s in steps]
            )
            bsdf = moved.bsdf()
            for light in lights:
                sample, power = light.sample_direction(moved, mi.Point2f(0.5), moved.is_valid())
                towards, active = moved.to_local(sample.d), moved.is_valid() & (sample.pdf > 0)
                value = dr.select(active, power * bsdf.eval(context, moved, towards, active), 0)
                values = np.array(value).reshape(3, -1, len(moves))
                step = np.abs(values[..., 1:] - values[..., :1]).max((0, 2))
                spread[part] = np.maximum(spread[part], step)
                total[:, part] += values[..., 0]
    value = np.abs(total).max(0)
    return (spread > EDGE * np.maximum(value, DARK * value.max(initial=0))).reshape(height, width)


def _part(ndim: int, axis: int, part: slice) -> tuple[slice, ...]:
    index = [slice(None)] * ndim
    index[axis] = part
    return tuple(index)


def _spread(mask: np.ndarray) -> np.ndarray:
    """A mask grown by one pixel in all eight directions."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    return np.any([padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0)


def _hits(scene: JitArray, grid: int, angle: float) -> list[np.ndarray]:
    """Primary hits on the fine grid; between triangles that meet, ``angle`` decides, but no more than `SNAP`.

    Returns
    -------
    shape : ndarray of uint32, (H·n, W·n)
        0 for a miss.
    point, normal : ndarray of float32, (H·n, W·n, 3)
        Normals are geometric.
    front : ndarray of bool
        Side of the shading normal that is seen.
    footprint : ndarray of float32
        Size of a pixel at the hit.
    ambiguous : ndarray of bool
        Where another renderer may see something else.
    """
    import drjit as dr
    import mitsuba as mi

    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    fine = (height, grid, width, grid)
    made = {
        "shape": np.zeros(fine, np.uint32),
        "point": np.zeros((*fine, 3), np.float32),
        "normal": np.zeros((*fine, 3), np.float32),
        "front": np.zeros(fine, bool),
        "footprint": np.zeros(fine, np.float32),
        "ambiguous": np.zeros(fine, bool),
    }
    offsets = grid_offsets(grid)
    (ray, _), (beside, _) = (film_rays(sensor, (x, 0.5)) for x in (0.5, 1.5))
    pixel = dr.norm(ray.d - beside.d)
    dr.eval(pixel)
    for number, offset in enumerate(offsets):
        seen = _seen(scene, offset)
        footprint = dr.select(seen["shape"] > 0, seen["distance"] * pixel, 0)
        ambiguous = (seen["shape"] > 0) & (dr.abs(seen["height"]) < HORIZON)
        # In pixels. Seen at grazing, a determinant loses by as much as the triangle is foreshortened.
        rounding = dr.minimum(SNAP, dr.opaque(mi.Float, angle) / (pixel * dr.maximum(seen["facing"], 1e-6)))
        dr.eval(footprint, ambiguous, rounding)
        # One ray after the other: all of them share one kernel, which is quick to compile.
        for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            snapped = _seen(scene, (offset[0] + x * SNAP, offset[1] + y * SNAP))
            ambiguous |= _seen_otherwise(seen, snapped, footprint)
            dr.eval(ambiguous)
            moved = offset[0] + x * rounding, offset[1] + y * rounding
            dr.eval(moved)
            near = _seen(scene, moved)
            ambiguous |= _in_another_frame(seen, near)
            dr.eval(ambiguous)
        values = {
            "shape": seen["shape"],
            "point": dr.select(seen["shape"] > 0, seen["point"], 0),
            "normal": dr.select(seen["shape"] > 0, seen["normal"], 0),
            "front": seen["height"] > 0,
            "footprint": footprint,
            "ambiguous": ambiguous,
        }
        dr.eval(values)
        j, i = divmod(number, grid)
        for name, value in values.items():
            array = np.array(value)
            array = array.T if array.ndim == 2 else array
            made[name][:, j, :, i] = array.reshape(height, width, *array.shape[1:])
    return [array.reshape(height * grid, width * grid, *array.shape[4:]) for array in made.values()]


def _seen(scene: JitArray, offset: tuple[float | JitArray, float | JitArray]) -> dict[str, JitArray]:
    """What a point of every pixel sees, on the device: shape (0 for none), triangle, place, frame."""
    import drjit as dr
    import mitsuba as mi

    ray, _ = film_rays(scene.sensors()[0], offset)
    si = scene.ray_intersect(ray)
    # Two instances show one shape: it takes both numbers.
    number = dr.reinterpret_array(mi.UInt32, si.shape) + (dr.reinterpret_array(mi.UInt32, si.instance) << 16)
    seen = {
        "shape": dr.select(si.is_valid(), number, 0),
        "triangle": si.prim_index,
        "mesh": si.is_valid() & si.shape.is_mesh(),
        "distance": si.t,
        "point": si.p,
        "normal": si.n,
        "facing": dr.abs(dr.dot(si.n, ray.d)),
        "height": si.wi.z,
        "tangent": si.sh_frame.s,
        "shading": si.sh_frame.n,
        "uv": si.uv,
    }
    dr.eval(seen)
    return seen


def _seen_otherwise(one: dict[str, JitArray], other: dict[str, JitArray], footprint: JitArray) -> JitArray:
    """Whether a ray beside hits what the rasterizer may take for the sample's: another surface, or its other side."""
    import drjit as dr

    both = (one["shape"] > 0) & (other["shape"] > 0)
    step = other["point"] - one["point"]
    away = dr.maximum(dr.abs(dr.dot(one["normal"], step)), dr.abs(dr.dot(other["normal"], step)))
    differs = ((one["height"] > 0) != (other["height"] > 0)) | (away > NEAR_STEP * footprint)
    return (one["shape"] != other["shape"]) | (both & differs)


def _in_another_frame(one: dict[str, JitArray], other: dict[str, JitArray]) -> JitArray:
    """Whether a ray beside hits a place whose shading frame or texture coordinates are not the continued ones."""
    import drjit as dr

    turn = dr.norm(other["tangent"] - one["tangent"]) + dr.norm(other["shading"] - one["shading"])
    jump = dr.max(dr.abs(other["uv"] - one["uv"])) > SEAM
    both = (one["shape"] > 0) & (other["shape"] > 0)
    # Triangles that meet, or a pole and the seam of a shape that is one piece.
    apart = one["mesh"] & (one["triangle"] != other["triangle"]) & ((turn > TURN) | jump)
    return both & (apart | (~one["mesh"] & ((turn > POLE) | jump)))
