"""Direct light by Monte Carlo, with or without cast shadows: the reference of real-time pictures under environments."""

from __future__ import annotations

import numpy as np

from btfref.scene.camera import film_rays, grid_offsets

#: Camera rays times samples that are traced at a time.
LANES = 1 << 22

#: Independent rounds a sub-pixel position: their spread is the variance.
ROUNDS = 4

#: Increments of additive recurrences in two and three dimensions, powers of the inverse of the root of
#: x^(d + 1) = x + 1 (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018), in units of 2^-32.
STEPS = tuple(
    round(2**32 * root**-k) for root, d in ((1.324717957, 2), (1.220744085, 3)) for k in range(1, d + 1)
)


def make_integrator(shadows):
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
        def __init__(self, props):
            mi.SamplingIntegrator.__init__(self, props)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(mi.Ray3f(ray), active)
            active = mi.Bool(active) & si.is_valid()
            numbers = sampler.next_2d(active), sampler.next_1d(active), sampler.next_2d(active)
            return (
                _direct(scene, si, si.bsdf(mi.RayDifferential3f(ray)), *numbers, shadows, active),
                active,
                [],
            )

        def to_string(self):
            return f"DirectLight[shadows={shadows}]"

    return DirectLight(mi.Properties())


def _direct(scene, si, bsdf, of_light, lobe, of_bsdf, shadows, active):
    """Radiance at surface interactions from uniform numbers: two for the emitters, one and two for the material."""
    import drjit as dr
    import mitsuba as mi

    def heuristic(a, b):
        a, b = a * a, b * b
        return dr.select(a > 0, a / (a + b), 0)

    context = mi.BSDFContext()
    light, weight = scene.sample_emitter_direction(si, of_light, shadows, active)
    lit = active & (light.pdf > 0)
    value, pdf = bsdf.eval_pdf(context, si, si.to_local(light.d), lit)
    share = dr.select(light.delta, 1, heuristic(light.pdf, pdf))
    result = dr.select(lit, weight * value * share, 0)
    environment = scene.environment()
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


def regular(scene, grid, spp, seed, shadows):
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
                    (dr.gather(mi.UInt32, mi.UInt32(shift), index) + (lane - index * n) * increment) >> 8
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
    variance = variance.T.reshape(height, width, 3).astype(np.float32)
    return pictures, variance, rounds * step * grid**2
