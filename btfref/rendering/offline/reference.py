"""The reference renderer: Mitsuba with any integrator, and direct light on a regular sub-pixel grid."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from btfref.errors import GRID, SAMPLES, BtfrefError, InputError, refuse_above
from btfref.rendering import RenderResult
from btfref.rendering.frames import refuse_unknown
from btfref.rendering.offline.direct_light import make_integrator, on_grid
from btfref.sampling.variant import no_collection
from btfref.scene.camera import tell_camera
from btfref.scene.demand import MARGIN, kept_maps, number_kept
from btfref.scene.emitters.lights import checked_emitters, refuse_directed
from btfref.scene.loading import loaded
from btfref.scene.mirrored import seen_mirrored
from btfref.scene.shadows.occluders import casts_shadows
from btfref.types import Facts, JitArray, SceneLike

#: Independent renders whose spread gives the variance of the mean: 15 degrees of freedom.
BATCHES = 16

#: Samples of a picture that are traced together: some 100 bytes each.
LANES = 1 << 27


def render(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    variant: str = "llvm_ad_rgb",
    spp: int | None = None,
    seed: int = 0,
    grid: int | None = None,
    shadows: bool | None = None,
    size: tuple[int, int] | None = None,
    with_variance: bool = False,
    keep: str = "all",
    debug: bool = False,
    interpolation: str | None = None,
) -> RenderResult:
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
    shadows : bool, optional
        False leaves cast shadows out: direct light of delta lights and an environment, whatever the scene's integrator.
        By default they are there. ``meta["shadows"]`` then says whether any shape can be in the way
        (:func:`btfref.scene.shadows.occluders.casts_shadows`): on a grid nothing is traced towards the lights where
        none can.
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
    interpolation : {"blended", "drawn"}, optional
        Of all BTFs between measured views, in place of the scene's: all neighbours of a lookup, or one of them, drawn
        anew in each, with its table of light directions. "drawn" is refused with ``grid``.

    Returns
    -------
    RenderResult
        ``meta["mirrored"]``: names of the shapes whose texture is seen mirrored.

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
    for name, value, limit in (("spp", spp, SAMPLES), ("grid", grid, GRID)):
        if value is not None and value < 1:
            raise InputError("at least one sample is needed", field=name, got=value, expected="≥ 1")
        refuse_above(limit, value or 0, name)
    # Without a grid rays are random: views are found with a wide margin, and light may come from anywhere.
    margin = MARGIN if grid else None
    kept = kept_maps(
        keep, scene, parameters, lights=grid is not None, grid=grid or 4, size=size, margin=margin
    )
    # On a grid, materials under delta lights alone are only evaluated, unless random lights are asked for.
    sampled = True if grid is None or with_variance else None
    refuse_unknown(interpolation)
    settings: Facts = {
        "kept": kept,
        "sampled": sampled,
        "interpolation": interpolation,
        "draws": grid is None,
    }
    with loaded(scene, parameters, variant=variant, size=size, **settings) as made:
        if not made.emitters():
            file = None if isinstance(scene, dict) else scene
            raise InputError("the scene has no light", file=file, field="emitter")
        there = casts_shadows(made) if shadows is None else shadows
        # Without a grid the scene's own integrator is kept, which no shape in the way changes.
        traces = there if grid is not None else shadows is not False
        found = traced(made, spp=spp, seed=seed, grid=grid, shadows=traces, with_variance=with_variance)
        found.meta["shadows"] = there
        if interpolation is not None:
            found.meta["interpolation"] = interpolation
        if not variant.startswith("scalar"):
            found.meta["mirrored"] = seen_mirrored(made)
    lost = found.meta["not_finite"]
    if lost and (debug or kept):
        cause = "needed maps that were not loaded; render with all maps" if kept else "are no numbers"
        raise BtfrefError(f"{lost} channels {cause}")
    if kept:
        found.meta["kept"] = number_kept(kept)
    return found


@no_collection()
def traced(
    made: JitArray,
    *,
    spp: int | None = None,
    seed: int = 0,
    grid: int | None = None,
    shadows: bool = True,
    with_variance: bool = False,
) -> RenderResult:
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

    from btfref.provenance import versions

    spp = spp or int(made.sensors()[0].sampler().sample_count())
    tell_camera(made, 1 / (grid or spp**0.5))
    start = time.perf_counter()
    if grid is None:
        found = _monte_carlo(made, spp, seed, with_variance, shadows)
    else:
        found = on_grid(made, grid, spp, seed, shadows, random=with_variance)
    facts = {
        "renderer": "mitsuba",
        "variant": mi.variant(),
        "rfilter": "box",
        "component_format": "float32",
        **found.meta,
        "not_finite": int(np.count_nonzero(~np.isfinite(found.image))),
        "seconds": time.perf_counter() - start,
        "versions": versions(),
    }
    return replace(found, meta=facts)


def _monte_carlo(scene: JitArray, spp: int, seed: int, with_variance: bool, shadows: bool) -> RenderResult:
    import mitsuba as mi

    integrator = scene.integrator() if shadows else make_integrator(shadows=False)
    if integrator is None:
        raise InputError("the scene has no integrator", field="integrator", expected="such as path")
    if shadows and "Particle" not in integrator.class_name():
        refuse_directed(scene)
    elif not shadows:
        checked_emitters(scene)
    settings: Facts = {
        "seed": seed,
        "integrator": integrator.class_name() if hasattr(integrator, "class_name") else "",
        "shadows": shadows,
    }

    width, height = (int(n) for n in scene.sensors()[0].film().size())
    together = LANES // (width * height) or 1

    def once(count: int, number: int) -> np.ndarray:
        if count * width * height <= LANES:
            return made_once(count, number)
        # More than memory holds at a time: the mean of several pictures.
        parts = [min(together, count - first) for first in range(0, count, together)]
        seeds = np.random.SeedSequence([number, len(parts)]).generate_state(len(parts))
        total = np.zeros((height, width, 3))
        for part, word in zip(parts, seeds, strict=True):
            total += part * made_once(part, int(word)).astype(float)
        return (total / count).astype(np.float32)

    def made_once(count: int, number: int) -> np.ndarray:
        return np.array(mi.render(scene, integrator=integrator, spp=count, seed=number), np.float32)[..., :3]

    if not with_variance:
        return RenderResult(once(spp, seed), None, {**settings, "spp": spp})
    if spp < 2:
        raise InputError("a variance needs two samples per pixel", field="spp", got=spp, expected="≥ 2")
    batches = min(BATCHES, spp)
    count = -(-spp // batches)
    seeds = np.random.SeedSequence(seed).generate_state(batches)
    mean = square = np.zeros((1, 1, 3))
    for done, number in enumerate(seeds):
        # Welford: the batches differ by little, sums of squares would lose it.
        image = once(count, int(number)).astype(float)
        change = image - mean
        mean = mean + change / (done + 1)
        square = square + change * (image - mean)
    variance = (square / (batches - 1) / batches).astype(np.float32)
    settings |= {"spp": count * batches, "batches": batches}
    return RenderResult(mean.astype(np.float32), variance, settings)
