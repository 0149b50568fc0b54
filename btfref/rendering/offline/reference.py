"""The reference renderer: Mitsuba with any integrator, and direct light on a regular sub-pixel grid."""

from __future__ import annotations

import time

import numpy as np

from btfref.errors import BtfrefError, InputError
from btfref.rendering.result import RenderResult
from btfref.sampling.variant import no_collection
from btfref.scene.camera import film_rays, grid_offsets, tell_camera
from btfref.scene.demand import MARGIN, kept_maps, number_kept
from btfref.scene.lights import distant_or_delta, is_delta
from btfref.scene.loading import loaded

#: Independent renders whose spread gives the variance of the mean: 15 degrees of freedom.
BATCHES = 16


def render(
    scene,
    *,
    parameters=None,
    variant="llvm_ad_rgb",
    spp=None,
    seed=0,
    grid=None,
    shadows=True,
    size=None,
    with_variance=False,
    keep="all",
    debug=False,
):
    """Render a scene with Mitsuba.

    Parameters
    ----------
    scene : path-like or dict
        Mitsuba scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    variant : str
        Mitsuba variant.
    spp : int, optional
        Samples per pixel in place of the scene's.
    seed : int
        The same seed gives the same image on the same machine.
    grid : int, optional
        Direct light only, at n × n regular sub-pixel positions (i + ½)/n, in place of integrator and sampler. Where all
        lights are points or directional, the material is evaluated towards each of them: nothing is random, and spp
        and seed say nothing. Under an environment directions of the light are random, and there are a variance and
        four independent ``pictures``. Needs a JIT variant.
    shadows : bool
        False leaves cast shadows out: direct light of delta lights and an environment, whatever the scene's integrator.
    size : (int, int), optional
        Width and height in place of the scene's.
    with_variance : bool
        Estimate the variance of the mean from independent renders of ``spp / 16`` samples each; with ``grid`` take
        random lights even where none needs it.
    keep : {"all", "needed"}
        "needed" loads the maps of those views, levels of detail and entries of codebooks alone that the cameras' first
        hits need, and with ``grid`` those of the lights as well: the same picture bit by bit. ``meta["kept"]`` says how
        many, by file.
    debug : bool
        A channel that is no number is an error. ``meta["not_finite"]`` counts them in any case: lookups outside of what
        a file or ``keep`` holds give none.

    Returns
    -------
    RenderResult

    Raises
    ------
    InputError
        For scenes that Mitsuba cannot load, and lights that ``grid`` cannot handle.
    BtfrefError
        When a pixel needed maps that were not loaded (light that was reflected twice can), or with ``debug`` is no
        number for another reason.
    MissingDependencyError
        Without a usable LLVM for an llvm variant.
    """
    for name, value in (("spp", spp), ("grid", grid)):
        if value is not None and value < 1:
            raise InputError("at least one sample is needed", field=name, got=value, expected="≥ 1")
    # Without a grid rays are random: views are found with a wide margin, and light may come from anywhere.
    margin = MARGIN if grid else None
    kept = kept_maps(
        keep, scene, parameters, lights=grid is not None, grid=grid or 4, size=size, margin=margin
    )
    with loaded(scene, parameters, variant=variant, size=size, kept=kept) as made:
        found = traced(made, spp=spp, seed=seed, grid=grid, shadows=shadows, with_variance=with_variance)
    lost = found.meta["not_finite"]
    if lost and (debug or kept):
        cause = "needed maps that were not loaded; render with all maps" if kept else "are no numbers"
        raise BtfrefError(f"{lost} channels {cause}")
    if kept:
        found.meta["kept"] = number_kept(kept)
    return found


@no_collection()
def traced(made, *, spp=None, seed=0, grid=None, shadows=True, with_variance=False):
    """A picture of a scene that is `loaded`; further ones cost no loading.

    Parameters
    ----------
    made : mitsuba.Scene
    spp, seed, grid, shadows, with_variance
        As of `render`.

    Returns
    -------
    RenderResult
    """
    import mitsuba as mi

    spp = spp or _sample_count(made)
    tell_camera(made, 1 / (grid or spp**0.5))
    start, pictures = time.perf_counter(), None
    if grid is None:
        image, variance, settings = _monte_carlo(made, spp, seed, with_variance, shadows)
    elif _all_delta(made) and not with_variance:
        image, variance = _noise_free(made, grid, shadows), None
        settings = {"grid": grid, "shadows": shadows, "integrator": "noise-free direct"}
    else:
        from btfref.rendering.offline.direct_light import regular

        pictures, variance, spp = regular(made, grid, spp, seed, shadows)
        image = pictures.mean(0)
        settings = {"grid": grid, "spp": spp, "seed": seed, "shadows": shadows, "integrator": "direct"}
    facts = {
        "renderer": "mitsuba",
        "variant": mi.variant(),
        "rfilter": "box",
        "component_format": "float32",
        **settings,
        "not_finite": int(np.count_nonzero(~np.isfinite(image))),
        "seconds": time.perf_counter() - start,
        **_versions(),
    }
    return RenderResult(image, variance, facts, pictures)


def _monte_carlo(scene, spp, seed, with_variance, shadows):
    import mitsuba as mi

    from btfref.rendering.offline.direct_light import make_integrator

    integrator = scene.integrator() if shadows else make_integrator(shadows=False)
    if integrator is None:
        raise InputError("the scene has no integrator", field="integrator", expected="such as path")
    settings = {
        "seed": seed,
        "integrator": integrator.class_name() if hasattr(integrator, "class_name") else "",
        "shadows": shadows,
    }

    def once(count, number):
        return np.array(mi.render(scene, integrator=integrator, spp=count, seed=number), np.float32)[..., :3]

    if not with_variance:
        return once(spp, seed), None, {**settings, "spp": spp}
    if spp < 2:
        raise InputError("a variance needs two samples per pixel", field="spp", got=spp, expected="≥ 2")
    batches = min(BATCHES, spp)
    count = -(-spp // batches)
    seeds = np.random.SeedSequence(seed).generate_state(batches)
    mean, square = 0.0, 0.0
    for done, number in enumerate(seeds):
        # Welford: the batches differ by little, sums of squares would lose it.
        image = once(count, int(number)).astype(float)
        change = image - mean
        mean = mean + change / (done + 1)
        square = square + change * (image - mean)
    variance = (square / (batches - 1) / batches).astype(np.float32)
    return mean.astype(np.float32), variance, {**settings, "spp": count * batches, "batches": batches}


def _sample_count(scene):
    return int(scene.sensors()[0].sampler().sample_count())


def _all_delta(scene):
    """Whether a regular grid needs no random number.

    Raises
    ------
    InputError
        For lights or a variant that a regular grid does not have.
    """
    import drjit as dr
    import mitsuba as mi

    if not dr.is_jit_v(mi.Float):
        raise InputError("a regular grid needs a JIT variant", field="variant", got=mi.variant())
    return all(is_delta(emitter) for emitter in distant_or_delta(scene))


def _noise_free(scene, n, shadows):
    """Mean over the grid of Σ over lights of incident power × ``bsdf.eval``; float32 (H, W, 3)."""
    sensor = scene.sensors()[0]
    width, height = (int(k) for k in sensor.film().crop_size())
    total = np.zeros((3, width * height))
    for offset in grid_offsets(n):
        ray, weight = film_rays(sensor, offset)
        total += np.array(weight * direct(scene, ray, shadows), float)
    return (total.T / n**2).reshape(height, width, 3).astype(np.float32)


def direct(scene, ray, shadows):
    """Radiance along camera rays: Σ over delta lights of incident power × ``bsdf.eval``."""
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray)
    bsdf = si.bsdf(ray)
    context = mi.BSDFContext()
    emitters = scene.emitters_dr()

    def body(i, sum_):
        emitter = dr.gather(mi.EmitterPtr, emitters, i, si.is_valid())
        sample, power = emitter.sample_direction(si, mi.Point2f(0.5), si.is_valid())
        active = si.is_valid() & (sample.pdf > 0)
        local = si.to_local(sample.d)
        # What only reflects is black under a light behind it: no shadow ray and no lookup.
        active &= (local.z * si.wi.z > 0) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
        if shadows:
            active &= ~scene.ray_test(si.spawn_ray_to(sample.p), active)
        value = bsdf.eval(context, si, local, active)
        return i + 1, sum_ + dr.select(active, power * value, 0)

    count = len(scene.emitters())
    start = dr.zeros(mi.UInt32, dr.width(ray)), dr.zeros(mi.Spectrum, dr.width(ray))
    return dr.while_loop(start, lambda i, _: i < count, body, labels=("light", "radiance"))[1]


def _versions():
    from btfref.provenance import versions

    return {"versions": versions()}
