"""One synthesis: its settings, checked before anything is written, and the store that it fills."""

from __future__ import annotations

import hashlib
import importlib
import json
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure import build
from btfref.mesostructure.materials import load_bsdf
from btfref.numerics.sphere.directions import directions
from btfref.provenance import versions
from btfref.sampling.fallback import reason_against_surface
from btfref.sampling.paths import adaptive
from btfref.sampling.paths.texels import STREAMS
from btfref.sampling.scheduling import run
from btfref.sampling.store.layout import TILE, remove_leftovers
from btfref.sampling.store.resume import resumable
from btfref.sampling.store.selection import Selection
from btfref.sampling.store.store import create_store
from btfref.sampling.variant import mitsuba_variant

#: name -> "module:class". An estimator is made from (mesostructure, light vectors, all view vectors, texels,
#: spp, seed, max_depth, wanted views, mask of texels); ``all_views(views)`` yields (view, mean, variance of
#: the mean), arrays (lights, rows, columns, 3) float32. Any order and any subset gives the same bytes.
ESTIMATORS = {
    "path": "btfref.sampling.paths.texels:TexelPaths",
    "surface": "btfref.sampling.surface.estimator:SurfaceEstimator",
}

#: What a result depends on; recorded with it.
VERSIONS = ("numpy", "mitsuba", "drjit")

_LARGEST = {"texels": 4096, "spp": 1 << 20}


class Job:
    """Checked settings of one synthesis; parameters as of `synthesize`."""

    def __init__(
        self,
        mesostructure,
        parameters,
        texels,
        views,
        lights,
        spp,
        seed,
        max_depth,
        dtype,
        estimator,
        variant,
        target_error,
        texel_error,
        variance=True,
    ):
        sides = texels if np.ndim(texels) else (texels, texels)
        if len(sides) != 2:
            raise InputError(
                "texels of the tile", field="texels", got=texels, expected="n or (rows, columns)"
            )
        self.texels = tuple(_whole("texels", side, 1, _LARGEST["texels"]) for side in sides)
        self.target_error = _share("target_error", target_error)
        self.texel_error = _share("texel_error", texel_error)
        if self.target_error is None and texel_error is not None:
            raise InputError("without a target error", field="texel_error", got=texel_error, expected="both")
        self.variance = bool(variance)
        if self.target_error is not None and not self.variance:
            raise InputError(
                "a target error wants variances", field="variance", got=variance, expected="True"
            )
        least = 2 if target_error is None else adaptive.LEAST
        most = _LARGEST["spp"] if target_error is None else STREAMS
        spp = (64 if target_error is None else 4096) if spp is None else spp
        self.spp = _whole("spp", spp, least, most)
        self.seed = _whole("seed", seed, 0, 2**63 - 1)
        self.max_depth = -1 if max_depth == -1 else _whole("max_depth", max_depth, 2, 10_000)
        if dtype not in ("float16", "float32"):
            raise InputError(
                "type of the values", field="dtype", got=repr(dtype), expected="float16 or float32"
            )
        if estimator not in ESTIMATORS:
            raise InputError(
                "unknown estimator",
                field="estimator",
                got=repr(estimator),
                expected=f"one of {', '.join(ESTIMATORS)}",
            )
        self.dtype, self.estimator, self.variant = dtype, estimator, variant
        # Every setting is tried before anything is written.
        with mitsuba_variant(variant):
            pass
        self.views, self.lights = directions(views), directions(lights)
        self.mesostructure = build(mesostructure, **parameters)
        with mitsuba_variant(variant):
            bsdfs = [load_bsdf(part) for part in self.mesostructure.parts]
            fallback = reason_against_surface(bsdfs) if estimator == "surface" else None
        if fallback is not None:
            estimator = self.estimator = "path"
        self.attributes = {
            "seed": self.seed,
            "estimator": estimator,
            "parameters": {
                "texels": list(self.texels),
                "spp": self.spp,
                "max_depth": self.max_depth,
                "dtype": dtype,
                "variant": variant,
                "tile": TILE,
            },
            "parent": {
                "kind": "mesostructure",
                "name": self.mesostructure.name,
                "parameters": self.mesostructure.parameters,
                "geometry": fingerprint(self.mesostructure),
            },
            "versions": versions(VERSIONS),
        }
        if not self.variance:
            self.attributes["parameters"]["variance"] = False
        if fallback is not None:
            self.attributes["fallback"] = f"path instead of surface: {fallback}"
        if self.target_error is not None:
            self.attributes["parameters"] |= {
                "target_error": self.target_error,
                "texel_error": self.texel_error,
                "pilot": adaptive.PILOT if estimator == "path" else adaptive.SURFACE_POINTS,
            }

    def make_estimator(self, wanted, *, lights=None, mask=None, spp=None, stream=None, buffer=None):
        """The estimator of some views; make and use it inside a `mitsuba_variant` block.

        Parameters
        ----------
        wanted : sequence of int
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
        module, _, name = ESTIMATORS[self.estimator].partition(":")
        make = getattr(importlib.import_module(module), name)
        seed = self.seed
        if stream is not None:
            seed = int(np.random.SeedSequence([seed, *stream]).generate_state(1, np.uint64)[0] >> 2)
        return make(
            self.mesostructure,
            self.lights.vectors,
            views=self.views.vectors,
            wanted=[int(view) for view in wanted],
            mask=mask,
            texels=self.texels,
            spp=self.spp if spp is None else spp,
            seed=seed,
            max_depth=self.max_depth,
            **({} if buffer is None else {"buffer": buffer}),
            # Paths make theirs in passing; they are not kept.
            **({"variance": self.variance, "chosen": lights} if self.estimator == "surface" else {}),
        )

    def unfinished(self, store, views, stage, only=None):
        """Those of some views that a stage has not made yet."""
        if stage == "pilot":
            pilots = store.maps("pilot")
            return [int(view) for view in views if not np.isfinite(pilots[view, 0, 0, 0])]
        only = only or Selection()
        wanted, (*_, tiles) = only.wanted(store), only.indices(store)
        covered = store.coverage[:, :, tiles[0], tiles[1]].all(-1)
        return [int(view) for view in views if (wanted[view] & ~covered[view]).any()]

    def to_store(self, out, *, overwrite=False, progress=None, only=None, report=None, **means):
        """Fill the store at ``out``, from where an earlier run of the same settings stopped."""
        out = Path(out)
        remove_leftovers(out)
        store = None
        if out.exists() or out.is_symlink():
            store = resumable(out, self.views, self.lights, self.attributes, overwrite)
        if store is None:
            store = create_store(
                out,
                views=self.views,
                lights=self.lights,
                texels=self.texels,
                dtype=self.dtype,
                variance=self.variance,
                attributes=self.attributes,
                adaptive=self.target_error is not None,
            )
        only = only or Selection()
        views, *_ = only.indices(store)
        peak, plan = 0, None
        if self.target_error is not None:
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
                lambda: (store.maps("pilot")[view] for view in every),
                target=self.target_error,
                texel_error=self.texel_error,
                most=self._most(),
                whole_views=self.estimator == "surface",
            )
        missing = self.unfinished(store, views, "synthesis", only)
        done = len(views) - len(missing)
        ahead = None
        if progress is not None:

            def ahead(now, total, label):
                progress(done + now, done + total, label)

        used = run(self, store, missing, stage="synthesis", only=only, plan=plan, progress=ahead, **means)
        remove_leftovers(out)
        if report is not None:
            report(max(peak, used))
        return store

    def _most(self):
        """Most samples of a texel, or passes of a view."""
        return (
            max(1, self.spp // adaptive.SURFACE_POINTS) if self.estimator == "surface" else self.spp // 2 * 2
        )


def _whole(name, value, low, high):
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise InputError(
            "setting of the synthesis", field=name, got=value, expected=f"a whole number in [{low}, {high}]"
        )
    return int(value)


def _share(name, value):
    """A relative error, or None."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 1e-5 <= value <= 10:
        raise InputError(
            "setting of the synthesis", field=name, got=value, expected="a number in [1e-5, 10], 0.02 for 2 %"
        )
    return float(value)


def fingerprint(mesostructure):
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
    return state.hexdigest()[:32]
