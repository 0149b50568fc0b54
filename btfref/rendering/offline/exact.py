"""The mesostructure under every hit, path traced: the truth of a BTF on any shape.

A BTF stands for an infinitely tiled, flat mesostructure that is seen and lit from one direction each. This renderer
asks that mesostructure itself, at the exact place and the exact directions of every camera ray, by paths with next
event estimation (Kajiya 1986), where a representation interpolates between sampled texels and directions. What
bending the mesostructure around the shape would change is beyond any BTF and is left out on both sides;
:mod:`btfref.rendering.offline.geometry` shows it for flat scenes, borders and all.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.rendering import RenderResult
from btfref.rendering.offline.direct_light import emission
from btfref.scene.camera import film_rays
from btfref.scene.description import read_scene
from btfref.scene.emitters.lights import checked_emitters
from btfref.scene.hits import Hits
from btfref.scene.loading import loaded
from btfref.scene.reading.instances import drawn_shapes
from btfref.types import JitArray, SceneLike

if TYPE_CHECKING:
    from btfref.sampling.tiled_scene import TiledScene
    from btfref.scene.description import SceneDescription
    from btfref.scene.shapes import BtfMaterial


#: Independent pictures that the result is the mean of.
BATCHES = 4

#: Paths traced together where there is more than one batch: recording a kernel takes longer than tracing few.
LANES = 1 << 20


#: Of paths: lane, origin, direction, throughput, and the lights with their powers.
State = tuple[JitArray, JitArray, JitArray, JitArray, list[tuple[JitArray, JitArray]]]


def render_exact(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    spp: int = 16,
    grid: int = 2,
    seed: int = 0,
    size: tuple[int, int] | None = None,
    max_depth: int | None = None,
    batches: int = BATCHES,
) -> RenderResult:
    """Path trace the mesostructure at the hits of a scene with lights of any kind, without cast shadows.

    Parameters
    ----------
    scene : path-like or dict
        All shapes show one ``btf`` material of scale 1, made from a synthetic BTF.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    spp : int
        Samples per pixel and batch, stratified over ``grid × grid`` cells; rounded up to a multiple of them.
    grid : int
    seed : int
        Same seed, same picture on the same machine.
    size : (int, int), optional
        Width and height in place of the scene's.
    max_depth : int, optional
        As in Mitsuba; by default that of the BTF's synthesis.
    batches : int
        Independent pictures, at least 2.

    Returns
    -------
    RenderResult
        With the variance of the mean and the independent ``pictures``.

    Raises
    ------
    InputError
        For other lights or materials, or a BTF that does not say which mesostructure it shows.
    """
    from btfref.rendering.offline.geometry import mesostructure_of
    from btfref.sampling.tiled_scene import TiledScene

    for name, value, least in (("spp", spp, 1), ("grid", grid, 1), ("batches", batches, 2)):
        if value < least:
            raise InputError("too few samples", field=name, got=value, expected=f"≥ {least}")
    start = time.perf_counter()
    description, material = _single_material(scene, parameters, size=size)
    mesostructure, depth = mesostructure_of(material.filename)
    depth = depth if max_depth is None else max_depth
    height, width = description.camera.height, description.camera.width
    rounds = -(-spp // grid**2)
    sums = np.zeros((batches, 3, height * width))
    with loaded(scene, parameters, size=size, sampled=False) as made:
        # Lights at any height: the largest patch that there is, and rays beyond it wrap.
        tiles = TiledScene(mesostructure, np.array([[1.0, 0.0, 1e-6]]))
        drawn = drawn_shapes(made, [mesh.where for mesh in description.meshes])
        lamps = [d.shape for d, mesh in zip(drawn, description.meshes, strict=True) if mesh.only_emits]
        together = max(1, min(batches, LANES // (height * width * rounds * grid**2)))
        for first in range(0, batches, together):
            count = min(together, batches - first)
            passed = _pass(made, material, lamps, tiles, grid, rounds, (seed, first, count), depth)
            sums[first : first + count] = passed.reshape(3, count, -1).swapaxes(0, 1)
    pictures = np.moveaxis(sums / (rounds * grid**2), 1, 2).reshape(batches, height, width, 3)
    meta = {
        "renderer": "exact",
        "spp": rounds * grid**2 * batches,
        "seed": int(seed),
        "max_depth": int(depth),
        "mesostructure": {"name": mesostructure.name, "parameters": mesostructure.parameters},
        "seconds": time.perf_counter() - start,
    }
    variance = pictures.var(0, ddof=1) / batches
    return RenderResult(
        pictures.mean(0).astype(np.float32), variance.astype(np.float32), meta, pictures.astype(np.float32)
    )


def _pass(
    scene: JitArray,
    material: BtfMaterial,
    lamps: list[JitArray],
    tiles: TiledScene,
    grid: int,
    rounds: int,
    stream: tuple[int, int, int],
    max_depth: int,
) -> np.ndarray:
    """Sums of ``rounds`` samples in every cell of every pixel's grid, for some batches; (3, count · pixels) float64.

    ``lamps`` are shapes that are lights and nothing else; ``stream`` is the seed, the number of the first batch, and
    how many batches follow each other.
    """
    import drjit as dr
    import mitsuba as mi

    from btfref.sampling.tiled_scene import START, stream_keys, uniforms

    seed, first, count = stream
    width, height = (int(k) for k in scene.sensors()[0].film().crop_size())
    each = rounds * grid**2
    lane = dr.arange(mi.UInt32, count * width * height * each)
    keys = stream_keys(seed, first)
    pixel, cell = (lane // each) % (width * height), lane % grid**2
    u, v, *chosen = uniforms(lane, keys, mi.UInt32(0))
    offset = (mi.Float(cell % grid) + u) / grid, (mi.Float(cell // grid) + v) / grid
    si, uv, w_view, lights = _intersect(scene, material, offset, pixel, mi.Point2f(*chosen))
    lights = [(w, dr.select(w.z > 0, power, 0)) for w, power in lights]
    origin = dr.fma(w_view, START, mi.Point3f(uv.x - dr.floor(uv.x), uv.y - dr.floor(uv.y), 0))
    samples = dr.zeros(mi.Color3f, dr.width(lane)) + emission(scene, si, si.is_valid())
    reflects = si.is_valid() & (w_view.z > 0)
    for lamp in lamps:
        reflects &= si.shape != mi.ShapePtr(lamp)
    index = dr.compress(reflects)
    throughput = mi.Color3f(1) + dr.zeros(mi.Color3f, dr.width(lane))
    state = (lane, origin, mi.Vector3f(-w_view), throughput, lights)
    dr.eval(state, samples)
    vertex = 1
    while dr.width(index) and (max_depth <= 0 or vertex < max_depth):
        # Only paths that go on are traced: survivors are packed.
        state, alive = _vertex(tiles, _taken(state, index), vertex, keys, samples)
        index, vertex = dr.compress(alive), vertex + 1
    return np.array(samples, np.float64).reshape(3, -1, each).sum(-1)


def _taken(value: Any, index: JitArray) -> Any:
    """Nested arrays gathered at an index."""
    import drjit as dr

    if isinstance(value, (tuple, list)):
        return type(value)(_taken(item, index) for item in value)
    return dr.gather(type(value), value, index)


def _vertex(
    tiles: TiledScene, state: State, number: int, keys: JitArray, samples: JitArray
) -> tuple[State, JitArray]:
    """Trace to the next vertex, connect it to the lights, sample the way on."""
    import drjit as dr
    import mitsuba as mi

    from btfref.sampling.paths.estimator import ROULETTE_LIMIT, ROULETTE_VERTEX
    from btfref.sampling.tiled_scene import uniforms

    lane, origin, direction, throughput, lights = state
    depth = dr.opaque(mi.UInt32, number)
    place = tiles.intersect(origin, direction)
    active, bsdf, context = place.is_valid(), place.bsdf(), mi.BSDFContext()
    total = mi.Color3f(0)
    for w_light, power in lights:
        value = throughput * power * bsdf.eval(context, place, place.to_local(w_light), active)
        lit = active & (dr.max(value) > 0)
        lit &= ~tiles.occluded(place.spawn_ray(w_light), lit, coherent=False)
        total += dr.select(lit, value, 0)
    for channel in range(3):
        # Each lane has its own entry: no atomics.
        dr.scatter_add(samples[channel], total[channel], lane, active, mode=dr.ReduceMode.NoConflicts)
    lobe, u, v, _ = uniforms(lane, keys, 2 * depth)
    roulette, _, _, _ = uniforms(lane, keys, 2 * depth + 1)
    sample, weight = bsdf.sample(context, place, lobe, mi.Point2f(u, v), active)
    throughput = throughput * weight
    survival = dr.select(depth >= ROULETTE_VERTEX, dr.minimum(dr.max(throughput), ROULETTE_LIMIT), 1)
    alive = active & (dr.max(throughput) > 0) & (roulette < survival)
    throughput = dr.select(alive, throughput / survival, 0)
    ray = place.spawn_ray(place.to_world(sample.wo))
    state = (lane, mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Color3f(throughput), lights)
    dr.eval(state, alive, samples)
    return state, alive


def _single_material(
    scene: SceneLike, parameters: Mapping[str, object] | None = None, *, size: tuple[int, int] | None = None
) -> tuple[SceneDescription, BtfMaterial]:
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
    materials = [mesh.material for mesh in description.meshes if not mesh.only_emits]
    first = materials[0] if materials else None
    if first is None or not all(
        m is not None
        and (m.filename, m.filter_type, m.scale, m.twosided)
        == (first.filename, first.filter_type, 1.0, first.twosided)
        and np.array_equal(m.to_uv, first.to_uv)
        for m in materials
    ):
        raise InputError(
            "all shapes must show one btf material of scale 1", file=description.source, field="bsdf"
        )
    return description, first


def _intersect(
    scene: JitArray,
    material: BtfMaterial,
    offset: tuple[JitArray, JitArray],
    pixel: JitArray,
    chosen: JitArray,
) -> tuple[JitArray, JitArray, JitArray, list[tuple[JitArray, JitArray]]]:
    """Hits of one camera ray a pixel, as Dr.Jit arrays.

    Parameters
    ----------
    scene : mitsuba.Scene
    material : BtfMaterial
    offset : (float or mitsuba.Float, float or mitsuba.Float)
        Place in each pixel, from its top left.
    pixel : mitsuba.UInt32
        Flat indices of the pixels.
    chosen : mitsuba.Point2f
        Random numbers that choose a direction of an environment, or a point of an area light.

    Returns
    -------
    si : mitsuba.SurfaceInteraction3f
        In Mitsuba's frame, for what else a caller needs.
    uv : mitsuba.Point2f
    w_view : mitsuba.Vector3f
    lights : list of (mitsuba.Vector3f, mitsuba.Color3f)
        Direction in the texture's frame, and irradiance perpendicular to it: 0 where a light does not reach, cast
        shadows apart. Of an environment or an area light one direction, and its radiance over the density of
        choosing it.
    """
    import drjit as dr
    import mitsuba as mi

    ray, _ = film_rays(scene.sensors()[0], offset, pixel)
    si = scene.ray_intersect(ray)
    hits = Hits.at_interaction(material, si)
    lights = []
    for emitter in checked_emitters(scene):
        sample, power = emitter.sample_direction(si, chosen, si.is_valid())
        power = dr.select(si.is_valid() & (sample.pdf > 0), mi.Color3f(power), 0)
        lights.append((hits.local(si.to_local(sample.d)), power))
    return si, hits.uv, hits.w_view, lights
