"""Fits of the matrix: every method with its defaults to every material."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from btfref.provenance.code import code_of
from btfref.validate.cache import key_of
from btfref.validate.material import load_material, make_material, material_key

if TYPE_CHECKING:
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings


def fit_key(mesostructure: str, method: str, settings: Settings) -> str:
    """Key of a fit."""
    facts = {"fit": method, "material": material_key(mesostructure, settings), "seed": settings.seed}
    return key_of({**facts, "code": code_of(__name__, method)})


def make_fit(cache: Cache, mesostructure: str, method: str, settings: Settings) -> Path:
    """Fit a method with its defaults to a material, unless that is done.

    Returns
    -------
    pathlib.Path
    """
    from btfref.registry import method as row
    from btfref.representations import between, save

    def save_fit(path: Path) -> None:
        btf = load_material(make_material(cache, mesostructure, settings))
        save(between.fit(row(method), btf, seed=settings.seed), path)

    return cache.get(fit_key(mesostructure, method, settings), f".{method}.exr", save_fit)
