"""Who fills a store: this process, or the workers of a Dask cluster; the bytes are the same."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypedDict, TypeVar

from btfref.errors import InputError, MissingDependencyError
from btfref.platform import use_processors
from btfref.sampling.cluster.tasks import hand_out
from btfref.sampling.fill_views import fill_views
from btfref.sampling.memory import default_budget, peak
from btfref.sampling.store.layout import DRAFT
from btfref.sampling.store.store import open_store

if TYPE_CHECKING:
    import distributed

    from btfref.sampling.job import Job
    from btfref.sampling.paths.adaptive import Plan
    from btfref.sampling.store.selection import Selection
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Progress

#: Tasks per worker: enough that a slow or lost worker costs little, few enough that scenes are not built for nothing.
TASKS_PER_WORKER = 6

R = TypeVar("R")

#: One task at a time in a process: Mitsuba's threads use all that the worker may use.
LOCK = threading.Lock()


#: None, the name or the address of a cluster, or a client of one.
Scheduler: TypeAlias = "str | distributed.Client | None"


class Means(TypedDict):
    """What a worker is told: its budget in bytes, None for half of its machine's; its threads, None for as it is."""

    memory: int | None
    threads: int | None


def run(
    job: Job,
    store: BTFStore,
    views: Iterable[int],
    *,
    stage: str,
    only: Selection | None = None,
    plan: Plan | None = None,
    memory: int | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> int:
    """Fill views of a store; see `btfref.sampling.fill_views.fill_views`.

    Parameters
    ----------
    job, store, views, stage, only, plan
        As for `fill_views`.
    memory : int, optional
        Budget in bytes of this process and of all workers that it starts together, or of each worker of a
        cluster that runs elsewhere; by default half of the machine's memory.
    scheduler : None, str or distributed.Client
        None: this process. "dask": a local cluster. An address such as "tcp://10.0.0.1:8786", or a client: that
        cluster, whose workers must see the store under the same name and run the same versions.
    workers : int, optional
        Of a local cluster; by default one per two processors.
    progress : callable, optional
        Called as ``progress(done, total, label)`` after each view.

    Returns
    -------
    int
        Largest memory (bytes) of any process that worked.

    Raises
    ------
    InputError
        A budget that is too small, a scheduler that cannot be reached, or a worker that does not see the store.
    MissingDependencyError
        Dask is not installed.
    """
    views = [int(view) for view in views]
    total, finished = len(views), [0]

    def done(n: int) -> None:
        finished[0] += n
        if progress is not None:
            progress(finished[0], total, stage)

    if scheduler is None:
        memory = default_budget() if memory is None else memory
        fill_views(
            job, store, views, stage=stage, only=only, plan=plan, memory=memory, done=lambda view: done(1)
        )
        return peak()
    if not views:
        return peak()
    with cluster(scheduler, workers, memory) as (client, settings):
        return max(peak(), _distribute(client, job, store, views, stage, only, plan, settings, done))


@contextlib.contextmanager
def cluster(
    scheduler: Scheduler, workers: int | None, memory: int | None
) -> Iterator[tuple[distributed.Client, Means]]:
    """A client, and what its workers are told: budget and threads of each."""
    try:
        import distributed
    except ImportError:
        raise MissingDependencyError(
            "Dask is not installed, which a scheduler needs", "pip install 'btfref[distributed]'"
        ) from None
    import logging

    if isinstance(scheduler, distributed.Client):
        yield scheduler, {"memory": memory, "threads": None}
        return
    if scheduler == "dask":
        cores, count = processors(), local_workers(workers)
        budget = default_budget() if memory is None else memory
        with (
            distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # any free port: clusters may stand side by side
                memory_limit=0,  # the budget is kept by what is made together, not by killing
                silence_logs=logging.CRITICAL,
            ) as local,
            distributed.Client(local) as client,
        ):
            yield client, {"memory": budget // count, "threads": max(1, cores // count)}
        return
    if not isinstance(scheduler, str) or "://" not in scheduler:
        raise InputError(
            "scheduler",
            field="scheduler",
            got=repr(scheduler),
            expected="dask, or an address such as tcp://…",
        )
    with _silent_logs():
        try:
            client = distributed.Client(scheduler, timeout=20)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError("cannot reach the scheduler", field="scheduler", got=scheduler) from error
        with client:
            yield client, {"memory": memory, "threads": None}


def processors() -> int:
    """Processors that this process may use."""
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def local_workers(workers: int | None) -> int:
    """Workers of a local cluster: as many as are asked for, or one per two processors.

    Raises
    ------
    InputError
        Fewer than one.
    """
    count = max(1, processors() // 2) if workers is None else int(workers)
    if count < 1:
        raise InputError("workers of a local cluster", field="workers", got=workers, expected="at least 1")
    return count


@contextlib.contextmanager
def _silent_logs() -> Iterator[None]:
    """Dask's own lines about connections are left out: what they come to is an error of ours."""
    import logging

    handlers = [(handler, handler.level) for handler in logging.getLogger("distributed").handlers]
    for handler, _ in handlers:
        handler.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for handler, level in handlers:
            handler.setLevel(level)


def _distribute(
    client: distributed.Client,
    job: Job,
    store: BTFStore,
    views: list[int],
    stage: str,
    only: Selection | None,
    plan: Plan | None,
    settings: Means,
    done: Callable[[int], None],
) -> int:
    """Hand the views out."""
    refuse_other_versions(client)
    count = max(1, len(client.nthreads()))
    if job.settings.estimator == "surface":
        # Points and their walks serve all views of a task: as few tasks as there are workers.
        size = -(-len(views) // count)
    else:
        size = max(1, len(views) // (count * TASKS_PER_WORKER))
    # Beside the store, where workers must be able to read anyway: what one process holds may be lost with it.
    order = store.path.with_name(f"{store.path.name}.job{DRAFT}")
    from btfref.sampling.job_file import write_job

    write_job(order, job, only, plan)
    pieces = [views[first : first + size] for first in range(0, len(views), size)]
    try:
        path = str(store.path.resolve())
        return hand_out(
            client,
            _work,
            [(str(order.resolve()), path, part, stage, settings) for part in pieces],
            store.path,
            done,
        )
    finally:
        order.unlink(missing_ok=True)


def refuse_other_versions(client: distributed.Client) -> None:
    """InputError for a worker of another btfref; those that join later are told by the job's file."""
    from btfref.provenance import __version__

    for worker, version in asked_of_all(client, _version).items():
        if version != __version__:
            raise InputError(
                f"a worker of another version ({worker})", field="btfref", got=version, expected=__version__
            )


def asked_of_all(client: distributed.Client, question: Callable[[], R]) -> dict[str, R]:
    """Answers of all workers to a function of a module, by their addresses.

    Raises
    ------
    InputError
        A worker that has no such function: one of another btfref.
    """
    from btfref.provenance import __version__

    try:
        return client.run(question)
    except (AttributeError, ImportError) as error:
        raise InputError(
            "a worker of another version", field="btfref", got=f"{error}", expected=__version__
        ) from None


def _version() -> str:
    """Version of the worker's btfref."""
    from btfref.provenance import __version__

    return __version__


def _work(order: str, path: str, views: list[int], stage: str, settings: Means) -> tuple[int, int]:
    """What a worker does: fill its views; the number of views and the worker's largest memory."""
    from distributed import get_worker

    from btfref.sampling.job_file import read_job

    with LOCK:
        if not Path(order).is_file():
            raise InputError(
                "a worker does not see the folder of the store",
                file=path,
                expected="the same path everywhere",
            )
        job, only, plan = read_job(order)
        if not Path(path).is_dir():
            raise InputError(
                "a worker does not see the store", file=path, expected="the same path everywhere"
            )
        store = open_store(path)
        use_threads(job.settings.variant, settings["threads"] or get_worker().state.nthreads)
        memory = default_budget() if settings["memory"] is None else settings["memory"]
        fill_views(
            job,
            store,
            job.unfinished(store, views, stage, only),
            stage=stage,
            only=only,
            plan=plan,
            memory=memory,
        )
        return len(views), peak()


def use_threads(variant: str, threads: int) -> None:
    """Tell Dr.Jit how many threads this worker may use."""
    from btfref.sampling.variant import mitsuba_variant

    with mitsuba_variant(variant):
        use_processors(threads)
