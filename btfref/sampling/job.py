"""One synthesis: its settings, checked before anything is written, and the store that it fills."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import BtfrefError, InputError
from btfref.mesostructure import build
from btfref.mesostructure.materials import load_bsdf
from btfref.provenance import LLVM, versions
from btfref.registry.points import imported
from btfref.sampling.fallback import reason_against_surface
from btfref.sampling.paths import adaptive
from btfref.sampling.scheduling import run
from btfref.sampling.settings import AUTO, ESTIMATORS, SynthesisSettings
from btfref.sampling.store.layout import remove_leftovers, remove_store
from btfref.sampling.store.lock import writing
from btfref.sampling.store.resume import resumable
from btfref.sampling.store.selection import Selection
from btfref.sampling.store.store import create_store
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from btfref.mesostructure import Mesostructure
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts, PathLike, Progress

#: What a result depends on; recorded with it, and LLVM where it compiles the kernels.
VERSIONS = ("numpy", "mitsuba", "drjit")


class Job:
    """One synthesis, checked: nothing of it can fail for a setting once the store is there.

    Parameters
    ----------
    mesostructure : str, path-like or Mesostructure
    parameters : dict
        Of the mesostructure.
    settings : SynthesisSettings

    Attributes
    ----------
    settings : SynthesisSettings
        Those asked for, with the estimator that is used: "path" or "surface".
    mesostructure : Mesostructure
    views, lights : DirectionSet
    texels : (int, int)
        Rows and columns.
    attributes : dict
        Of the store.

    Raises
    ------
    InputError
        A variant or a mesostructure that cannot be used.
    """

    def __init__(
        self, mesostructure: PathLike | Mesostructure, parameters: Facts, settings: SynthesisSettings
    ) -> None:
        self.views, self.lights, self.texels = settings.view_set, settings.light_set, settings.sides
        with mitsuba_variant(settings.variant):
            pass
        self.mesostructure = build(mesostructure, **parameters)
        with mitsuba_variant(settings.variant):
            bsdfs = [load_bsdf(part) for part in self.mesostructure.parts]
            fallback = None
            if settings.estimator != "path":
                fallback = reason_against_surface(bsdfs, self.mesostructure.parts)
        if fallback is None and settings.estimator == AUTO and settings.texel_error is not None:
            fallback = "each texel has a limit of its own"
        if settings.estimator == AUTO or fallback is not None:
            used = "surface" if fallback is None else "path"
            settings = dataclasses.replace(settings, estimator=used)
        self.settings = settings
        self.attributes = {
            **settings.attributes(),
            "parent": {
                "kind": "mesostructure",
                "name": self.mesostructure.name,
                "parameters": self.mesostructure.parameters,
                "geometry": fingerprint(self.mesostructure),
            },
            "versions": versions((*VERSIONS, LLVM) if settings.variant.startswith("llvm") else VERSIONS),
        }
        if self.mesostructure.ignored:
            self.attributes["ignored"] = list(self.mesostructure.ignored)
        if fallback is not None:
            self.attributes["fallback"] = f"path instead of surface: {fallback}"

    def make_estimator(
        self,
        wanted: Iterable[int],
        *,
        lights: np.ndarray | None = None,
        mask: np.ndarray | None = None,
        spp: int | None = None,
        stream: tuple[int, ...] | None = None,
        buffer: int | None = None,
    ) -> Any:
        """The estimator of some views, of a class of `ESTIMATORS`; make and use it inside a `mitsuba_variant` block.

        Parameters
        ----------
        wanted : iterable of int
            Views.
        lights : ndarray of int, optional
            That the surface estimator makes; all when not given. That of paths is told from view to view.
        mask : ndarray (rows · columns,) bool, optional
            Texels that are wanted.
        spp : int, optional
            In place of the settings'.
        stream : tuple of int, optional
            Selects other random numbers.
        buffer : int, optional
            Bytes of the sample buffer, where the estimator has one.
        """
        settings = self.settings
        options: dict[str, Any] = {}
        make = imported(ESTIMATORS[settings.estimator])
        seed = settings.seed
        if stream is not None:
            seed = int(np.random.SeedSequence([seed, *stream]).generate_state(1, np.uint64)[0] >> 2)
        if buffer is not None:
            options["buffer"] = buffer
        if settings.estimator == "surface":
            # Paths make their variance in passing; it is not kept.
            options |= {"variance": settings.variance, "chosen": lights}
        return make(
            self.mesostructure,
            self.lights.vectors,
            views=self.views.vectors,
            wanted=[int(view) for view in wanted],
            mask=mask,
            texels=self.texels,
            spp=settings.samples if spp is None else spp,
            seed=seed,
            max_depth=settings.max_depth,
            **options,
        )

    def unfinished(
        self, store: BTFStore, views: Iterable[int], stage: str, only: Selection | None = None
    ) -> list[int]:
        """Those of some views that a stage has not made yet."""
        if stage == "pilot":
            return [int(view) for view in views if not np.isfinite(store.read_map("pilot", view)[0, 0, 0])]
        only = only or Selection()
        wanted, (*_, tiles) = only.wanted(store), only.indices(store)
        covered = np.all(store.coverage[:, :, tiles[0], tiles[1]], axis=-1)
        return [int(view) for view in views if (wanted[view] & ~covered[view]).any()]

    def to_store(
        self,
        out: PathLike,
        *,
        overwrite: bool = False,
        progress: Progress | None = None,
        only: Selection | None = None,
        report: Callable[[int], object] | None = None,
        **means: Any,
    ) -> BTFStore:
        """Fill the store at ``out``, from where an earlier run of the same settings stopped.

        Parameters
        ----------
        out, overwrite, progress, only, report
            As for `btfref.sampling.synthesis.synthesize_store`.
        **means
            ``memory``, ``scheduler`` and ``workers`` of `btfref.sampling.scheduling.run`.
        """
        with writing(out):
            return self._filled(Path(out), overwrite, progress, only, report, means)

    def _filled(
        self,
        out: Path,
        overwrite: bool,
        progress: Progress | None,
        only: Selection | None,
        report: Callable[[int], object] | None,
        means: Facts,
    ) -> BTFStore:
        """:meth:`to_store`, while no other process writes there."""
        settings = self.settings
        remove_leftovers(out)
        store = None
        if out.exists() or out.is_symlink():
            store = resumable(out, self.views, self.lights, self.attributes, overwrite)
        begun = store is None
        if store is None:
            store = create_store(
                out,
                views=self.views,
                lights=self.lights,
                texels=self.texels,
                dtype=settings.dtype,
                variance=settings.variance,
                attributes=self.attributes,
                adaptive=settings.target_error is not None,
            )
        try:
            peak = self._fill(store, progress, only or Selection(), means)
        except BtfrefError:
            # A start that was refused leaves nothing that looks like a beginning.
            if begun and not store.coverage.any() and not _has_pilot(store):
                remove_store(out)
            raise
        remove_leftovers(out)
        if report is not None:
            report(peak)
        return store

    def _fill(self, store: BTFStore, progress: Progress | None, only: Selection, means: Facts) -> int:
        """Make what is missing; the largest memory (bytes) of any process that worked."""
        settings = self.settings
        views, *_ = only.indices(store)
        peak, plan = 0, None
        if settings.target_error is not None:
            if not only.wanted(store)[views].all():
                # Samples are placed for the mean over all lights, which share them.
                raise InputError("with a target error all lights are made together", field="lights")
            every = range(len(self.views))
            peak = run(
                self,
                store,
                self.unfinished(store, every, "pilot"),
                stage="pilot",
                progress=progress,
                **means,
            )
            plan = adaptive.make_plan(
                lambda: (store.read_map("pilot", view) for view in every),
                target=settings.target_error,
                texel_error=settings.texel_error,
                most=self._most(),
                whole_views=settings.estimator == "surface",
            )
        missing = self.unfinished(store, views, "synthesis", only)
        done = len(views) - len(missing)

        def ahead(now: int, total: int, label: str) -> None:
            if progress is not None:
                progress(done + now, done + total, label)

        used = run(self, store, missing, stage="synthesis", only=only, plan=plan, progress=ahead, **means)
        return max(peak, used)

    def _most(self) -> int:
        """Most samples of a texel, or passes of a view."""
        most = self.settings.samples
        return (
            max(1, most // adaptive.SURFACE_POINTS) if self.settings.estimator == "surface" else most // 2 * 2
        )


def _has_pilot(store: BTFStore) -> bool:
    """Whether a view's pilot was made."""
    if store.maps("pilot") is None:
        return False
    return any(np.isfinite(store.read_map("pilot", view)[0, 0, 0]) for view in range(len(store.views)))


def fingerprint(mesostructure: Mesostructure) -> str:
    """What geometry, materials and textures come to: a user's files may change under their names.

    Parameters
    ----------
    mesostructure : Mesostructure

    Returns
    -------
    str
    """
    state = hashlib.sha256()
    for part in mesostructure.parts:
        state.update(json.dumps(part.bsdf, sort_keys=True).encode())
        for name, image in sorted(part.textures.items()):
            state.update(f"{name} {image.dtype} {image.shape}".encode())
            state.update(np.ascontiguousarray(image).tobytes())
        for array in (part.vertices, part.faces, part.normals, part.uv):
            if array is not None:
                state.update(str((array.dtype, array.shape)).encode())
                # float32 is what is traced; the last bits of float64 may differ between C libraries.
                state.update(
                    np.asarray(array, np.float32 if array.dtype.kind == "f" else np.uint32).tobytes()
                )
        for name, array in sorted(part.attributes.items()):
            state.update(f"{name} {array.shape}".encode())
            state.update(np.asarray(array, np.float32).tobytes())
    return state.hexdigest()[:32]
