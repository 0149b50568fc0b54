"""Pixel classes: where two renderers can be compared point by point, and where they cannot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from btfref.conventions import PixelClass
from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.lights import is_delta
from btfref.scene.loading import loaded
from btfref.types import JitArray, SceneLike

#: A step between neighbouring samples that leaves the tangent plane by more than this share of a pixel's
#: footprint is an edge. A smooth surface of curvature κ leaves it by κ s²/2 (s the distance of the samples),
#: which is far less; a fold in front of another surface leaves it by their distance.
STEP = 0.25

#: Distance in pixels, along each axis, within which a rasterizer may give a sample to the next triangle:
#: vertices are rounded to multiples of 1/256 pixel (Direct3D 11.3 functional specification, 3.4.1; GPUs and
#: llvmpipe follow it).
SNAP = 0.5 / 256

#: Distance in uv, along each axis and both diagonals, within which two renderers may hit different points of a
#: displaced surface: interpolated texture coordinates round by 1e-6 of their range, which repeats several times.
HIT = 1e-5

#: Change of the value within that distance, as a share of the largest value of the picture, that is an edge of the
#: mesostructure (its silhouettes, borders of its shadows) and no rounding.
EDGE = 1e-3

#: Turn of the tangent frame, in radians, below which the neighbouring triangle shows the same value.
TURN = 1e-4


def pixel_classes(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    size: tuple[int, int] | None = None,
    grid: int = 4,
    variant: str = "llvm_ad_rgb",
) -> np.ndarray:
    """Class of every pixel, from the primary hits of a regular sub-pixel grid.

    A pixel is *silhouette* when samples of it or of its eight neighbours mix hit and miss or several shapes,
    when the surface jumps in depth between two of them (a fold in front of the cloth itself), or when the
    view passes the horizon of the shading normal, where B jumps to zero. There, two renderers may see
    different surfaces at the same sample: rasterizers snap vertices to 1/256 pixel. Hence a pixel is
    silhouette, too, when one of its samples lies that close to an edge between triangles whose tangent frames
    differ: ∂p/∂u is constant on a triangle, so B jumps there. *Mesostructure* are the other pixels in which a
    material with a geometry of its own (a g-BRDF) jumps within `HIT` of a sample, under one of the scene's delta
    lights. All other pixels that are hit are *interior*.

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

    Returns
    -------
    ndarray of uint8, shape (H, W)
        Codes of `PixelClass`.
    """
    with loaded(scene, parameters, variant=variant, size=size, sampled=False) as made:
        shape, point, normal, front, footprint, ambiguous = _hits(made, grid)
        jumps = _displaced_edges(made, grid)
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
    any_edge |= np.any(ambiguous.reshape(pixels), axis=(1, 3))
    any_hit = hit.reshape(pixels).any((1, 3))
    inner = np.where(jumps, PixelClass.MESOSTRUCTURE, PixelClass.INTERIOR)
    seen = np.where(any_hit, inner, PixelClass.BACKGROUND)
    return np.where(any_edge, PixelClass.SILHOUETTE, seen).astype(np.uint8)


def _displaced_edges(scene: JitArray, grid: int) -> np.ndarray | bool:
    """Pixels with a sample where a displaced material jumps, bool (H, W), or False where there is none."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_plugins.protocol import is_displaced

    if not any(is_displaced(shape.bsdf()) for shape in scene.shapes()):
        return False
    lights = [light for light in scene.emitters() if is_delta(light)]
    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    spread, largest = np.zeros((2, width * height))
    context = mi.BSDFContext()
    moves = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)]
    for offset in grid_offsets(grid):
        ray, _ = film_rays(sensor, offset)
        si = scene.ray_intersect(ray)
        bsdf, uv = si.bsdf(ray), mi.Point2f(si.uv)
        dr.eval(si)
        for light in lights:
            sample, power = light.sample_direction(si, mi.Point2f(0.5), si.is_valid())
            towards, active = si.to_local(sample.d), si.is_valid() & (sample.pdf > 0)
            values = []
            for x, y in moves:
                # The distances are data, not code: all moves share one kernel.
                si.uv = uv + mi.Point2f(dr.opaque(mi.Float, HIT * x), dr.opaque(mi.Float, HIT * y))
                value = dr.select(active, power * bsdf.eval(context, si, towards, active), 0)
                values.append(np.array(value))
            step = np.abs(np.stack(values[1:]) - values[0]).max((0, 1))
            spread, largest = np.maximum(spread, step), np.maximum(largest, np.abs(values[0]).max(0))
    return (spread > EDGE * largest.max(initial=0)).reshape(height, width)


def _part(ndim: int, axis: int, part: slice) -> tuple[slice, ...]:
    index = [slice(None)] * ndim
    index[axis] = part
    return tuple(index)


def _spread(mask: np.ndarray) -> np.ndarray:
    """A mask grown by one pixel in all eight directions."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    return np.any([padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0)


def _hits(scene: JitArray, grid: int) -> list[np.ndarray]:
    """Primary hits on the fine grid.

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
        Within `SNAP` of a triangle with another tangent frame.
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
    for number, offset in enumerate(offsets):
        ray, _ = film_rays(sensor, offset)
        beside, _ = film_rays(sensor, (offset[0] + 1, offset[1]))
        si = scene.ray_intersect(ray)
        hit = si.is_valid()
        ambiguous = dr.zeros(mi.Bool, dr.width(ray))
        for x, y in ((-SNAP, -SNAP), (SNAP, -SNAP), (-SNAP, SNAP), (SNAP, SNAP)):
            moved = scene.ray_intersect(film_rays(sensor, (offset[0] + x, offset[1] + y))[0], hit)
            other = (moved.prim_index != si.prim_index) & moved.is_valid()
            ambiguous |= other & (dr.norm(moved.sh_frame.s - si.sh_frame.s) > TURN)
        values = {
            "shape": dr.select(hit, dr.reinterpret_array(mi.UInt32, si.shape), 0),
            "point": dr.select(hit, si.p, 0),
            "normal": dr.select(hit, si.n, 0),
            "front": si.wi.z > 0,
            "footprint": dr.select(hit, si.t * dr.norm(ray.d - beside.d), 0),
            "ambiguous": ambiguous,
        }
        dr.eval(values)
        j, i = divmod(number, grid)
        for name, value in values.items():
            array = np.array(value)
            array = array.T if array.ndim == 2 else array
            made[name][:, j, :, i] = array.reshape(height, width, *array.shape[1:])
    return [array.reshape(height * grid, width * grid, *array.shape[4:]) for array in made.values()]
