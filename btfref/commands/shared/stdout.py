"""Standard output belongs to what a command emits; what libraries print on it goes to standard error."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from typing import TextIO

#: Where commands write while one runs.
_own: list[TextIO] = []


def stdout() -> TextIO:
    """Standard output as the command's caller sees it."""
    return _own[-1] if _own else sys.stdout


@contextlib.contextmanager
def own_stdout(*, restore: bool = True) -> Iterator[TextIO]:
    """Keep standard output for `stdout`: other writers, in Python or below it, write to standard error.

    Parameters
    ----------
    restore : bool
        Whether to give standard output back at the end; a process that ends then lets no library's last words there.

    Yields
    ------
    file
    """
    before = sys.stdout
    if before is None or sys.stderr is None:  # a process without them
        yield before
        return
    before.flush()
    saved = _kept(1)
    # A caller that put another object there (a test, a notebook) reads that.
    ours = before if saved is None or _number(before) != 1 else _reopened(saved, before)
    if saved is not None:
        os.dup2(2, 1)
    _own.append(ours)
    sys.stdout = sys.stderr
    try:
        yield ours
        ours.flush()
    except BrokenPipeError:
        # The reader (head, less) has left: what is still to be written goes nowhere, without a complaint.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), ours.fileno())
        raise
    finally:
        _own.pop()
        if restore:
            sys.stdout = before
            if saved is not None:
                # What C and C++ have not written yet belongs where they wrote before.
                ctypes.CDLL(None).fflush(None)
                os.dup2(saved, 1)
                if ours is before:
                    os.close(saved)
                else:
                    ours.close()


def _kept(number: int) -> int | None:
    """A copy of a file descriptor; None where it, or standard error, is closed."""
    try:
        os.fstat(2)
        return os.dup(number)
    except OSError:
        return None


def _number(stream: TextIO) -> int | None:
    try:
        return stream.fileno()
    except (OSError, ValueError, AttributeError):
        return None


def _reopened(number: int, like: TextIO) -> TextIO:
    return open(
        number,
        "w",
        encoding=like.encoding,
        errors=like.errors,
        buffering=1 if like.isatty() else -1,
    )
