"""Synthesis of a BTF from modelled mesostructure: every view, all lights, resumable."""

from __future__ import annotations

import hashlib
import importlib
import json
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure import build
from btfref.mesostructure.materials import load_bsdf
from btfref.numerics.directions import directions
from btfref.sampling.layout import CONVENTIONS, TILE, check_finite, remove_leftovers
from btfref.sampling.part import Part
from btfref.sampling.resume import resumable
from btfref.sampling.sampled_btf import SampledBTF
from btfref.sampling.store import create_store
from btfref.sampling.variant import mitsuba_variant
from btfref.versions import versions

#: name -> "module:class". An estimator is made from (mesostructure, light vectors, all view vectors, texels,
#: spp, seed, max_depth, wanted views, mask of texels); ``all_views(views)`` yields (view, mean, variance of
#: the mean), arrays (lights, rows, columns, 3) float32. Any order and any subset gives the same bytes.
ESTIMATORS = {
    "path": "btfref.sampling.path_estimator:PathEstimator",
    "surface": "btfref.sampling.surface_estimator:SurfaceEstimator",
}

#: What a result depends on; recorded with it.
VERSIONS = ("numpy", "mitsuba", "drjit")

_LARGEST = {"texels": 4096, "spp": 1 << 20}


def synthesize(
    mesostructure="checker",
    *,
    texels=64,
    views="ubo81",
    lights="ubo81",
    spp=64,
    seed=0,
    out=None,
    max_depth=8,
    dtype="float16",
    progress=None,
    estimator="path",
    overwrite=False,
    variant="llvm_ad_rgb",
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
        See `btfref.numerics.directions.directions`.
    spp : int
        Samples per texel and view, at least 2; each serves all lights.
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
        `btfref.sampling.surface_estimator`. `spp` then counts surface points per texel of the tile.
    overwrite : bool
        Replace a store of other settings.
    variant : str
        Mitsuba variant; it is part of the settings, since bytes differ between backends.
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
    job = _Job(
        mesostructure, parameters, texels, views, lights, spp, seed, max_depth, dtype, estimator, variant
    )
    if out is not None:
        return SampledBTF.load(job.to_store(out, overwrite=overwrite, progress=progress).path)
    shape = (len(job.views), len(job.lights), *job.texels, 3)
    values, variance = np.zeros(shape, dtype), np.zeros(shape, np.float32)
    for view, mean, spread in job.results(range(len(job.views)), progress):
        with np.errstate(over="ignore"):
            values[view] = mean
        variance[view] = spread
        check_finite(values[view : view + 1], None, "values")
    return SampledBTF(values, job.views, job.lights, variance, {**CONVENTIONS, **job.attributes})


def synthesize_store(out, mesostructure="checker", *, overwrite=False, progress=None, only=None, **settings):
    """As `synthesize` with ``out``, without reading the result into memory.

    Parameters
    ----------
    out : path-like
    mesostructure, overwrite, progress, **settings
        As for `synthesize`.
    only : Part, optional
        What to fill now; the rest can be filled later, by the same call with another part.

    Returns
    -------
    BTFStore
        Complete, but for what `only` left out.
    """
    defaults = {
        "texels": 64,
        "views": "ubo81",
        "lights": "ubo81",
        "spp": 64,
        "seed": 0,
        "max_depth": 8,
        "dtype": "float16",
        "estimator": "path",
        "variant": "llvm_ad_rgb",
    }
    chosen = {key: settings.pop(key, value) for key, value in defaults.items()}
    return _Job(mesostructure, settings, **chosen).to_store(
        out, overwrite=overwrite, progress=progress, only=only
    )


class _Job:
    """Checked settings of one synthesis."""

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
    ):
        sides = texels if np.ndim(texels) else (texels, texels)
        if len(sides) != 2:
            raise InputError(
                "texels of the tile", field="texels", got=texels, expected="n or (rows, columns)"
            )
        self.texels = tuple(_whole("texels", side, 1, _LARGEST["texels"]) for side in sides)
        self.spp = _whole("spp", spp, 2, _LARGEST["spp"])
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
            for part in self.mesostructure.parts:
                load_bsdf(part)
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
                "geometry": _digest(self.mesostructure),
            },
            "versions": versions(VERSIONS),
        }

    def results(self, wanted, progress=None, done=0, *, lights=None, mask=None):
        """Mean and variance of the wanted views, one after the other.

        `lights` and `mask` (of texels) restrict what is computed; the former also what comes back.
        """
        wanted = [int(view) for view in wanted]
        if not wanted:
            return
        module, _, name = ESTIMATORS[self.estimator].partition(":")
        make = getattr(importlib.import_module(module), name)
        with mitsuba_variant(self.variant):
            estimator = make(
                self.mesostructure,
                self.lights.vectors if lights is None else self.lights.vectors[lights],
                views=self.views.vectors,
                wanted=wanted,
                mask=mask,
                texels=self.texels,
                spp=self.spp,
                seed=self.seed,
                max_depth=self.max_depth,
            )
            for count, result in enumerate(estimator.all_views(wanted), 1):
                yield result
                if progress is not None:
                    progress(done + count, done + len(wanted), "synthesis")

    def to_store(self, out, *, overwrite=False, progress=None, only=None):
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
                attributes=self.attributes,
            )
        only = only or Part()
        views, lights, tiles = only.indices(store)
        covered = store.coverage[np.ix_(views, lights)][:, :, tiles[0], tiles[1]].all(axis=(1, 2))
        missing = views[~covered]
        done = len(views) - len(missing)
        whole = len(lights) == len(self.lights) and len(tiles[0]) == store.coverage[0, 0].size
        mask = None if whole else only.mask(store)
        chosen = None if len(lights) == len(self.lights) else lights
        for view, mean, spread in self.results(missing, progress, done, lights=chosen, mask=mask):
            if whole:
                store.write_view(view, mean, spread)
            else:
                store.write_part(view, lights, tiles, mean, spread)
        return store


def _whole(name, value, low, high):
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise InputError(
            "setting of the synthesis", field=name, got=value, expected=f"a whole number in [{low}, {high}]"
        )
    return int(value)


def _digest(mesostructure):
    """Fingerprint of geometry and materials: a user's mesh has no parameters that say what it is."""
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
