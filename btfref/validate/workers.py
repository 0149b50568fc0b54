"""A validation by the workers of a Dask cluster: they share the folder of results, and must run the same code.

A worker answers for nothing that it would have made from other code, another driver or another scene: before its first
job of a run it compares what it runs with what was asked for, and before each one the keys of its results.
"""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import BtfrefError, InputError
from btfref.provenance.told import refuse_changed_code, refuse_other_code, told
from btfref.validate.pool import Job, use_threads
from btfref.validate.stages.drawn import driver

if TYPE_CHECKING:
    import distributed

    from btfref.sampling.scheduling import Means, Scheduler
    from btfref.types import Facts, PathLike

#: Modules that make results of methods, and those that make what methods share.
OF_METHODS = ("btfref.validate.cell", "btfref.validate.stages.checks")
OF_MATERIALS = ("btfref.validate.material", "btfref.validate.stages.off_grid")


class Workers:
    """The workers of a cluster.

    Parameters
    ----------
    client : distributed.Client
    means : Means
        Threads of each.
    order : pathlib.Path
        The file that tells them what to be like, in the folder of results.
    """

    def __init__(self, client: distributed.Client, means: Means, order: Path) -> None:
        self._client, self._means, self._order = client, means, order
        self.size = max(1, len(client.nthreads()))

    def each(self, jobs: Sequence[Job]) -> Iterator[tuple[Any, bool]]:
        """See `btfref.validate.pool.Pool`; what a lost worker had not finished goes to another.

        Raises
        ------
        InputError
            Workers or the scheduler are lost, or a worker that does not see the folder or is another.
        """
        from btfref.sampling.scheduling import results

        pieces = [(str(self._order), job, keys(job), self._means["threads"]) for job in jobs]
        return results(self._client, work, pieces, self._order.parent)


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
    from btfref.provenance import __version__
    from btfref.sampling.scheduling import cluster, refuse_other_versions

    name = uuid.uuid4().hex
    folder = Path(root).resolve()
    with cluster(scheduler, workers, None) as (client, means):
        refuse_other_versions(client)
        if list(_whereabouts()) in map(list, client.run(_whereabouts).values()):
            # Its threads would draw with this thread's OpenGL context.
            raise InputError("workers must be processes of their own", field="scheduler")
        facts = {
            "btfref": __version__,
            "run": name,
            "driver": driver(),
            "methods": sorted(set(methods)),
            "mesostructures": sorted(set(mesostructures)),
        }
        order = folder / f"{name}.job.partial"
        folder.mkdir(parents=True, exist_ok=True)
        order.write_text(json.dumps({**facts, "told": code_told(facts)}), "utf-8")
        try:
            yield Workers(client, means, order)
        finally:
            order.unlink(missing_ok=True)


def _whereabouts() -> tuple[str, int]:
    """Machine and process."""
    return socket.gethostname(), os.getpid()


def code_told(order: Facts) -> Facts:
    """What a process runs of the code that a run needs: see `btfref.provenance.told.told`."""
    from btfref.mesostructure import place

    places = tuple(place(name) for name in order["mesostructures"])
    of_methods, shared = told(OF_METHODS, order["methods"]), told(OF_MATERIALS, (), places)
    return {kind: {**of_methods[kind], **shared[kind]} for kind in ("versions", "files")}


def work(order: str, job: Job, wanted: list[str], threads: int | None) -> tuple[Any, bool]:
    """What a worker does: a job, if what it would make is what is wanted.

    Parameters
    ----------
    order : str
        File of the run.
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
        return _thread().submit(_job, order, job, wanted, threads).result()


@cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1)


#: Runs that this worker has compared itself with.
_ACCEPTED: set[str] = set()


def _job(order: str, job: Job, wanted: list[str], threads: int) -> tuple[Any, bool]:
    from threadpoolctl import threadpool_limits

    use_threads(threads)
    with threadpool_limits(threads):
        _accept(Path(order))
        refuse_changed_code(_began())
        own = keys(job)
        if own != wanted:
            raise InputError(
                "a worker would make another result",
                file=Path(order).parent,
                field=job.run.__name__.strip("_"),
                got=", ".join(own)[:40] or "nothing",
                expected=f"{', '.join(wanted)[:40] or 'nothing'}: the same scene files",
            )
        return job.run(*job.arguments)


def _accept(order: Path) -> None:
    """Refuse a run that this worker is not like."""
    if order.name in _ACCEPTED:
        return
    try:
        facts = json.loads(order.read_text("utf-8"))
    except OSError:
        raise InputError(
            "a worker does not see the folder of results",
            file=order.parent,
            field="cache",
            expected="the same path everywhere",
        ) from None
    if driver() != facts["driver"]:
        raise InputError(
            "a worker draws with another OpenGL driver or browser",
            field="driver",
            got=driver(),
            expected=facts["driver"],
        )
    refuse_other_code(facts["told"], code_told(facts), since=_began())
    _ACCEPTED.add(order.name)


def _began() -> int:
    """When this process began, in nanoseconds since 1970."""
    import psutil  # comes with Dask

    return int(psutil.Process().create_time() * 1e9)
