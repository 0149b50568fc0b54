"""Sampled BTFs: in memory, on disk, and their synthesis from mesostructure.

The names are looked up when they are used: settings and their defaults can be read without NumPy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.settings import SynthesisSettings
    from btfref.sampling.store.layout import attributes_of
    from btfref.sampling.store.store import BTFStore, open_store

__all__ = ["BTFStore", "SampledBTF", "SynthesisSettings", "attributes_of", "open_store"]

_MODULES = {
    "BTFStore": "store.store",
    "SampledBTF": "sampled_btf",
    "SynthesisSettings": "settings",
    "attributes_of": "store.layout",
    "open_store": "store.store",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
