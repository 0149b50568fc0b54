"""What a worker does for a plan: build an entry and save it, timed; or answer queries with what was built, untimed."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench import measures
from btfref.bench.subjects import Built, build
from btfref.bench.timing import machine
from btfref.errors import InputError
from btfref.platform import use_processors
from btfref.provenance.told import accepted

if TYPE_CHECKING:
    from btfref.bench.plan import Entry
    from btfref.sampling import SampledBTF
    from btfref.types import Facts


def processors_there() -> int:
    """Processors that a worker may use."""
    from btfref.sampling.scheduling import processors

    return processors()


def built(
    order: str, entry: Entry, btf: str, attributes: Facts, seed: int, payload: int | None, folder: str
) -> tuple[Facts, str]:
    """Build an entry with all processors of the machine, alone among the tasks of btfref on it.

    Parameters
    ----------
    order : str
        File of the run: see `btfref.provenance.told.order`.
    entry : Entry
        A method, no peer.
    btf : str
        A store.
    attributes : dict
        Of the BTF, as who asks has it.
    seed, payload
        See `btfref.bench.subjects.build`.
    folder : str
        For the file.

    Returns
    -------
    record : dict
        See `btfref.bench.measures.timed_builds`; and ``worker``, what the times depend on.
    file : str

    Raises
    ------
    InputError
        The worker does not see the files, or runs other code.
    """
    import distributed

    from btfref.sampling import SampledBTF
    from btfref.sampling.scheduling import processors

    count, name = processors(), platform.node()
    with distributed.Lock(f"btfref: times on {name}"), _accepted(order, count):
        there = _loaded(_seen(btf))
        values = SampledBTF(there.values, there.views, there.lights, None, attributes, there.path)
        made, records = measures.timed_builds(
            {entry.name: lambda _: build(entry, values, seed=seed, payload=payload)}, 1
        )
        path = measures.saved(made[entry.name], entry, _seen(folder))
        worker = {"name": name, "processors": count, **machine()}
        return {**records[entry.name], "worker": worker}, str(path)


def answered(order: str, name: str, kind: str, file: str, queries: str, out: str, threads: int | None) -> str:
    """Answer queries with a representation.

    Parameters
    ----------
    order : str
        As of `built`.
    name : str
        Of the entry.
    kind : str
        "error": of a BTF's entries; "off_grid": of rows at directions that nobody fitted.
    file : str
        A representation.
    queries : str
        File of arrays, as :mod:`btfref.bench.matrix` keeps them.
    out : str
        File for the answers.
    threads : int or None
        None for as many as Dask gave the worker.

    Returns
    -------
    str
        The name.

    Raises
    ------
    InputError
        The worker does not see the files, or runs other code.
    """
    from distributed import get_worker

    from btfref.querying import off_grid
    from btfref.representations import load

    with _accepted(order, threads or int(get_worker().state.nthreads)):
        made = load(_seen(file))
        with np.load(_seen(queries)) as arrays:
            if kind == "error":
                found = made.evaluate(arrays["uv"], arrays["w_light"], arrays["w_view"])
            else:
                found = measures.off_grid_answers(Built(made.evaluate, 0, made), off_grid.unpacked(arrays))
        np.save(out, np.asarray(found, np.float32))
        return name


@contextmanager
def _accepted(order: str, threads: int) -> Iterator[None]:
    """The worker's turn, with so many threads, if it runs the code that is asked for."""
    from threadpoolctl import threadpool_limits

    from btfref.sampling.scheduling import LOCK

    with LOCK, threadpool_limits(threads):
        accepted(order)
        if "drjit" in sys.modules:
            use_processors(threads)
        yield


def _seen(path: str) -> Path:
    """A file or folder that this worker must see."""
    if not Path(path).exists():
        raise InputError("a worker does not see a file", file=path, expected="the same path everywhere")
    return Path(path)


@lru_cache(maxsize=1)
def _loaded(path: Path) -> SampledBTF:
    """A sampled BTF, kept for the next builds."""
    from btfref.sampling import SampledBTF

    return SampledBTF.load(path, variance=False)
