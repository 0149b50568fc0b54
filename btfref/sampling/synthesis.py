"""Synthesis of a BTF from modelled mesostructure: every view, all lights, resumable."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.sampling.job import ESTIMATORS, Job
from btfref.sampling.sampled_btf import SampledBTF
from btfref.sampling.store.layout import CONVENTIONS, check_finite
from btfref.sampling.variant import mitsuba_variant

__all__ = ["ESTIMATORS", "Job", "synthesize", "synthesize_store"]


def synthesize(
    mesostructure="checker",
    *,
    texels=64,
    views="ubo81",
    lights="ubo81",
    spp=None,
    seed=0,
    out=None,
    max_depth=8,
    dtype="float16",
    progress=None,
    estimator="path",
    overwrite=False,
    variant="llvm_ad_rgb",
    target_error=None,
    texel_error=None,
    variance=True,
    memory=None,
    scheduler=None,
    workers=None,
    **parameters,
):
    """Path trace a mesostructure into a sampled BTF.

    Parameters
    ----------
    mesostructure : str or Mesostructure
        See ``btfref.mesostructure.names()``.
    texels : int or (int, int)
        Texels along each side of the tile, or rows and columns.
    views, lights : str, DirectionSet or array_like (n, 3)
        See `btfref.numerics.sphere.directions.directions`.
    spp : int, optional
        Samples per texel and view, at least 2; each serves all lights. By default 64. With a target error:
        the most that a texel may get, by default 4096.
    seed : int
        Same seed, same bytes (on the same machine).
    out : path-like, optional
        Store to write, ``NAME.btf.zarr``. An interrupted run is continued, a finished one of the same
        settings is returned as it is. None keeps the result in memory only.
    max_depth : int
        As in Mitsuba: 2 is direct light only, −1 has no limit.
    dtype : {"float16", "float32"}
        Type of the stored values. Variance is float32.
    progress : callable, optional
        Called as ``progress(done, total, label)`` after each view.
    estimator : str
        "path", the reference, or "surface", which traces visibility once for all views and lights; see
        `btfref.sampling.surface.estimator`. `spp` then counts surface points per texel of the tile. Where a
        material transmits, masks or mirrors, "path" takes its place and the attribute ``fallback`` says so.
    overwrite : bool
        Replace a store of other settings.
    variant : str
        Mitsuba variant; it is part of the settings, since bytes differ between backends.
    target_error : float, optional
        Root mean square of all standard errors, relative to the mean of all values: samples are placed where
        they are needed for it, see `btfref.sampling.paths.adaptive`. Whether it was reached stands in the store.
    texel_error : float, optional
        Largest relative standard error of a texel of a view (over lights and channels), relative to its mean
        or to a tenth of the whole's. With a target error only; by default no limit.
    variance : bool
        Whether the variance of the mean is made and kept. Without it the surface estimator is faster by a quarter.
    memory, scheduler, workers
        Budget in bytes and who does the work, see `btfref.sampling.scheduling.run`; without influence on any
        byte. A scheduler wants `out`.
    **parameters
        Of the mesostructure.

    Returns
    -------
    SampledBTF

    Raises
    ------
    InputError
        A setting that cannot be used, or a store of other settings at `out`.

    Notes
    -----
    Values are radiance per unit irradiance perpendicular to the light (1/sr); each is the mean over the
    texel's square on the sampling plane z = 0, seen along the view: oblique views have sheared footprints.
    """
    settings = {
        "texels": texels,
        "views": views,
        "lights": lights,
        "spp": spp,
        "seed": seed,
        "max_depth": max_depth,
        "dtype": dtype,
        "estimator": estimator,
        "variant": variant,
        "target_error": target_error,
        "texel_error": texel_error,
        "variance": variance,
    }
    job = Job(mesostructure, parameters, **settings)
    means = {"memory": memory, "scheduler": scheduler, "workers": workers}
    if out is not None:
        return SampledBTF.load(job.to_store(out, overwrite=overwrite, progress=progress, **means).path)
    if scheduler is not None:
        raise InputError("a scheduler needs a store to write", field="out", expected="a path")
    if job.target_error is not None:
        with tempfile.TemporaryDirectory() as folder:
            store = job.to_store(Path(folder) / "draft.btf.zarr", progress=progress, **means)
            return dataclasses.replace(SampledBTF.load(store.path), path=None)
    shape = (len(job.views), len(job.lights), *job.texels, 3)
    values, spreads = np.zeros(shape, dtype), np.zeros(shape, np.float32) if job.variance else None
    with mitsuba_variant(job.variant):
        every = range(len(job.views))
        for count, (view, mean, spread) in enumerate(job.make_estimator(every).all_views(every), 1):
            with np.errstate(over="ignore"):
                values[view] = mean
            if spreads is not None:
                spreads[view] = spread
            check_finite(values[view : view + 1], None, "values")
            if progress is not None:
                progress(count, len(job.views), "synthesis")
    return SampledBTF(values, job.views, job.lights, spreads, {**CONVENTIONS, **job.attributes})


def synthesize_store(
    out,
    mesostructure="checker",
    *,
    overwrite=False,
    progress=None,
    only=None,
    memory=None,
    scheduler=None,
    workers=None,
    report=None,
    **settings,
):
    """As `synthesize` with ``out``, without reading the result into memory.

    Parameters
    ----------
    out : path-like
    mesostructure, overwrite, progress, memory, scheduler, workers, **settings
        As for `synthesize`.
    only : Selection, optional
        What to fill now; the rest can be filled later, by the same call with another part.
    report : callable, optional
        Called at the end as ``report(peak)``: largest memory (bytes) of any process that worked.

    Returns
    -------
    BTFStore
        Complete, but for what `only` left out.
    """
    defaults = {
        "texels": 64,
        "views": "ubo81",
        "lights": "ubo81",
        "spp": None,
        "seed": 0,
        "max_depth": 8,
        "dtype": "float16",
        "estimator": "path",
        "variant": "llvm_ad_rgb",
        "target_error": None,
        "texel_error": None,
        "variance": True,
    }
    chosen = {key: settings.pop(key, value) for key, value in defaults.items()}
    return Job(mesostructure, settings, **chosen).to_store(
        out,
        overwrite=overwrite,
        progress=progress,
        only=only,
        memory=memory,
        scheduler=scheduler,
        workers=workers,
        report=report,
    )
