"""Primary hits as data: what any evaluator needs to know of a camera ray, in the texture's own frame.

Pictures of the float64 definition (:mod:`btfref.render.definition`) and of the mesostructure under every hit
(:mod:`btfref.render.exact`) start from the hits of the reference renderer, so that they differ from its picture by
nothing but the material.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.errors import InputError
from btfref.render.reference import film_rays
from btfref.render.scene import read_scene


@dataclass(frozen=True)
class Hits:
    """Lit and unlit hits of camera rays.

    Parameters
    ----------
    pixel : ndarray of int, shape (N,)
        Flat index of the pixel, row by row; only rays that hit are here.
    uv : ndarray of float32, shape (N, 2)
        After the material's transform.
    w_view : ndarray of float32, shape (N, 3)
        In the texture's frame; mirrored to the front where a two-sided material is seen from behind.
    w_light : ndarray of float32, shape (n_lights, N, 3)
    power : ndarray of float32, shape (n_lights, N, 3)
        Irradiance perpendicular to the light's direction; 0 where a light does not reach, cast shadows apart.
    """

    pixel: np.ndarray
    uv: np.ndarray
    w_view: np.ndarray
    w_light: np.ndarray
    power: np.ndarray


def single_material(scene, parameters=None, *, size=None):
    """The description of a scene whose shapes all show one BTF, and that material.

    Returns
    -------
    SceneDescription, BtfMaterial

    Raises
    ------
    InputError
        When the scene cannot be read, or shows several materials or none.
    """
    description = read_scene(scene, parameters, size=size)
    materials = [mesh.material for mesh in description.meshes]
    first = materials[0] if materials else None
    same = first is not None and all(
        m is not None
        and (m.filename, m.filter_type, m.scale, m.twosided)
        == (first.filename, first.filter_type, 1.0, first.twosided)
        and np.array_equal(m.to_uv, first.to_uv)
        for m in materials
    )
    if not same:
        raise InputError(
            "all shapes must show one btf material of scale 1", file=description.source, field="bsdf"
        )
    return description, first


def delta_lights(scene):
    """The emitters of a Mitsuba scene, refused unless all are directional or points."""
    import mitsuba as mi

    delta = int(mi.EmitterFlags.DeltaPosition) | int(mi.EmitterFlags.DeltaDirection)
    for emitter in scene.emitters():
        if not int(emitter.flags()) & delta:
            raise InputError(
                "hits know delta lights only",
                field="emitter",
                got=emitter.class_name(),
                expected="point, directional",
            )
    return scene.emitters()


def intersect(scene, material, offset, pixel=None):
    """Hits of one camera ray a pixel, as Dr.Jit arrays.

    Parameters
    ----------
    scene : mitsuba.Scene
    material : BtfMaterial
    offset : (float or mitsuba.Float, float or mitsuba.Float)
        Place in each pixel, from its top left.
    pixel : mitsuba.UInt32, optional
        Flat indices of the pixels; by default all, one after the other.

    Returns
    -------
    si : mitsuba.SurfaceInteraction3f
        In Mitsuba's frame, for what else a caller needs.
    uv : mitsuba.Point2f
    w_view : mitsuba.Vector3f
    lights : list of (mitsuba.Vector3f, mitsuba.Color3f)
        Direction in the texture's frame and power, as in `Hits`.
    """
    import drjit as dr
    import mitsuba as mi

    ray, _ = film_rays(scene.sensors()[0], offset, pixel)
    si = scene.ray_intersect(ray)
    (a, b, c), (d, e, f) = material.to_uv.tolist()
    u, v = si.uv
    uv = mi.Point2f(dr.fma(u, a, dr.fma(v, b, c)), dr.fma(u, d, dr.fma(v, e, f)))
    cosine, sine = (float(x) for x in material.rotation)
    side = dr.select((si.wi.z < 0) & material.twosided, mi.Float(-1), mi.Float(1))

    def local(w):
        turned = mi.Vector3f(cosine * w.x - sine * w.y, sine * w.x + cosine * w.y, w.z * side)
        return turned if (cosine, sine) != (1.0, 0.0) else mi.Vector3f(w.x, w.y, w.z * side)

    lights = []
    for emitter in delta_lights(scene):
        sample, power = emitter.sample_direction(si, mi.Point2f(0.5), si.is_valid())
        power = dr.select(si.is_valid() & (sample.pdf > 0), mi.Color3f(power), 0)
        lights.append((local(si.to_local(sample.d)), power))
    return si, uv, local(si.wi), lights


def as_arrays(si, uv, w_view, lights):
    """`intersect`'s result as `Hits`, rays that miss left out."""
    import drjit as dr

    dr.eval(uv, w_view, lights)
    hit = np.flatnonzero(np.array(si.is_valid()))

    def rows(value):
        array = np.array(value, np.float32)
        return np.broadcast_to(array.reshape(len(array), -1), (len(array), len(np.array(si.t)))).T[hit]

    return Hits(
        hit,
        rows(uv),
        rows(w_view),
        np.stack([rows(w) for w, _ in lights]),
        np.stack([rows(power) for _, power in lights]),
    )
