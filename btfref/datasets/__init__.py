"""Standard sets of synthetic BTFs with known truth: what is in them, how they are made, checked and opened.

`sets` says what a set holds, `making` makes a package, `manifest` names its files and checks them, `package` opens it.
The names are looked up when they are used: lists of materials can be read without Mitsuba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfref.datasets.making import make
    from btfref.datasets.package import Package, dataset
    from btfref.datasets.sets import SETS
    from btfref.datasets.verifying import verify

__all__ = ["SETS", "Package", "dataset", "make", "verify"]

_MODULES = {
    "SETS": "sets",
    "Package": "package",
    "dataset": "package",
    "make": "making",
    "verify": "verifying",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
