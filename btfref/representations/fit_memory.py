"""Whether a fit stays within a budget of memory: fits hold the whole sampled BTF, and more than once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.representations.protocol import StatesMemory
from btfref.sampling import memory

if TYPE_CHECKING:
    from btfref.registry import Method
    from btfref.sampling.store.store import BTFStore

#: Bytes that any fit takes beside the BTF: modules of SciPy and scikit-learn, lookups between the samples.
FIT_BASE = 360 << 20

#: What a method takes that says nothing of itself: the values, their copy as float32 and another one of it.
UNKNOWN = 0, 10.0

#: Bytes of a value in the stores for which methods state theirs.
HALF = 2


def least_budget(method: Method, store: BTFStore) -> int:
    """The smallest budget in which a method can be fitted to a store.

    Parameters
    ----------
    method : btfref.registry.Method
    store : BTFStore

    Returns
    -------
    int
        Bytes of the process at its peak.
    """
    values = 3 * len(store.views) * len(store.lights) * store.texels[0] * store.texels[1]
    fitting = method.fitting
    blocks, each = fitting.FIT_MEMORY if isinstance(fitting, StatesMemory) else UNKNOWN
    return FIT_BASE + blocks + int(values * (each + np.dtype(store.dtype).itemsize - HALF))


def check_budget(method: Method, store: BTFStore, budget: int | None) -> None:
    """Refuse a fit that would take more than its budget.

    Parameters
    ----------
    method : btfref.registry.Method
    store : BTFStore
    budget : int or None
        Bytes of the process; by default half of the machine's memory.

    Raises
    ------
    InputError
    """
    budget = memory.default_budget() if budget is None else budget
    least = least_budget(method, store)
    if least > budget:
        memory.refuse(budget, least, what=f"memory budget too small to fit {method.key} to so many values")
