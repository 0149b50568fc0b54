"""Sampled BTFs: in memory, on disk, and their synthesis from mesostructure."""

from __future__ import annotations

from btfref.sampling.sampled_btf import SampledBTF
from btfref.sampling.store.layout import attributes_of
from btfref.sampling.store.store import BTFStore, open_store

__all__ = ["BTFStore", "SampledBTF", "attributes_of", "open_store"]
