"""Mitsuba with a chosen variant, and the caller's own variant back afterwards."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from btfref.errors import InputError
from btfref.platform import set_variant


@contextmanager
def mitsuba_variant(variant: str) -> Iterator[ModuleType]:
    """Run a block under a Mitsuba variant; the variant set before is restored.

    Parameters
    ----------
    variant : str
        A JIT variant with RGB colours, e.g. "llvm_ad_rgb".

    Yields
    ------
    module
        ``mitsuba`` with that variant active.

    Raises
    ------
    InputError
        An unknown variant, or one that is not RGB or not JIT-compiled.
    """
    if variant.startswith("llvm"):
        from btfref.platform import prepare_llvm

        prepare_llvm()
    import mitsuba as mi

    usable = [name for name in mi.variants() if name.endswith("_rgb") and not name.startswith("scalar")]
    if variant not in usable:
        raise InputError(
            "Mitsuba variant", field="variant", got=repr(variant), expected=f"one of {', '.join(usable)}"
        )
    previous = mi.variant()
    set_variant(variant)
    if "mitsuba_plugins" in sys.modules:
        # Materials in Python that nobody holds any longer go now: freed in the middle of a trace they are a crash.
        gc.collect()
    try:
        yield mi
    finally:
        if previous is not None:
            mi.set_variant(previous)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's cyclic garbage while a block traces kernels.

    Dr.Jit lists all materials that exist and then calls them one after the other. A material in Python can start a
    collection, which frees those of scenes that nobody holds any longer: their turn would then be a crash.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
