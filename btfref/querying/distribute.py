"""Queries made by the workers of a Dask cluster; the bytes are those of one process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.mesostructure import Mesostructure
from btfref.sampling.cluster.tasks import hand_out
from btfref.sampling.scheduling import TASKS_PER_WORKER, cluster, refuse_other_versions
from btfref.sampling.store.layout import DRAFT

if TYPE_CHECKING:
    from btfref.querying.files.zarr_file import QueryFile
    from btfref.querying.job import QueryJob
    from btfref.sampling.scheduling import Means, Scheduler


def distribute(
    job: QueryJob,
    file: QueryFile,
    chunks: list[int],
    scheduler: Scheduler,
    workers: int | None,
    done: Callable[[int], None],
) -> None:
    """Fill chunks of a file.

    Parameters
    ----------
    job : QueryJob
        Of geometry.
    file : QueryFile
    chunks : list of int
    scheduler, workers
        See `btfref.sampling.scheduling.run`.
    done : callable
        Called with each chunk.

    Raises
    ------
    InputError, MissingDependencyError
        See `btfref.sampling.scheduling.run`.
    """
    if not chunks:
        return
    order = file.path.with_name(f"{file.path.name}.job{DRAFT}")
    with cluster(scheduler, workers, None) as (client, means):
        refuse_other_versions(client)
        _write(order, job)
        count = max(1, len(client.nthreads()))
        size = max(1, len(chunks) // (count * TASKS_PER_WORKER))
        pieces = [chunks[first : first + size] for first in range(0, len(chunks), size)]
        names = str(order.resolve()), str(file.path.resolve())
        left = iter(chunks)

        def some(number: int) -> None:
            for _ in range(number):
                done(next(left))

        try:
            hand_out(client, work, [(*names, piece, means) for piece in pieces], file.path, some)
        finally:
            order.unlink(missing_ok=True)


def _write(path: Path, job: QueryJob) -> None:
    from btfref.provenance import __version__
    from btfref.sampling.job_file import mesostructure_facts, write_facts

    assert isinstance(job.source, Mesostructure)
    settings = {name: getattr(job.settings, name) for name in job.settings.names()}
    write_facts(
        path,
        {
            "btfref": __version__,
            "versions": job.attributes["versions"],
            "settings": settings,
            "stream": job.stream,
            "mesostructure": mesostructure_facts(job.source),
        },
    )


def read_order(path: Path) -> QueryJob:
    """The job of a file that a worker was given.

    Raises
    ------
    InputError
        Not such a file, or one of another version than this process's libraries.
    """
    from btfref.querying.job import QueryJob
    from btfref.querying.settings import QuerySettings
    from btfref.sampling.job_file import mesostructure_of, read_facts, refuse_other_versions

    try:
        data = read_facts(path)
        job = QueryJob(
            mesostructure_of(data["mesostructure"]), QuerySettings(**data["settings"]), stream=data["stream"]
        )
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("not the job of queries", file=path, got=error) from error
    refuse_other_versions(job.attributes, data)
    return job


def work(order: str, path: str, chunks: list[int], means: Means) -> tuple[int, int]:
    """What a worker does: make its chunks; their number and the worker's largest memory."""
    from distributed import get_worker

    from btfref.querying.files.zarr_file import QueryFile
    from btfref.sampling.memory import peak
    from btfref.sampling.scheduling import LOCK, use_threads

    with LOCK:
        for name in (order, path):
            if not Path(name).exists():
                raise InputError(
                    "a worker does not see the folder of the file",
                    file=path,
                    expected="the same path everywhere",
                )
        job, file = read_order(Path(order)), QueryFile(path)
        use_threads(job.settings.variant, means["threads"] or get_worker().state.nthreads)
        there = file.coverage
        job.fill(file, [chunk for chunk in chunks if not there[chunk]])
        return len(chunks), peak()
