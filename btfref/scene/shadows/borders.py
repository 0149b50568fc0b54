"""Borders of cast shadows: the pixels in which two renderers may have a light reach a sample, or not."""

from __future__ import annotations

import numpy as np

from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.emitters.area_lights import AreaLights, area_lights
from btfref.scene.emitters.lights import is_delta
from btfref.types import JitArray

#: Distance in pixels, along each axis, within which a shadow may begin for a renderer that traces shadow rays, as the
#: reference does, or meets triangles with them, as btfref's shadow maps do: both round, and a map's texel may hide one
#: of several borders that lie in it.
NEAR = 0.125

#: The same for a renderer whose shadows are as fine as the texels of a map of depths.
COARSE = 1.0

#: A step that leaves the tangent plane by more than this share of a pixel's footprint leads to another surface: the
#: edge between them is no border of a shadow.
STEP = 0.25

#: Cosine between a light and a triangle's plane below which not the shape decides, but where the shadow ray starts: it
#: does so 1e-4 of the coordinates beside the surface, which is what triangles of a tenth measure then, seen from the
#: light.
EDGE_ON = 1e-3


def shadow_borders(scene: JitArray, grid: int, near: float = NEAR) -> np.ndarray:
    """Pixels with a sample near to the border of a shadow.

    A shadow ray towards every delta light, and every point that stands for an area light, is traced from each sample's
    point, as the reference does it, and from four points of the same surface beside it, ``near`` pixels away along both
    axes of the picture. Where they disagree, the border of a shadow is near; so it is where the light sees the triangle
    edge-on. Lights below the horizon of the shading normal do not count. Each of the points has a border of its own, so
    that most of a penumbra is near to one. Five rays are traced where the reference traces one, and none any more for a
    sample that is near to a border already.

    Parameters
    ----------
    scene : mitsuba.Scene
        Of a JIT variant.
    grid : int
        n of the n × n samples.
    near : float
        In pixels.

    Returns
    -------
    ndarray of bool, shape (H, W)
    """
    import drjit as dr
    import mitsuba as mi

    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    lights, areas = [light for light in scene.emitters() if is_delta(light)], area_lights(scene, mi)
    found = np.zeros(width * height, bool)
    (ray, _), (beside, _) = (film_rays(sensor, (x, 0.5)) for x in (0.5, 1.5))
    pixel = dr.norm(ray.d - beside.d)
    dr.eval(pixel)
    for offset in grid_offsets(grid) if lights or len(areas) else ():
        si = scene.ray_intersect(film_rays(sensor, offset)[0])
        dr.eval(si)
        room, seen, border = STEP * pixel * si.t, [], mi.Bool(False)
        for light in lights:
            matters, free, edge_on = _reaches(scene, light, si)
            border |= matters & edge_on
            seen.append((matters, free))
        dr.eval(seen, border, room)
        beside_it = []
        for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            moved = scene.ray_intersect(film_rays(sensor, (offset[0] + x * near, offset[1] + y * near))[0])
            dr.eval(moved)
            step = moved.p - si.p
            same = moved.is_valid() & (moved.shape == si.shape) & (moved.instance == si.instance)
            same &= dr.maximum(dr.abs(dr.dot(si.n, step)), dr.abs(dr.dot(moved.n, step))) <= room
            for light, (matters, free) in zip(lights, seen, strict=True):
                also, other, _ = _reaches(scene, light, moved)
                border |= same & matters & also & (free != other)
            dr.eval(border, same)
            beside_it.append((moved, same))
        if len(areas):
            border |= _near_borders_of(scene, areas, si, beside_it, border)
        found |= np.array(border & si.is_valid())
    return found.reshape(height, width)


def _near_borders_of(
    scene: JitArray,
    areas: AreaLights,
    si: JitArray,
    beside: list[tuple[JitArray, JitArray]],
    known: JitArray,
) -> JitArray:
    """The same for the points of area lights: samples at which one of them has a border, or is seen edge-on.

    Parameters
    ----------
    scene : mitsuba.Scene
    areas : AreaLights
    si : mitsuba.SurfaceInteraction3f
        At the samples.
    beside : list of (mitsuba.SurfaceInteraction3f, mitsuba.Bool)
        Beside them, and whether on the same surface.
    known : mitsuba.Bool
        Samples that are near to a border anyway.
    """
    import drjit as dr
    import mitsuba as mi

    tables = areas.on_device()[:2]

    def reaches(at: JitArray, place: JitArray, normal: JitArray, active: JitArray) -> tuple[JitArray, ...]:
        towards = dr.normalize(place - at.p)
        matters = active & at.is_valid() & (dr.dot(towards, normal) < 0)
        matters &= (at.to_local(towards).z * at.wi.z > 0) | mi.has_flag(
            at.bsdf().flags(), mi.BSDFFlags.Transmission
        )
        return matters, ~scene.ray_test(at.spawn_ray_to(place), matters), towards

    def step(i: JitArray, border: JitArray) -> tuple[JitArray, JitArray]:
        place, normal = (dr.gather(type(table), table, i) for table in tables)
        matters, free, towards = reaches(si, place, normal, ~border & ~known)
        near = matters & (dr.abs(dr.dot(si.n, towards)) < EDGE_ON)
        for moved, same in beside:
            also, other, _ = reaches(moved, place, normal, matters & same & ~near)
            near |= also & (free != other)
        return i + 1, border | near

    count = dr.opaque(mi.UInt32, len(areas))
    start = dr.zeros(mi.UInt32, dr.width(si)), dr.zeros(mi.Bool, dr.width(si))
    found = dr.while_loop(start, lambda i, _: i < count, step, labels=("light", "border"))[1]
    dr.eval(found)
    return found


def _reaches(scene: JitArray, light: JitArray, si: JitArray) -> tuple[JitArray, JitArray, JitArray]:
    """Whether a light shines above the horizon of surface interactions, reaches them, sees their triangles edge-on."""
    import drjit as dr
    import mitsuba as mi

    sample, power = light.sample_direction(si, mi.Point2f(0.5), si.is_valid())
    matters = si.is_valid() & (sample.pdf > 0) & (dr.max(power) > 0)
    matters &= (si.to_local(sample.d).z * si.wi.z > 0) | mi.has_flag(
        si.bsdf().flags(), mi.BSDFFlags.Transmission
    )
    free = ~scene.ray_test(si.spawn_ray_to(sample.p), matters)
    return matters, free, dr.abs(dr.dot(si.n, sample.d)) < EDGE_ON
