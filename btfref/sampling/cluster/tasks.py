"""Pieces of work for the workers of a Dask cluster: what a lost worker had not finished goes to another."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from btfref.errors import InputError

if TYPE_CHECKING:
    import distributed

R = TypeVar("R")


def hand_out(
    client: distributed.Client,
    work: Callable[..., tuple[int, int]],
    pieces: Sequence[tuple[object, ...]],
    path: Path,
    done: Callable[[int], None],
) -> int:
    """Give workers their pieces and wait for all; what a lost worker had not finished goes to another.

    Parameters
    ----------
    client : distributed.Client
    work : callable
        Of a module, called with a piece's arguments; tells how much it has made and its largest memory.
    pieces : list of tuple
    path : Path
        What is written, for messages.
    done : callable
        Called with what a piece has made.

    Returns
    -------
    int
        Largest memory (bytes) of a worker.

    Raises
    ------
    InputError
        Workers or the scheduler are lost.
    """
    largest = 0
    for count, used in results(client, work, pieces, path):
        largest = max(largest, used)
        done(count)
    return largest


def results(
    client: distributed.Client, work: Callable[..., R], pieces: Iterable[tuple[object, ...]], path: Path
) -> Iterator[R]:
    """What workers make of their pieces, as it comes; what a lost worker had not finished goes to another.

    Parameters
    ----------
    client, work, pieces, path
        See `hand_out`, for any result.

    Yields
    ------
    object

    Raises
    ------
    InputError
        Workers or the scheduler are lost.
    """
    import distributed

    tasks = [client.submit(work, *piece, pure=False, retries=2) for piece in pieces]
    with lost_in_one_line(path):
        try:
            for future in distributed.as_completed(tasks):
                yield future.result()
        finally:
            with contextlib.suppress(Exception):  # a cluster that is gone cannot be told
                client.cancel(tasks)


def one_a_machine(
    client: distributed.Client, work: Callable[..., R], pieces: Sequence[tuple[object, ...]], path: Path
) -> Iterator[tuple[int, R]]:
    """What workers make of their pieces, no two of them on one machine at a time: for what is timed.

    Parameters
    ----------
    client, work, pieces, path
        See `hand_out`, for any result. Where a worker is lost, its piece may come to another one's machine: `work`
        must wait there for a lock of the machine's.

    Yields
    ------
    int, object
        Number of the piece and what was made of it, as it comes.

    Raises
    ------
    InputError
        Workers or the scheduler are lost.
    """
    import distributed

    waiting = deque(enumerate(pieces))
    running: dict[distributed.Future, tuple[str, int]] = {}
    with lost_in_one_line(path):
        try:
            while waiting or running:
                client.wait_for_workers(1, timeout=60)
                for address, facts in client.scheduler_info(n_workers=-1)["workers"].items():
                    busy = {machine for machine, _ in running.values()}
                    if waiting and facts["host"] not in busy:
                        number, piece = waiting.popleft()
                        task = client.submit(
                            work, *piece, pure=False, retries=2, workers=[address], allow_other_workers=True
                        )
                        running[task] = facts["host"], number
                if running:
                    for task in distributed.wait(list(running), return_when="FIRST_COMPLETED").done:
                        _, number = running.pop(task)
                        yield number, task.result()
        finally:
            with contextlib.suppress(Exception):  # a cluster that is gone cannot be told
                client.cancel(list(running))


@contextlib.contextmanager
def lost_in_one_line(path: Path) -> Iterator[None]:
    """InputError for what Dask says when workers or the scheduler are lost.

    Parameters
    ----------
    path : Path
        What is worked on, for messages.
    """
    import distributed
    from distributed.comm.core import CommClosedError

    try:
        yield
    except distributed.scheduler.KilledWorker as error:
        raise InputError(
            "workers were lost again and again; start the same command again to go on",
            file=path,
            got=str(error).partition("\n")[0],
        ) from None
    except (distributed.CancelledError, CommClosedError, TimeoutError) as error:
        raise InputError(
            "the scheduler is gone; start the same command again to go on",
            file=path,
            field="scheduler",
            got=f"{type(error).__name__} {error}".partition("\n")[0],
        ) from None
