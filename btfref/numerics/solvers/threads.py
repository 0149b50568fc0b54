"""Threads of the linear algebra libraries, and results that do not depend on how many there are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import TypeVar

import numpy as np

T = TypeVar("T")

#: Threads that :func:`in_parallel` may use: those of BLAS before :func:`reproducible` took them.
_WORKERS: ContextVar[int] = ContextVar("_WORKERS", default=1)

#: And these threads themselves: a pass over many small blocks would spend its time on starting them.
_POOL: ContextVar[ThreadPoolExecutor | None] = ContextVar("_POOL", default=None)

#: Rows, or columns, of a block of :func:`product`: enough for a BLAS call to be worth it; the same on all machines.
BLOCK = 512


def one_blas_thread() -> AbstractContextManager[object]:
    """Context in which BLAS and LAPACK use one thread.

    For long sequences of small products and factorizations: their threads would spend more time waiting for each
    other than working, and on a busy machine a hundred times more.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")


@contextmanager
def reproducible(workers: int | None = None) -> Iterator[None]:
    """Context, or decorator, in which results do not depend on the number of threads: the same seed, the same bytes.

    BLAS, LAPACK and OpenMP split sums by their threads, and a sum in another order rounds differently: iterations carry
    that on. Here they use one thread each; large products keep the others through :func:`product`, which splits what is
    independent, in the same blocks on every machine. Libraries that are loaded inside of the context are not reached:
    enter it again behind their import.

    Parameters
    ----------
    workers : int, optional
        Threads of :func:`product` and :func:`in_parallel`; by default those that BLAS had.
    """
    import scipy.linalg  # noqa: F401 - it brings a BLAS of its own, which must be there to be limited
    from threadpoolctl import ThreadpoolController

    libraries = ThreadpoolController()  # it looks through what is loaded, which takes milliseconds: once
    threads = [library["num_threads"] for library in libraries.info() if library["user_api"] == "blas"]
    token = _WORKERS.set(max(_WORKERS.get(), *threads, 1) if workers is None else workers)
    outer = _POOL.get()
    pool = outer or ThreadPoolExecutor(_WORKERS.get())
    of_pool = _POOL.set(pool)
    try:
        with libraries.limit(limits=1):
            yield
    finally:
        _WORKERS.reset(token)
        _POOL.reset(of_pool)
        if outer is None:
            pool.shutdown()


def in_parallel(action: Callable[[T], object], items: Iterable[T]) -> None:
    """Do something for each of some items, on several threads within :func:`reproducible`.

    Parameters
    ----------
    action : callable
        Independent of the other items, so that the number of threads makes no difference.
    items : iterable
    """
    todo, pool = list(items), _POOL.get()
    if pool is None or min(_WORKERS.get(), len(todo)) <= 1:
        for item in todo:
            action(item)
    else:
        list(pool.map(action, todo))


def product(a: np.ndarray, b: np.ndarray, *, rows: int = BLOCK) -> np.ndarray:
    """``a @ b`` in blocks of rows of ``a``, or of columns of ``b`` where there are more, on several threads.

    Parameters
    ----------
    a, b : ndarray, shapes (n, k), (k, m)
    rows : int
        Rows, or columns, of a block.

    Returns
    -------
    ndarray, shape (n, m)
        Within :func:`reproducible` the same to the last bit, whatever the number of threads.
    """
    n, m = len(a), b.shape[1]
    result = np.zeros((n, m), np.result_type(a, b))
    tall = n >= m

    def block(start: int) -> None:
        part = slice(start, start + rows)
        if tall:
            np.matmul(a[part], b, out=result[part])
        else:
            # Contiguous, so that no part is copied and no path through BLAS depends on strides.
            result[:, part] = a @ np.ascontiguousarray(b[:, part])

    in_parallel(block, range(0, n if tall else m, rows))
    return result
