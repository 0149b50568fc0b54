"""Mitsuba 3 plugin ``btf``: every compressed representation as a BSDF.

After ``mi.set_variant(...)`` call :func:`register`; then scenes may use
``{"type": "btf", "filename": "checker.lpca.exr"}``.
"""

from __future__ import annotations

_registered: set[str] = set()


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
    if variant is None or not variant.endswith("_rgb") or variant.startswith("scalar"):
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
