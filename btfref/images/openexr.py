"""The OpenEXR library behind a wall: what it says stays here, what it fails at is an error.

Its binding prints warnings of what it could not read and goes on, and its core writes to standard error by itself. Both
are caught, so that a terminal sees one line of ours alone and half a picture is never taken for a whole one.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfref.types import PathLike

#: File descriptors belong to the process: one at a time.
_LOCK = threading.Lock()

#: What a system says of a file that cannot be written, in the library's own words.
_SYSTEM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO)


@contextlib.contextmanager
def caught() -> Iterator[list[str]]:
    """What is written to standard output and error inside, by Python or by a library, as a list of lines.

    Yields
    ------
    list of str
        Filled when the block is left.
    """
    lines: list[str] = []
    printed = io.StringIO()
    with _LOCK, tempfile.TemporaryFile() as sink:
        kept: list[tuple[int, int]] = []
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
        for number in (1, 2):
            with contextlib.suppress(OSError):  # closed by whoever started us
                kept.append((number, os.dup(number)))
                os.dup2(sink.fileno(), number)
        try:
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                yield lines
        finally:
            for number, own in kept:
                os.dup2(own, number)
                os.close(own)
            sink.seek(0)
            text = printed.getvalue() + sink.read().decode("utf-8", "replace")
            lines += [line.strip() for line in text.splitlines() if line.strip()]


@contextlib.contextmanager
def opened(path: PathLike, **options: Any) -> Iterator[Any]:
    """A file as ``OpenEXR.File`` reads it, or an error.

    Parameters
    ----------
    path : path-like
    **options
        Of ``OpenEXR.File``.

    Yields
    ------
    OpenEXR.File

    Raises
    ------
    RuntimeError
        Whatever the library says that it cannot read.
    """
    import OpenEXR

    with caught() as lines:
        file = OpenEXR.File(str(path), **options)
    if lines:
        raise RuntimeError(lines[0].removeprefix("Warning: "))
    with file:
        yield file


def write(parts: Any, path: PathLike, channels: Any = None) -> None:
    """Write parts, or the header and the channels of a single one.

    Parameters
    ----------
    parts : list of OpenEXR.Part or dict
        A dict is the header of a single part.
    path : path-like
    channels : dict, optional
        Of a single part.

    Raises
    ------
    OSError
        What the system refuses: no space left, a read-only place.
    """
    import OpenEXR

    try:
        with caught():
            file = OpenEXR.File(parts) if channels is None else OpenEXR.File(parts, channels)
            file.write(str(path))
    except RuntimeError as error:
        code = next((code for code in _SYSTEM if os.strerror(code) in str(error)), errno.EIO)
        raise OSError(code, os.strerror(code), str(path)) from error
