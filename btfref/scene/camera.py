"""The camera of a Mitsuba scene: its rays at chosen sub-pixel positions, and what materials need to know of it."""

from __future__ import annotations

import numpy as np

from btfref.types import JitArray


def tell_camera(scene: JitArray, share: float) -> None:
    """Give the camera to the materials that choose a level of detail by the pixel's footprint.

    Stock integrators hand no texture derivatives to a BSDF. A ``pixel_angle`` that the scene itself sets is kept.

    Parameters
    ----------
    scene : mitsuba.Scene
    share : float
        Side of a sample's footprint in pixels: 1/√spp, as pbrt scales ray differentials, so that the picture
        converges to the unfiltered one.
    """
    import mitsuba as mi

    if "scalar" in mi.variant():
        return
    values = mi.traverse(scene.sensors()[0])
    if "x_fov" not in values:
        return
    width = int(scene.sensors()[0].film().size()[0])
    to_world = np.array(values["to_world"].matrix, float)
    angle = 2 * np.tan(np.radians(float(values["x_fov"][0])) / 2) / width * share
    parameters = mi.traverse(scene)
    # An update computes all that is left: of maps that are not optimised, copies that nobody needs.
    parameters.keep([r"(.*\.)?pixel_angle$", r"(.*\.)?camera$"])
    for key in [k for k in parameters.keys() if k.split(".")[-1] == "pixel_angle"]:
        if float(parameters[key][0]) == 0:
            parameters[key] = mi.Float(angle)
            parameters[key.removesuffix("pixel_angle") + "camera"] = mi.Point3f(to_world[:3, 3].tolist())
    parameters.update()


def film_rays(
    sensor: JitArray, offset: tuple[float | JitArray, float | JitArray], pixel: JitArray | None = None
) -> tuple[JitArray, JitArray]:
    """Camera rays through the point ``offset`` of every pixel (from its top left corner), row by row.

    The offset is a pair of numbers, or of mitsuba.Float with one for each ray; ``pixel`` (mitsuba.UInt32) chooses
    pixels by their flat index.

    Returns
    -------
    rays : mitsuba.Ray3f
    weight : mitsuba.Spectrum
    """
    import drjit as dr
    import mitsuba as mi

    width, height = (int(n) for n in sensor.film().crop_size())
    index = dr.arange(mi.UInt32, width * height) if pixel is None else pixel
    x, y = mi.Float(index % width), mi.Float(index // width)
    # The offset is data, not code: all sub-pixel samples share one kernel.
    ox, oy = (o if dr.is_array_v(o) else dr.opaque(mi.Float, float(o)) for o in offset)
    position = mi.Point2f((x + ox) / width, (y + oy) / height)
    ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
    return ray, weight


def grid_offsets(n: int) -> list[tuple[float, float]]:
    """Sub-pixel samples ((i + ½)/n, (j + ½)/n), row by row."""
    return [((i + 0.5) / n, (j + 0.5) / n) for j in range(n) for i in range(n)]
