"""Mitsuba 3 plugin ``btf``: every compressed representation as a BSDF.

After ``mi.set_variant(...)`` call :func:`register`; then scenes may use
``{"type": "btf", "filename": "checker.lpca.exr"}``. :func:`ready` does both for who does not mind the variant, and
:func:`load` loads one material.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray, PathLike

_registered: set[str] = set()


def ready(prefer: str = "llvm_ad_rgb") -> ModuleType:
    """Mitsuba in a variant that takes the plugin, with the plugin registered.

    Parameters
    ----------
    prefer : str
        Variant to set where none is set, or one that cannot take the plugin; another stays.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    MissingDependencyError
        Without a usable LLVM.
    InputError
        As :func:`register`.
    """
    from btfref.platform import prepare_llvm

    prepare_llvm()
    import mitsuba as mi

    if not _takes_the_plugin(mi.variant()):
        mi.set_variant(prefer)
    register()
    return mi


def load(path: PathLike, **parameters: object) -> JitArray:
    """The BSDF of a representation's file.

    Parameters
    ----------
    path : path-like
    **parameters
        Of the plugin, such as ``filter_type="nearest"``.

    Returns
    -------
    mitsuba.BSDF

    Raises
    ------
    RuntimeError
        From Mitsuba, with the reason of the plugin: a file or a parameter that it does not take.
    """
    return ready().load_dict({"type": "btf", "filename": str(path), **parameters})


def representation_of(bsdf: JitArray) -> Representation:
    """The representation that a material shows now, with the maps that were changed through ``mi.traverse``.

    Parameters
    ----------
    bsdf : mitsuba.BSDF
        Of the plugin ``btf``, or with one inside, such as ``twosided``.

    Returns
    -------
    Representation
        For `btfref.save`; its maps have the types of the file, to which changed ones are rounded.

    Raises
    ------
    InputError
        Where there is none or more than one, for a changed map that is computed from others (slopes and gloss of a
        g-BRDF), or a value that the map's type does not hold.
    """
    from btfref.errors import InputError
    from mitsuba_plugins.protocol import shown_by

    found = shown_by(bsdf)
    if len(found) != 1:
        raise InputError("materials of the plugin 'btf'", got=len(found), expected=1)
    return found[0].representation()


def _takes_the_plugin(variant: str | None) -> bool:
    return variant is not None and variant.endswith("_rgb") and not variant.startswith("scalar")


def register() -> None:
    """Make the plugin type ``btf`` known to the current Mitsuba variant; repeated calls do nothing.

    Raises
    ------
    InputError
        When no variant is set, or the variant is not a JIT-compiled, unpolarized RGB one.
    """
    import mitsuba as mi

    from btfref.errors import InputError

    variant = mi.variant()
    if not _takes_the_plugin(variant):
        raise InputError(
            "the plugin 'btf' needs a JIT-compiled, unpolarized RGB variant of Mitsuba",
            got=variant,
            expected="llvm_ad_rgb or cuda_ad_rgb",
        )
    if variant in _registered:
        return
    from mitsuba_plugins.base import make_bsdf

    mi.register_bsdf("btf", make_bsdf())
    _registered.add(variant)
