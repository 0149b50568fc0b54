"""Synthesis of a BTF from modelled mesostructure: every view, all lights, resumable."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.sampling.job import Job
from btfref.sampling.sampled_btf import SampledBTF
from btfref.sampling.settings import SynthesisSettings
from btfref.sampling.store.layout import CONVENTIONS, check_finite
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from btfref.mesostructure import Mesostructure
    from btfref.sampling.scheduling import Scheduler
    from btfref.sampling.store.selection import Selection
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts, PathLike, Progress

__all__ = ["SynthesisSettings", "synthesize", "synthesize_store"]


def synthesize(
    mesostructure: PathLike | Mesostructure = "checker",
    settings: SynthesisSettings | None = None,
    *,
    out: PathLike | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    memory: int | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
    **keywords: Any,
) -> SampledBTF:
    """Trace a mesostructure into a sampled BTF.

    Parameters
    ----------
    mesostructure : str, path-like or Mesostructure
        See ``btfref.mesostructure.names()``.
    settings : SynthesisSettings, optional
        By default those of `SynthesisSettings`, whose documentation says what they are.
    out : path-like, optional
        Store to write, ``NAME.btf.zarr``. An interrupted run is continued, a finished one of the same
        settings is returned as it is. None keeps the result in memory only.
    overwrite : bool
        Replace a store of other settings.
    progress : callable, optional
        Called as ``progress(done, total, label)`` after each view.
    memory, scheduler, workers
        Budget in bytes and who does the work, see `btfref.sampling.scheduling.run`; without influence on any
        byte. A scheduler wants `out`.
    **keywords
        Single settings, such as ``texels=32``; all others are parameters of the mesostructure.

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
    job = make_job(mesostructure, settings, keywords)
    means: dict[str, Any] = {"memory": memory, "scheduler": scheduler, "workers": workers}
    if out is not None:
        return SampledBTF.load(job.to_store(out, overwrite=overwrite, progress=progress, **means).path)
    if scheduler is not None:
        raise InputError("a scheduler needs a store to write", field="out", expected="a path")
    if job.settings.target_error is not None:
        with tempfile.TemporaryDirectory() as folder:
            store = job.to_store(Path(folder) / "draft.btf.zarr", progress=progress, **means)
            return dataclasses.replace(SampledBTF.load(store.path), path=None)
    shape = (len(job.views), len(job.lights), *job.texels, 3)
    values = np.zeros(shape, job.settings.dtype)
    spreads = np.zeros(shape, np.float32) if job.settings.variance else None
    with mitsuba_variant(job.settings.variant):
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
    out: PathLike,
    mesostructure: PathLike | Mesostructure = "checker",
    settings: SynthesisSettings | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    only: Selection | None = None,
    memory: int | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
    report: Callable[[int], object] | None = None,
    **keywords: Any,
) -> BTFStore:
    """As `synthesize` with ``out``, without reading the result into memory.

    Parameters
    ----------
    out : path-like
    mesostructure, settings, overwrite, progress, memory, scheduler, workers, **keywords
        As for `synthesize`.
    only : Selection, optional
        What to fill now; the rest can be filled later, by the same call with another selection.
    report : callable, optional
        Called at the end as ``report(peak)``: largest memory (bytes) of any process that worked.

    Returns
    -------
    BTFStore
        Complete, but for what `only` left out.
    """
    return make_job(mesostructure, settings, keywords).to_store(
        out,
        overwrite=overwrite,
        progress=progress,
        only=only,
        memory=memory,
        scheduler=scheduler,
        workers=workers,
        report=report,
    )


def make_job(
    mesostructure: PathLike | Mesostructure, settings: SynthesisSettings | None, keywords: Facts
) -> Job:
    """The job of some settings, and of keywords that are settings or parameters of the mesostructure."""
    settings, parameters = (settings or SynthesisSettings()).changed(keywords)
    return Job(mesostructure, parameters, settings)
