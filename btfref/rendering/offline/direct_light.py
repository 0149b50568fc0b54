"""Direct light, with or without cast shadows: by Monte Carlo, and on a regular grid, noise-free where lights allow."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.rendering import RenderResult
from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.emitters.area_lights import AreaLights, area_lights
from btfref.scene.emitters.lights import checked_emitters, is_area, is_delta
from btfref.types import Facts, JitArray

#: Camera rays times samples that are traced at a time.
LANES = 1 << 22

#: Radius of a lens that is a pinhole: Mitsuba takes the smallest float for 0.
POINT = 1e-6

#: Independent rounds a sub-pixel position: their spread is the variance.
ROUNDS = 4

#: Increments of additive recurrences in two and three dimensions, powers of the inverse of the root of
#: x^(d + 1) = x + 1 (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018), in units of 2^-32.
STEPS = tuple(
    round(2**32 * root**-k) for root, d in ((1.324717957, 2), (1.220744085, 3)) for k in range(1, d + 1)
)


def on_grid(
    scene: JitArray, grid: int, spp: int, seed: int, shadows: bool, *, random: bool = False
) -> RenderResult:
    """Direct light at the regular sub-pixel positions of a grid.

    Parameters
    ----------
    scene : mitsuba.Scene
    grid : int
        n of n × n.
    spp : int
        Samples a pixel where directions of the light are random.
    seed : int
    shadows : bool
    random : bool
        Take random lights even where all are delta lights, for a variance.

    Returns
    -------
    RenderResult
        Without variance and independent pictures where nothing is random.

    Raises
    ------
    InputError
        For a light that no surface meets, a lens with depth of field, or a variant that is none of a JIT.
    """
    import drjit as dr
    import mitsuba as mi

    if not dr.is_jit_v(mi.Float):
        raise InputError("a regular grid needs a JIT variant", field="variant", got=mi.variant())
    _refuse_lens(scene)
    settings: Facts = {"grid": grid, "shadows": shadows}
    if all(is_delta(emitter) or is_area(emitter) for emitter in checked_emitters(scene)) and not random:
        areas = area_lights(scene, mi)
        settings |= {"integrator": "noise-free direct", **areas.facts}
        return RenderResult(noise_free(scene, grid, shadows, areas), None, settings)
    pictures, variance, spp = regular(scene, grid, spp, seed, shadows)
    settings |= {"spp": spp, "seed": seed, "integrator": "direct"}
    return RenderResult(pictures.mean(0), variance, settings, pictures)


def _refuse_lens(scene: JitArray) -> None:
    """Refuse a camera with depth of field: its rays would all start at the middle of the lens."""
    import mitsuba as mi

    values = mi.traverse(scene.sensors()[0])
    if "aperture_radius" in values and (radius := float(np.max(values["aperture_radius"]))) > POINT:
        raise InputError(
            "a regular grid has no depth of field", field="aperture_radius", got=f"{radius:g}", expected=0
        )


def make_integrator(shadows: bool) -> JitArray:
    """An integrator for the current variant: direct light of delta lights and of an environment.

    Light is sampled by the emitters and by the material, combined by the power heuristic (Veach, Guibas 1995).

    Parameters
    ----------
    shadows : bool
        Whether shapes hide the light.

    Returns
    -------
    mitsuba.SamplingIntegrator
    """
    import mitsuba as mi

    class DirectLight(mi.SamplingIntegrator):
        def __init__(self, props: JitArray) -> None:
            mi.SamplingIntegrator.__init__(self, props)

        def sample(
            self,
            scene: JitArray,
            sampler: JitArray,
            ray: JitArray,
            medium: JitArray = None,
            active: JitArray = True,
        ) -> tuple[JitArray, JitArray, list[JitArray]]:
            si = scene.ray_intersect(mi.Ray3f(ray), active)
            active = mi.Bool(active) & si.is_valid()
            numbers = sampler.next_2d(active), sampler.next_1d(active), sampler.next_2d(active)
            return (
                _direct(scene, si, si.bsdf(mi.RayDifferential3f(ray)), *numbers, shadows, active),
                active,
                [],
            )

        def to_string(self) -> str:
            return f"DirectLight[shadows={shadows}]"

    return DirectLight(mi.Properties())


def _direct(
    scene: JitArray,
    si: JitArray,
    bsdf: JitArray,
    of_light: JitArray,
    lobe: JitArray,
    of_bsdf: JitArray,
    shadows: bool,
    active: JitArray,
) -> JitArray:
    """Radiance at surface interactions from uniform numbers: two for the emitters, one and two for the material."""
    import drjit as dr
    import mitsuba as mi

    def heuristic(a: JitArray, b: JitArray) -> JitArray:
        a, b = a * a, b * b
        return dr.select(a > 0, a / (a + b), 0)

    context = mi.BSDFContext()
    light, weight = scene.sample_emitter_direction(si, of_light, shadows, active)
    lit = active & (light.pdf > 0)
    value, pdf = bsdf.eval_pdf(context, si, si.to_local(light.d), lit)
    environment = scene.environment()
    # The material proposes directions for the environment alone.
    alone = (
        light.delta if environment is None else light.delta | (light.emitter != mi.EmitterPtr(environment))
    )
    share = dr.select(alone, 1, heuristic(light.pdf, pdf))
    result = emission(scene, si, active) + dr.select(lit, weight * value * share, 0)
    if environment is not None:
        sampled, weight = bsdf.sample(context, si, lobe, of_bsdf, active)
        going = active & (sampled.pdf > 0)
        light = dr.zeros(mi.DirectionSample3f)
        light.d, light.emitter = si.to_world(sampled.wo), mi.EmitterPtr(environment)
        if shadows:
            going &= ~scene.ray_test(si.spawn_ray(light.d), going)
        sky = dr.zeros(mi.SurfaceInteraction3f)
        sky.wi = -light.d
        pdf = scene.pdf_emitter_direction(si, light, going)
        radiance = environment.eval(sky, going)
        result += dr.select(going, weight * radiance * heuristic(sampled.pdf, pdf), 0)
    return result


def regular(
    scene: JitArray, grid: int, spp: int, seed: int, shadows: bool
) -> tuple[np.ndarray, np.ndarray, int]:
    """Direct light at n × n regular sub-pixel positions: random are the light's directions alone.

    Against a renderer that has the same positions no difference of texture sampling is left. The samples of a round
    are a lattice that is shifted at random, for each pixel anew (Cranley, Patterson 1976), which takes a fifth to a
    twentieth of their number under environments; rounds are independent.

    Parameters
    ----------
    scene : mitsuba.Scene
    grid : int
        n.
    spp : int
        Samples a pixel, at least four a position; rounded up to the same number for all positions.
    seed : int
    shadows : bool

    Returns
    -------
    batches : ndarray of float32, shape (4, H, W, 3)
        Independent pictures; their mean is the result.
    variance : ndarray of float32, shape (H, W, 3)
        That of the mean, from the spread at each position.
    spp : int
        Taken.
    """
    import drjit as dr
    import mitsuba as mi

    sensor = scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels = width * height
    each = -(-spp // grid**2)
    step = max(1, min(-(-each // ROUNDS), LANES // pixels))
    rounds = ROUNDS * -(-each // (ROUNDS * step))
    # Data, not code: one kernel for all numbers of samples.
    n = dr.opaque(mi.UInt32, step)
    rng = np.random.default_rng(seed)
    batches, variance = np.zeros((ROUNDS, 3, pixels)), np.zeros((3, pixels))
    for offset in grid_offsets(grid):
        ray, _ = film_rays(sensor, offset)
        si = scene.ray_intersect(ray)
        hit = dr.compress(si.is_valid())
        if not dr.width(hit):
            continue
        si, at = dr.gather(mi.SurfaceInteraction3f, si, hit), np.array(hit)
        dr.eval(si)
        values = np.zeros((rounds, 3, len(at)))
        for done in range(rounds):
            lane = dr.arange(mi.UInt32, len(at) * step)
            index = lane // n
            shifts = rng.integers(2**32, size=(len(STEPS), len(at)), dtype=np.uint32)
            numbers = [
                mi.Float(
                    (
                        dr.gather(mi.UInt32, to_device(mi.UInt32, shift), index)
                        + (lane - index * n) * increment
                    )
                    >> 8
                )
                * 2**-24
                for shift, increment in zip(shifts, STEPS, strict=True)
            ]
            place = dr.gather(mi.SurfaceInteraction3f, si, index)
            value = _direct(
                scene,
                place,
                place.bsdf(),
                mi.Point2f(numbers[:2]),
                numbers[2],
                mi.Point2f(numbers[3:]),
                shadows,
                mi.Bool(True),
            )
            sums = [dr.block_sum(v, step) for v in value]
            dr.eval(sums)
            values[done] = np.array([np.array(s) for s in sums], float) / step
        batches[..., at] += values.reshape(-1, ROUNDS, 3, len(at)).mean(0) / grid**2
        variance[:, at] += values.var(0, ddof=1) / rounds / grid**4
    pictures = batches.reshape(ROUNDS, 3, height, width).transpose(0, 2, 3, 1).astype(np.float32)
    return pictures, variance.T.reshape(height, width, 3).astype(np.float32), rounds * step * grid**2


def emission(scene: JitArray, si: JitArray, active: JitArray) -> JitArray:
    """Radiance of the area lights that are seen themselves."""
    import drjit as dr
    import mitsuba as mi

    if not any(is_area(emitter) for emitter in scene.emitters()):
        return dr.zeros(mi.Spectrum, dr.width(si))
    light = si.emitter(scene, active)
    return dr.select(active, light.eval(si, active & (light != mi.EmitterPtr(None))), 0)


def noise_free(scene: JitArray, n: int, shadows: bool, areas: AreaLights) -> np.ndarray:
    """Mean over the n × n grid of Σ over lights of incident power × ``bsdf.eval``; float32 (H, W, 3).

    Lights are the scene's delta lights and the points that stand for its area lights.
    """
    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    total = np.zeros((3, width * height))
    for offset in grid_offsets(n):
        ray, weight = film_rays(sensor, offset)
        total += np.array(weight * _exact(scene, ray, shadows, areas), float)
    return (total.T / n**2).reshape(height, width, 3).astype(np.float32)


def _exact(scene: JitArray, ray: JitArray, shadows: bool, areas: AreaLights) -> JitArray:
    """Radiance along camera rays: Σ over lights of incident power × ``bsdf.eval``, and of lights that are seen."""
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray)
    bsdf = si.bsdf(ray)
    context, valid = mi.BSDFContext(), si.is_valid()

    def reflected(towards: JitArray, place: JitArray, power: JitArray, active: JitArray) -> JitArray:
        local = si.to_local(towards)
        # What only reflects is black under a light behind it: no shadow ray and no lookup.
        active &= (local.z * si.wi.z > 0) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
        if shadows:
            active &= ~scene.ray_test(si.spawn_ray_to(place), active)
        return dr.select(active, power * bsdf.eval(context, si, local, active), 0)

    emitters = scene.emitters_dr()
    deltas = [k for k, light in enumerate(scene.emitters()) if not is_area(light)]
    chosen = to_device(mi.UInt32, deltas) if deltas else None

    def of_delta(i: JitArray, sum_: JitArray) -> tuple[JitArray, JitArray]:
        emitter = dr.gather(mi.EmitterPtr, emitters, dr.gather(mi.UInt32, chosen, i, valid), valid)
        sample, power = emitter.sample_direction(si, mi.Point2f(0.5), valid)
        return i + 1, sum_ + reflected(sample.d, sample.p, power, valid & (sample.pdf > 0))

    tables = areas.on_device() if len(areas) else []

    def of_point(i: JitArray, sum_: JitArray) -> tuple[JitArray, JitArray]:
        place, normal, power = (dr.gather(type(table), table, i, valid) for table in tables)
        offset = place - si.p
        square = dr.squared_norm(offset)
        towards = offset * dr.rsqrt(square)
        facing = -dr.dot(towards, normal)
        return i + 1, sum_ + reflected(towards, place, power * (facing / square), valid & (facing > 0))

    sum_ = dr.select(valid, emission(scene, si, valid), dr.zeros(mi.Spectrum, dr.width(ray)))
    for body, count in ((of_delta, len(deltas)), (of_point, len(areas))):
        if count:
            start, n = dr.zeros(mi.UInt32, dr.width(ray)), dr.opaque(mi.UInt32, count)
            labels = ("light", "radiance")
            sum_ = dr.while_loop((start, sum_), lambda i, _, n=n: i < n, body, labels=labels)[1]
    return sum_
