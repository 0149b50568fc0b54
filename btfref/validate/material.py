"""Materials of the matrix: sampled BTFs with an independent twin, and the fits of every method."""

from __future__ import annotations

import os
import shutil
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.provenance import code_of
from btfref.validate.cache import key_of

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import Progress
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings


#: Seeds are apart by this: the twin's samples share no random number with the BTF that is fitted.
TWIN = 1000


def material_key(mesostructure: str, settings: Settings) -> str:
    """Key of a sampled BTF and its twin."""
    named = ("texels", "directions", "estimator", "spp", "seed")
    facts = {name: getattr(settings, name) for name in named}
    return key_of({"material": mesostructure, **facts, "code": code_of("material")})


def make_material(
    cache: Cache, mesostructure: str, settings: Settings, progress: Progress | None = None
) -> list[Path]:
    """Synthesize a BTF and its twin, unless they are there.

    Returns
    -------
    list of pathlib.Path
        The stores.
    """
    from btfref.sampling.settings import SynthesisSettings
    from btfref.sampling.synthesis import synthesize

    key, paths = material_key(mesostructure, settings), []
    for twin in (0, 1):
        path = cache.path(key, f".{twin}.btf.zarr")
        paths.append(path)
        if path.exists():
            continue
        # A run that was killed leaves its parts under this name, and nothing under the other.
        partial = cache.path(key, f".{twin}.{os.getpid()}.btf.zarr")
        made = SynthesisSettings(
            texels=settings.texels,
            views=settings.directions,
            lights=settings.directions,
            spp=settings.spp,
            estimator=settings.estimator,
            seed=settings.seed + TWIN * twin,
        )
        synthesize(mesostructure, made, out=partial, overwrite=True, progress=progress)
        if path.exists():
            shutil.rmtree(partial)
        else:
            os.replace(partial, path)
    return paths


@lru_cache(maxsize=2)
def load_material(path: Path) -> SampledBTF:
    """A sampled BTF, kept for the next caller of the same process."""
    from btfref.sampling import SampledBTF

    return SampledBTF.load(path, variance=False)


def fit_key(mesostructure: str, method: str, settings: Settings) -> str:
    """Key of a fit."""
    facts = {"fit": method, "material": material_key(mesostructure, settings), "seed": settings.seed}
    return key_of({**facts, "code": code_of("fit", method)})


def make_fit(cache: Cache, mesostructure: str, method: str, settings: Settings) -> Path:
    """Fit a method with its defaults to a material, unless that is done.

    Returns
    -------
    pathlib.Path
    """
    from btfref.registry import method as row
    from btfref.representations import between, save

    key, suffix = fit_key(mesostructure, method, settings), f".{method}.exr"
    if cache.has(key, suffix):
        return cache.path(key, suffix)
    btf = load_material(make_material(cache, mesostructure, settings)[0])
    made = between.fit(row(method), btf, seed=settings.seed)
    return cache.write(key, suffix, lambda path: save(made, path))
