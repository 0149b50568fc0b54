"""Arrays of a store on disk, and what of their axes is read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from btfref.errors import InputError

#: What of an axis is read: all, one, a slice, or a list of indices.
Choice: TypeAlias = "int | slice | Sequence[int] | np.ndarray | None"


class StoredArray(Protocol):
    """An array on disk, which Zarr's own types say little about: parts of it are NumPy arrays."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    shards: tuple[int, ...] | None
    dtype: np.dtype
    oindex: Any
    metadata: Any

    def __getitem__(self, selection: Any, /) -> np.ndarray: ...

    def __setitem__(self, selection: Any, value: np.ndarray, /) -> None: ...


def along_axis(name: str, index: Choice, n: int) -> slice | np.ndarray:
    """An index as a slice where it is one (Zarr reads slices much faster), else as an array of int."""
    if index is None:
        return slice(None)
    chosen = (
        np.atleast_1d(np.arange(n)[index]) if isinstance(index, slice) else np.atleast_1d(np.asarray(index))
    )
    if chosen.ndim != 1 or chosen.size == 0 or not np.issubdtype(chosen.dtype, np.integer):
        raise InputError("selection", field=name, got=index, expected="indices")
    if chosen.min() < -n or chosen.max() >= n:
        raise InputError("index out of range", field=name, got=index, expected=f"0 … {n - 1}")
    chosen = np.where(chosen < 0, chosen + n, chosen)
    if (np.diff(chosen) == 1).all():
        return slice(int(chosen[0]), int(chosen[-1]) + 1)
    return chosen
