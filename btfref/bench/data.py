"""The BTFs that benchmarks share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.sampling import SampledBTF
    from btfref.types import Progress


#: What tables of papers are made of.
MESOSTRUCTURES = ("checker", "rings", "tissue")


def checker(*, texels: int = 64, spp: int = 2, progress: Progress | None = None) -> SampledBTF:
    """The checker at 81² directions, in memory; drafts are enough where only the size matters.

    Parameters
    ----------
    texels, spp : int
    progress : callable, optional

    Returns
    -------
    SampledBTF
    """
    from btfref.sampling.synthesis import synthesize

    return synthesize("checker", texels=texels, spp=spp, estimator="path", progress=progress)


def materials(
    btf: SampledBTF | None, names: Iterable[str], *, progress: Progress | None = None, **settings: Any
) -> Iterator[tuple[str, SampledBTF]]:
    """What a table goes through: the BTF that a user brings, or mesostructures.

    Parameters
    ----------
    btf : SampledBTF or None
    names : sequence of str
        Mesostructures, when there is no ``btf``.
    progress : callable, optional
    **settings
        Of :func:`btfref.sampling.synthesis.synthesize`.

    Yields
    ------
    name : str
    btf : SampledBTF
    """
    from btfref.sampling.synthesis import synthesize

    if btf is not None:
        yield material_name(btf), btf
        return
    for name in names:
        yield name, synthesize(name, progress=progress, **settings)


def material_name(btf: SampledBTF) -> str:
    """What a BTF is of: its mesostructure if it was synthesized, else the name of its file."""
    parent = btf.attributes.get("parent", {})
    if "mesostructure" in (parent.get("kind"), *btf.attributes):
        return str(parent.get("name", btf.attributes.get("mesostructure")))
    return Path(btf.path).name.removesuffix(".btf.zarr") if btf.path else "BTF"


def source_of(btf: SampledBTF) -> Mesostructure | None:
    """The geometry that a BTF was synthesized from.

    Parameters
    ----------
    btf : SampledBTF

    Returns
    -------
    Mesostructure or None
        None for measured data, and for geometry that is not there any more, or not the same.
    """
    from btfref.errors import InputError
    from btfref.mesostructure import build
    from btfref.sampling.job import fingerprint

    parent = btf.attributes.get("parent", {})
    if parent.get("kind") != "mesostructure":
        return None
    try:
        made = build(parent["name"], **parent["parameters"])
    except (InputError, TypeError, KeyError):
        return None
    return made if fingerprint(made) == parent.get("geometry") else None
