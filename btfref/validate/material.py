"""Materials of the matrix: sampled BTFs, each with an independent twin."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.provenance.code import code_of
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
    from btfref.mesostructure import place

    named = ("texels", "directions", "estimator", "spp", "seed")
    facts = {name: getattr(settings, name) for name in named}
    return key_of(
        {"material": mesostructure, **facts, "code": code_of(__name__, places=(place(mesostructure),))}
    )


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
        made = SynthesisSettings(
            texels=settings.texels,
            views=settings.directions,
            lights=settings.directions,
            spp=settings.spp,
            estimator=settings.estimator,
            seed=settings.seed + TWIN * twin,
        )

        def save(path: Path, made: SynthesisSettings = made) -> None:
            synthesize(mesostructure, made, out=path, progress=progress)

        paths.append(cache.get(key, f".{twin}.btf.zarr", save))
    return paths


@lru_cache(maxsize=2)
def load_material(path: Path) -> SampledBTF:
    """A sampled BTF, kept for the next caller of the same process."""
    from btfref.sampling import SampledBTF

    return SampledBTF.load(path, variance=False)
