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
    cache: Cache,
    mesostructure: str,
    settings: Settings,
    *,
    twin: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Synthesize a BTF, or its twin of other random numbers, unless it is there.

    Returns
    -------
    pathlib.Path
        The store.
    """
    from btfref.sampling.settings import SynthesisSettings
    from btfref.sampling.synthesis import synthesize

    made = SynthesisSettings(
        texels=settings.texels,
        views=settings.directions,
        lights=settings.directions,
        spp=settings.spp,
        estimator=settings.estimator,
        seed=settings.seed + TWIN * twin,
    )

    def save(path: Path) -> None:
        synthesize(mesostructure, made, out=path, progress=progress)

    return cache.get(material_key(mesostructure, settings), f".{int(twin)}.btf.zarr", save)


@lru_cache(maxsize=2)
def load_material(path: Path) -> SampledBTF:
    """A sampled BTF, kept for the next caller of the same process."""
    from btfref.sampling import SampledBTF

    return SampledBTF.load(path, variance=False)
