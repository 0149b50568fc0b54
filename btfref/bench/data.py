"""The BTFs that benchmarks share."""

from __future__ import annotations

from pathlib import Path

#: What tables of papers are made of.
MESOSTRUCTURES = ("checker", "rings", "tissue")


def checker(*, texels=64, spp=2, progress=None):
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

    return synthesize("checker", texels=texels, spp=spp, progress=progress)


def materials(btf, names, *, progress=None, **settings):
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


def material_name(btf):
    """What a BTF is of: its mesostructure if it was synthesized, else the name of its file."""
    parent = btf.attributes.get("parent", {})
    if "mesostructure" in (parent.get("kind"), *btf.attributes):
        return str(parent.get("name", btf.attributes.get("mesostructure")))
    return Path(btf.path).name.removesuffix(".btf.zarr") if btf.path else "BTF"
