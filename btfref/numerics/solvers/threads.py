"""Threads of the linear algebra libraries."""

from __future__ import annotations

from contextlib import AbstractContextManager


def one_blas_thread() -> AbstractContextManager[object]:
    """Context in which BLAS and LAPACK use one thread.

    For long sequences of small products and factorizations: their threads would spend more time waiting for each
    other than working, and on a busy machine a hundred times more.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")
