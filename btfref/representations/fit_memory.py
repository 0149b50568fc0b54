"""Whether a fit stays within a budget of memory: what it holds of a sampled BTF at a time, and what it makes of it."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.representations.protocol import FitMemory, StatesMemory
from btfref.sampling import SampledBTF, memory
from btfref.sampling.blocks import StreamedBTF

if TYPE_CHECKING:
    from collections.abc import Iterator

    from btfref.registry import Method
    from btfref.sampling.blocks import BTFBlocks
    from btfref.sampling.scheduling import Scheduler
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts

#: Bytes that any fit takes beside the BTF: modules of SciPy and scikit-learn, lookups between the samples.
FIT_BASE = 360 << 20

#: What a method takes that says nothing of itself: the values, their copy as float32 and another one of it.
UNKNOWN = FitMemory(10.0)

#: Copies of the tables while they are found, scaled, stored and looked up, in float32.
TABLE_COPIES = 8

#: Bytes of a value in the stores for which methods state theirs.
HALF = 2


def least_budget(method: Method, store: BTFStore, parameters: Facts | None = None) -> int:
    """The smallest budget in which a method can be fitted to a store.

    Parameters
    ----------
    method : btfref.registry.Method
    store : BTFStore
    parameters : dict, optional
        Of the fit, where they are not the defaults.

    Returns
    -------
    int
        Bytes of the process at its peak.
    """
    pairs, texels = len(store.views) * len(store.lights), store.texels[0] * store.texels[1]
    states = stated(method)
    given = method.parameters | (parameters or {}) if states.scales or states.tables else {}
    scale = 1.0
    for name in states.scales:
        scale *= max(1.0, _number(given[name]) / _number(method.parameters[name]))
    blocks = states.blocks * scale
    tables = math.prod(_number(given[name]) for name in states.tables) if states.tables else 0
    blocks += TABLE_COPIES * 4 * (tables + states.columns) * (3 * pairs + texels)
    blocks += texels * (states.texel * scale + len(store.views) * states.field)
    wider = np.dtype(store.dtype).itemsize - HALF
    if states.streams:
        together = max(1, min(store.texels[0], states.texels // store.texels[1])) * store.texels[1]
        blocks += 3 * pairs * together * (states.rows + wider if states.rows else 0)
        blocks += 3 * len(store.lights) * texels * (states.view + wider if states.view else 0)
        return FIT_BASE + int(blocks + 3 * pairs * texels * states.each)
    return FIT_BASE + int(blocks + 3 * pairs * texels * (states.each + wider))


def stated(method: Method) -> FitMemory:
    """What the method's module says of its fit, or what counts where it says nothing."""
    fitting = method.fitting
    return fitting.FIT_MEMORY if isinstance(fitting, StatesMemory) else UNKNOWN


def read_within(
    method: Method, store: BTFStore, budget: int | None, parameters: Facts | None = None
) -> SampledBTF | StreamedBTF:
    """A store as a method fits it: part by part where it can, whole otherwise.

    Parameters
    ----------
    method, store, budget, parameters
        See :func:`check_budget`.

    Raises
    ------
    InputError
        The fit would take more than its budget, or the store is not complete.
    """
    check_budget(method, store, budget, parameters)
    if not stated(method).streams:
        return SampledBTF.load(store.path, variance=False)
    budget = memory.default_budget() if budget is None else budget
    return StreamedBTF(store, spare=budget - least_budget(method, store, parameters))


@contextlib.contextmanager
def fitted_by(
    method: Method,
    store: BTFStore,
    budget: int | None,
    parameters: Facts | None,
    scheduler: Scheduler,
    workers: int | None,
) -> Iterator[BTFBlocks]:
    """A store as a method fits it, by this process or by the workers of a cluster; the bytes are the same.

    Parameters
    ----------
    method, store, parameters
        See :func:`check_budget`.
    budget : int, optional
        Bytes of this process and of all workers that it starts together, or of each process where the cluster runs
        elsewhere; by default half of the machine's memory.
    scheduler, workers
        See :func:`btfref.sampling.scheduling.run`; without a scheduler see :func:`read_within`.

    Yields
    ------
    BTFBlocks

    Raises
    ------
    InputError
        As for both of these, and for a method that cannot be fitted block by block.
    """
    if scheduler is None:
        yield read_within(method, store, budget, parameters)
        return
    if not stated(method).streams:
        raise InputError("the method needs the whole BTF in one process", field="scheduler", got=method.key)
    if stated(method).sequential:
        raise InputError("the method's steps follow each other", field="scheduler", got=method.key)
    from btfref.sampling.passes import distributed_btf

    check_budget(method, store, budget, parameters)
    least = least_budget(method, store, parameters)
    with distributed_btf(store, scheduler, workers, budget, least=least) as btf:
        yield btf


def _number(value: object) -> float:
    """A parameter that counts something; what is none is refused by the fit itself."""
    return float(value) if isinstance(value, int | float) and value > 0 else 1.0


def check_budget(
    method: Method, store: BTFStore, budget: int | None, parameters: Facts | None = None
) -> None:
    """Refuse a fit that would take more than its budget.

    Parameters
    ----------
    method : btfref.registry.Method
    store : BTFStore
    budget : int or None
        Bytes of the process; by default half of the machine's memory.
    parameters : dict, optional
        Of the fit, where they are not the defaults.

    Raises
    ------
    InputError
    """
    budget = memory.default_budget() if budget is None else budget
    least = least_budget(method, store, parameters)
    if least > budget:
        memory.refuse(budget, least, what=f"memory budget too small to fit {method.key} to so many values")
