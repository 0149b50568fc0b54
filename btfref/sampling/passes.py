"""What is made of a sampled BTF block by block: by this process, or by the workers of a Dask cluster.

Blocks and their order follow from the data alone, and whoever asked adds results up in that order: the same bytes from
any number of workers, and without them.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from btfref.errors import InputError
from btfref.numerics.solvers.threads import reproducible
from btfref.platform import use_processors
from btfref.sampling import memory
from btfref.sampling.blocks import StreamedBTF

if TYPE_CHECKING:
    import distributed

    from btfref.sampling.blocks import BTFBlocks
    from btfref.sampling.scheduling import Means, Scheduler
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts, PathLike

S = TypeVar("S")
I = TypeVar("I")  # noqa: E741 - an item
R = TypeVar("R")

#: Tasks for each thread of the workers that are handed out ahead of what was added up: enough that no one waits, few
#: enough that results which wait take little memory.
AHEAD = 3

#: Tasks for each thread of the workers in a pass of many small items.
TASKS = 24

#: What is made of an item: of a module, so that workers find it, called with the BTF, what all items share, and it.
Work = Callable[["BTFBlocks", S, I], Iterable[R]]


def over_blocks(
    btf: BTFBlocks,
    work: Work[S, I, R],
    shared: S,
    items: Iterable[I],
    tick: Callable[[], object] = lambda: None,
) -> Iterator[R]:
    """What is made of each item, in the order of the items.

    Parameters
    ----------
    btf : BTFBlocks
        Of a :class:`DistributedBTF` workers make it, else this process, not before the result is asked for.
    work : callable
        ``(btf, shared, item) -> results``: a function of a module, or a partial of one; it depends on nothing else.
    shared : object
        The same for all items; nothing may change it.
    items : iterable
        Such as views, or first and last rows.
    tick : callable
        Called after each item.

    Yields
    ------
    object
        The results of all items, one after the other.
    """
    if isinstance(btf, DistributedBTF):
        yield from btf.over_blocks(work, shared, items, tick)
        return
    for item in items:
        yield from work(btf, shared, item)
        tick()


@dataclass(frozen=True)
class Order:
    """What a worker is told of all items of a pass.

    Attributes
    ----------
    path : str
        Of the store.
    run : str
        Name of the fit: within it the store stays as it is.
    versions : dict
        Of who asks.
    means : Means
        Budget and threads of a worker.
    least : int
        Bytes that it needs.
    """

    path: str
    run: str
    versions: Facts
    means: Means
    least: int


class DistributedBTF(StreamedBTF):
    """A store of which the workers of a cluster make what is asked of blocks.

    Parameters
    ----------
    store : BTFStore or path-like
    client : distributed.Client
    means : Means
        Of each worker.
    least : int
        Bytes that a worker needs.
    spare : int
        Bytes in which this process may hold rows that it reads itself.

    Raises
    ------
    InputError
        An incomplete store, or a worker of another version.
    """

    def __init__(
        self,
        store: BTFStore | PathLike,
        client: distributed.Client,
        means: Means,
        *,
        least: int = 0,
        spare: int = 0,
    ) -> None:
        from btfref.provenance import versions
        from btfref.sampling.scheduling import refuse_other_versions

        super().__init__(store, spare=spare)
        refuse_other_versions(client)
        assert self.path is not None
        self._client = client
        self._order = Order(str(self.path.resolve()), uuid.uuid4().hex, versions(), means, least)
        #: Largest memory (bytes) of a worker so far.
        self.largest = 0

    def claim(self, size: int) -> bool:
        """Never: what a fit would keep for its next pass, workers make again."""
        return False

    def over_blocks(
        self, work: Work[S, I, R], shared: S, items: Iterable[I], tick: Callable[[], object]
    ) -> Iterator[R]:
        """See :func:`over_blocks`.

        Raises
        ------
        InputError
            Workers or the scheduler are lost, or a worker does not see the store.
        """
        from btfref.sampling.cluster.tasks import lost_in_one_line

        assert self.path is not None
        threads = max(1, sum(self._client.nthreads().values()))
        todo, waiting = list(items), deque[Any]()
        size = max(1, len(todo) // (threads * TASKS))
        groups = deque(todo[first : first + size] for first in range(0, len(todo), size))
        submit = functools.partial(self._client.submit, pure=False, retries=2)
        with lost_in_one_line(self.path):
            with warnings.catch_warnings():
                # What is shared stands in the task graph, where it outlives every worker: large, and sent once.
                warnings.filterwarnings("ignore", message="Sending large graph")
                held = submit(_held, shared)
            try:
                while groups or waiting:
                    while groups and len(waiting) < AHEAD * threads:
                        waiting.append(submit(_made, self._order, work, held, groups.popleft()))
                    found, used = waiting.popleft().result()
                    self.largest = max(self.largest, used)
                    for results in found:
                        yield from results
                        tick()
            finally:
                with contextlib.suppress(Exception):  # a cluster that is gone cannot be told
                    self._client.cancel([held, *waiting])


@contextlib.contextmanager
def distributed_btf(
    store: BTFStore, scheduler: Scheduler, workers: int | None, budget: int | None, *, least: int
) -> Iterator[DistributedBTF]:
    """A store, and the workers of a cluster for what is made of its blocks.

    Parameters
    ----------
    store : BTFStore
    scheduler, workers
        See :func:`btfref.sampling.scheduling.run`.
    budget : int, optional
        Bytes of this process and of all workers that it starts together, or of each process where the cluster runs
        elsewhere; by default half of the machine's memory.
    least : int
        Bytes that each of these processes needs.

    Yields
    ------
    DistributedBTF

    Raises
    ------
    InputError
        See :func:`btfref.sampling.scheduling.run`.
    MissingDependencyError
        Dask is not installed.
    """
    from btfref.sampling.scheduling import cluster, local_workers

    if scheduler == "dask":
        budget, count = memory.default_budget() if budget is None else budget, local_workers(workers)
        if budget < (count + 1) * least:
            what = f"memory budget too small for workers ({count}) and what adds up their results"
            memory.refuse(budget, (count + 1) * least, what=what)
        budget -= least
    with cluster(scheduler, workers, budget) as (client, means):
        yield DistributedBTF(store, client, means, least=least, spare=means["memory"] or 0)


def _held(shared: S) -> S:
    """What all items share, as a task of its own: made anew by itself where the worker that has it is lost."""
    return shared


def _made(order: Order, work: Work[S, I, R], shared: S, items: list[I]) -> tuple[list[list[R]], int]:
    """What a worker does: the results of some items, and its largest memory."""
    from btfref.sampling.scheduling import LOCK

    with LOCK:
        btf = _opened(order)
        threads = order.means["threads"]
        if threads is not None and "drjit" in sys.modules:
            use_processors(threads)
        with reproducible(threads):
            return [list(work(btf, shared, item)) for item in items], memory.peak()


#: The store of the last fit that this worker was asked for, by its name.
_OPENED: dict[str, StreamedBTF] = {}


def _opened(order: Order) -> StreamedBTF:
    """The store of an order, checked and opened once for a fit."""
    if order.run not in _OPENED:
        _OPENED.clear()
        refuse_versions(order.versions)
        budget = order.means["memory"]
        budget = memory.default_budget() if budget is None else budget
        if budget < order.least:
            memory.refuse(budget, order.least, what="memory budget of a worker too small")
        if not Path(order.path).is_dir():
            raise InputError(
                "a worker does not see the store", file=order.path, expected="the same path everywhere"
            )
        _OPENED[order.run] = StreamedBTF(order.path, spare=budget - order.least)
    return _OPENED[order.run]


def refuse_versions(told: Facts) -> None:
    """InputError where who asks has other versions than this worker."""
    from btfref.provenance import versions

    own = versions()
    if own != told:
        name = next(name for name in {**own, **told} if own.get(name) != told.get(name))
        raise InputError(
            "a worker of another version", field=name, got=own.get(name), expected=told.get(name)
        )
