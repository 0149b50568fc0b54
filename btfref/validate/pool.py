"""Who computes the jobs of a validation: this process, processes that it starts, or the workers of a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from typing import TYPE_CHECKING, Any, Protocol

from btfref.errors import BtfrefError
from btfref.validate.stages.drawn import found, recall

if TYPE_CHECKING:
    from btfref.types import Facts

#: Memory that a process needs: a BTF of 64² texels and 81² directions twice over, and its pictures.
MEMORY_PER_WORKER = 3 << 30


@dataclass(frozen=True)
class Job:
    """What some process computes.

    Parameters
    ----------
    run : callable
        Of a module; gives the result, and whether anything was computed now.
    keys : callable
        Of the same arguments; the keys of what it computes, as far as they can be made.
    arguments : tuple
        The first is the folder of the cache.
    """

    run: Callable[..., tuple[Any, bool]]
    keys: Callable[..., list[str]]
    arguments: tuple[Any, ...]


class Pool(Protocol):
    """Whoever computes."""

    #: Processes that compute side by side.
    size: int

    def each(self, jobs: Sequence[Job]) -> Iterator[tuple[Any, bool]]:
        """Results of jobs as they come; ``(result, whether it was computed now)``."""


class Here:
    """The pool of one: this process."""

    size = 1

    def each(self, jobs: Sequence[Job]) -> Iterator[tuple[Any, bool]]:
        """See `Pool`."""
        for job in jobs:
            yield job.run(*job.arguments)


class Processes:
    """Processes of this one.

    Parameters
    ----------
    pool : concurrent.futures.ProcessPoolExecutor
    size : int
    """

    def __init__(self, pool: ProcessPoolExecutor, size: int) -> None:
        self.size, self._pool = size, pool

    def each(self, jobs: Sequence[Job]) -> Iterator[tuple[Any, bool]]:
        """See `Pool`.

        Raises
        ------
        BtfrefError
            When a process dies.
        """
        futures = [self._pool.submit(job.run, *job.arguments) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise BtfrefError(
                "a process of the validation died, most likely for want of memory; try --workers 1"
            ) from error


def default_workers() -> int:
    """Processes that cores and memory allow."""
    from btfref.sampling.memory import default_budget
    from btfref.sampling.scheduling import processors

    return max(1, min(processors(), default_budget() // MEMORY_PER_WORKER))


@contextmanager
def local(workers: int) -> Iterator[Pool]:
    """One worker is this process; more are processes that it starts.

    Yields
    ------
    Pool
    """
    if workers == 1:
        yield Here()
        return
    others = set(active_children())
    # Spawned: neither Dr.Jit nor a GL driver survives a fork.
    made = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_start_worker, initargs=(found(),)
    )
    with made as pool:
        try:
            yield Processes(pool, workers)
        except BaseException:
            # Nobody waits for what they are at, whatever ends this process.
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(active_children()) - others:
                child.terminate()
            raise


def _start_worker(known: Facts) -> None:
    """About one core a process. What is known need not be asked again."""
    recall(known)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    use_threads(1)


def use_threads(threads: int) -> None:
    """Tell OpenGL, before its driver is there, and Dr.Jit their threads: too many would only wait for each other."""
    os.environ["LP_NUM_THREADS"] = str(threads)
    from btfref.errors import MissingDependencyError
    from btfref.platform import prepare_llvm, use_processors

    try:
        prepare_llvm()
    except MissingDependencyError:
        return  # the jobs say so
    use_processors(threads)
