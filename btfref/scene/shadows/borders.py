"""Borders of cast shadows: the pixels in which two renderers may have a light reach a sample, or not."""

from __future__ import annotations

import numpy as np

from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.lights import is_delta
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

    A shadow ray towards every delta light is traced from each sample's point, as the reference does it, and from four
    points of the same surface beside it, ``near`` pixels away along both axes of the picture. Where they disagree, the
    border of a shadow is near; so it is where the light sees the triangle edge-on. Lights below the horizon of the
    shading normal do not count.

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
    lights = [light for light in scene.emitters() if is_delta(light)]
    found = np.zeros(width * height, bool)
    (ray, _), (beside, _) = (film_rays(sensor, (x, 0.5)) for x in (0.5, 1.5))
    pixel = dr.norm(ray.d - beside.d)
    dr.eval(pixel)
    for offset in grid_offsets(grid) if lights else ():
        si = scene.ray_intersect(film_rays(sensor, offset)[0])
        dr.eval(si)
        room, seen, border = STEP * pixel * si.t, [], mi.Bool(False)
        for light in lights:
            matters, free, edge_on = _reaches(scene, light, si)
            border |= matters & edge_on
            seen.append((matters, free))
        dr.eval(seen, border, room)
        for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            moved = scene.ray_intersect(film_rays(sensor, (offset[0] + x * near, offset[1] + y * near))[0])
            dr.eval(moved)
            step = moved.p - si.p
            same = moved.is_valid() & (moved.shape == si.shape)
            same &= dr.maximum(dr.abs(dr.dot(si.n, step)), dr.abs(dr.dot(moved.n, step))) <= room
            for light, (matters, free) in zip(lights, seen, strict=True):
                also, other, _ = _reaches(scene, light, moved)
                border |= same & matters & also & (free != other)
            dr.eval(border)
        found |= np.array(border & si.is_valid())
    return found.reshape(height, width)


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
