"""One writer of a store at a time.

The lock is one of the system's on a small file beside the store, so that it ends with the process, however that ends;
the file itself means nothing, and whoever comes next removes it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from btfref.errors import InputError
from btfref.sampling.store.layout import LOCK
from btfref.types import PathLike


@contextlib.contextmanager
def writing(path: PathLike) -> Iterator[None]:
    """Hold the store of that name against other processes.

    Parameters
    ----------
    path : path-like
        The store; it need not exist.

    Raises
    ------
    InputError
        Another process writes it; says which.
    """
    path = Path(path)
    name = path.with_name(path.name + LOCK)
    number = None
    try:
        number = _locked(name, path)
        yield
    finally:
        if number is not None:
            # Removed while it is held: who waits for it finds another file, or none, and makes its own.
            with contextlib.suppress(OSError):
                os.unlink(name)
            os.close(number)


def _locked(name: Path, store: Path) -> int | None:
    """A descriptor of the locked file; None in a place where nothing can be written anyway."""
    while True:
        try:
            number = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            if error.errno in (errno.EROFS, errno.EACCES, errno.ENOENT, errno.ENOTDIR):
                return None
            raise
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            writer = os.read(number, 200).decode("utf-8", "replace").strip()
            os.close(number)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                return None  # a file system without locks
            raise InputError(
                "another process writes this store",
                file=store,
                got=writer or "one that has just begun",
                expected="that it ends first",
            ) from None
        with contextlib.suppress(FileNotFoundError):
            if os.stat(name).st_ino == os.fstat(number).st_ino:
                break
        os.close(number)
    os.ftruncate(number, 0)
    os.write(number, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
    return number
