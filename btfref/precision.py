"""The precision in which definitions compute: float64, unless single precision is asked for to see what it costs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

_KIND = ContextVar("precision", default="float64")


def precision() -> np.dtype:
    """Type of the numbers that definitions compute with: numpy.dtype of float64 or float32."""
    return np.dtype(_KIND.get())


def real(values: ArrayLike) -> np.ndarray:
    """``values`` as an array of numbers of :func:`precision`; no copy where they are that already."""
    return np.asarray(values, _KIND.get())


@contextmanager
def computing_in(kind: DTypeLike) -> Iterator[None]:
    """Let definitions compute in another precision, in this thread and context alone.

    Parameters
    ----------
    kind : {numpy.float64, numpy.float32}
        ``evaluate`` rounds its arguments to it, and returns it.
    """
    kind = np.dtype(kind)
    if kind not in (np.float64, np.float32):
        raise ValueError(f"precision must be float64 or float32, got {kind}")
    token = _KIND.set(kind.name)
    try:
        yield
    finally:
        _KIND.reset(token)
