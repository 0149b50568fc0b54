"""Direct light by Monte Carlo, with or without cast shadows: the reference of real-time pictures under environments."""

from __future__ import annotations

import numpy as np

from btfref.render.camera import film_rays, grid_offsets

#: Camera rays times samples that are traced at a time.
LANES = 1 << 22

#: Independent rounds a sub-pixel position at least: their spread is the variance.
ROUNDS = 4


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
    import drjit as dr
    import mitsuba as mi

    def heuristic(a, b):
        a, b = a * a, b * b
        return dr.select(a > 0, a / (a + b), 0)

    class DirectLight(mi.SamplingIntegrator):
        def __init__(self, props):
            mi.SamplingIntegrator.__init__(self, props)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(mi.Ray3f(ray), active)
            active = mi.Bool(active) & si.is_valid()
            bsdf, context = si.bsdf(mi.RayDifferential3f(ray)), mi.BSDFContext()
            light, weight = scene.sample_emitter_direction(si, sampler.next_2d(active), shadows, active)
            lit = active & (light.pdf > 0)
            value, pdf = bsdf.eval_pdf(context, si, si.to_local(light.d), lit)
            share = dr.select(light.delta, 1, heuristic(light.pdf, pdf))
            result = dr.select(lit, weight * value * share, 0)
            environment = scene.environment()
            if environment is not None:
                sampled, weight = bsdf.sample(
                    context, si, sampler.next_1d(active), sampler.next_2d(active), active
                )
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
            return result, active, []

        def to_string(self):
            return f"DirectLight[shadows={shadows}]"

    return DirectLight(mi.Properties())


def regular(scene, grid, spp, seed, shadows):
    """Direct light at n × n regular sub-pixel positions: random are the light's directions alone.

    Against a renderer that has the same positions no difference of texture sampling is left. The samples of a round
    are correlated multi-jittered (Kensler 2013, Pixar technical memo 13-01), which takes a fifth to a fifteenth of
    their number under environments; rounds are independent.

    Parameters
    ----------
    scene : mitsuba.Scene
    grid : int
        n.
    spp : int
        Samples a pixel, at least two a position; rounded up to the same number for all positions.
    seed : int
    shadows : bool

    Returns
    -------
    image, variance : ndarray of float32, shape (H, W, 3)
        The variance is that of the mean.
    spp : int
        Taken.
    """
    import drjit as dr
    import mitsuba as mi

    integrator, sensor = make_integrator(shadows), scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels = width * height
    each = max(2, -(-spp // grid**2))
    # A square grid of strata.
    step = int(max(1, min(each // min(each, ROUNDS), LANES // pixels)) ** 0.5) ** 2
    rounds = -(-each // step)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": step})
    sampler.set_samples_per_wavefront(step)
    seeds = iter(np.random.SeedSequence(seed).generate_state(rounds * grid**2))
    mean, variance = np.zeros((2, 3, pixels))
    for offset in grid_offsets(grid):
        average, squares = np.zeros((2, 3, pixels))
        ray, _ = film_rays(sensor, offset)
        index = dr.arange(mi.UInt32, pixels * step) // step
        rays = mi.Ray3f(dr.gather(mi.Point3f, ray.o, index), dr.gather(mi.Vector3f, ray.d, index))
        rays.maxt = dr.gather(mi.Float, ray.maxt, index)
        for done in range(rounds):
            sampler.seed(int(next(seeds)), pixels * step)
            value, _, _ = integrator.sample(scene, sampler, rays, None, mi.Bool(True))
            sums = [dr.block_sum(v, step) for v in value]
            dr.eval(sums)
            # Welford: rounds differ by little, sums of squares would lose it.
            found = np.array([np.array(s) for s in sums], float) / step
            change = found - average
            average += change / (done + 1)
            squares += change * (found - average)
        mean += average / grid**2
        variance += squares / (rounds - 1) / rounds / grid**4
    shape = height, width, 3
    images = (a.T.reshape(shape).astype(np.float32) for a in (mean, variance))
    return *images, rounds * step * grid**2
