"""The oracle: B at random places, footprints and pairs of directions of a modelled surface, with its noise.

`laws` says what is asked, `paths` and `lookups` answer, `files` keeps the rows. The names are looked up when they are
used: laws and settings can be read without Mitsuba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfref.querying.batches import queries
    from btfref.querying.files.zarr_file import open_queries
    from btfref.querying.job import query_file
    from btfref.querying.settings import QuerySettings

__all__ = ["QuerySettings", "open_queries", "queries", "query_file"]

_MODULES = {
    "QuerySettings": "settings",
    "open_queries": "files.zarr_file",
    "queries": "batches",
    "query_file": "job",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
