"""A validation by the workers of a Dask cluster: they share the folder of results, and must run the same code.

A worker answers for nothing that it would have made from other code, another driver or another scene: before its first
job of a run it compares what it runs with what was asked for, and before each one the keys of its results.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import BtfrefError, InputError
from btfref.provenance.told import accepted, order
from btfref.validate.pool import Job, use_threads
from btfref.validate.stages.drawn import driver

if TYPE_CHECKING:
    import distributed

    from btfref.sampling.scheduling import Means, Scheduler
    from btfref.types import PathLike

#: Modules that make results.
ROOTS = (
    "btfref.validate.cell",
    "btfref.validate.stages.checks",
    "btfref.validate.material",
    "btfref.validate.stages.off_grid",
)


class Workers:
    """The workers of a cluster.

    Parameters
    ----------
    client : distributed.Client
    means : Means
        Threads of each.
    path : pathlib.Path
        The file that tells them what to be like, in the folder of results.
    """

    def __init__(self, client: distributed.Client, means: Means, path: Path) -> None:
        self._client, self._means, self._path = client, means, path
        self.size = max(1, len(client.nthreads()))

    def each(self, jobs: Sequence[Job]) -> Iterator[tuple[Any, bool]]:
        """See `btfref.validate.pool.Pool`; what a lost worker had not finished goes to another.

        Raises
        ------
        InputError
            Workers or the scheduler are lost, or a worker that does not see the folder or is another.
        """
        from btfref.sampling.cluster.tasks import results

        pieces = [(str(self._path), job, keys(job), self._means["threads"]) for job in jobs]
        return results(self._client, work, pieces, self._path.parent)


def keys(job: Job) -> list[str]:
    """Keys of what a job computes; none where what they are made of is missing, of which the job tells."""
    try:
        return job.keys(*job.arguments[1:])
    except BtfrefError:
        return []


@contextmanager
def workers_of(
    scheduler: Scheduler,
    workers: int,
    root: PathLike,
    methods: Sequence[str],
    mesostructures: Sequence[str],
) -> Iterator[Workers]:
    """The workers of a cluster, which were told what to be like.

    Parameters
    ----------
    scheduler : str or distributed.Client
        See `btfref.sampling.scheduling.run`.
    workers : int
        Of a local cluster.
    root : path-like
        Folder of results.
    methods, mesostructures : sequence of str
        That take part.

    Yields
    ------
    Workers

    Raises
    ------
    InputError
        A scheduler that cannot be reached, or workers in this process.
    MissingDependencyError
        Dask is not installed.
    """
    from btfref.mesostructure import place
    from btfref.sampling.scheduling import asked_of_all, cluster, refuse_other_versions

    with cluster(scheduler, workers, None) as (client, means):
        refuse_other_versions(client)
        if list(_whereabouts()) in map(list, asked_of_all(client, _whereabouts).values()):
            # Its threads would draw with this thread's OpenGL context.
            raise InputError("workers must be processes of their own", field="scheduler")
        places = [place(name) for name in mesostructures]
        with order(root, ROOTS, methods, places, driver=driver()) as path:
            yield Workers(client, means, path)


def _whereabouts() -> tuple[str, int]:
    """Machine and process."""
    return socket.gethostname(), os.getpid()


def work(path: str, job: Job, wanted: list[str], threads: int | None) -> tuple[Any, bool]:
    """What a worker does: a job, if what it would make is what is wanted.

    Parameters
    ----------
    path : str
        File of the run: see `btfref.provenance.told.order`.
    job : Job
    wanted : list of str
        Keys of its results, as who asks has them.
    threads : int or None
        That it may use; None for as many as Dask gave it.

    Raises
    ------
    InputError
        The worker does not see the folder, or has other code, another driver or another scene.
    """
    if threads is None:
        from distributed import get_worker

        threads = int(get_worker().state.nthreads)
    from btfref.sampling.scheduling import LOCK

    with LOCK:
        # An OpenGL context belongs to a thread, and Dask's threads come and go.
        return _thread().submit(_job, path, job, wanted, threads).result()


@cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1)


def _job(path: str, job: Job, wanted: list[str], threads: int) -> tuple[Any, bool]:
    from threadpoolctl import threadpool_limits

    use_threads(threads)
    with threadpool_limits(threads):
        facts = accepted(path)
        if driver() != facts["driver"]:
            raise InputError(
                "a worker draws with another OpenGL driver or browser",
                field="driver",
                got=driver(),
                expected=facts["driver"],
            )
        own = keys(job)
        if own != wanted:
            raise InputError(
                "a worker would make another result",
                file=Path(path).parent,
                field=job.run.__name__.strip("_"),
                got=", ".join(own)[:40] or "nothing",
                expected=f"{', '.join(wanted)[:40] or 'nothing'}: the same scene files",
            )
        return job.run(*job.arguments)
