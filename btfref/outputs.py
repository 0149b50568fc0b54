"""New files and folders: they appear under their names when they are complete, and nothing is left behind otherwise."""

from __future__ import annotations

import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from btfref.errors import InputError
from btfref.types import PathLike


def refuse_existing(path: PathLike) -> None:
    """InputError when the path is taken."""
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise InputError("exists already", file=path, expected="a new name (or to overwrite)")


def require_folder_of(path: PathLike) -> None:
    """InputError when the folder that a file or folder belongs in is not there."""
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise InputError("no such folder", file=path.parent)


@contextmanager
def new_file(out: PathLike) -> Iterator[Path]:
    """A name to write a file under, which becomes ``out`` when all is written, in place of an older file.

    The file has the permissions that the user's umask gives to new files.

    Parameters
    ----------
    out : path-like

    Yields
    ------
    pathlib.Path
        The last part is that of ``out``, for writers that look at endings.

    Raises
    ------
    InputError
        No folder to make it in.
    """
    with _draft(Path(out)) as draft:
        yield draft
        os.replace(draft, out)


@contextmanager
def new_folder(out: PathLike) -> Iterator[Path]:
    """A folder to fill, which gets its name ``out`` when all is written.

    Parameters
    ----------
    out : path-like

    Yields
    ------
    pathlib.Path

    Raises
    ------
    InputError
        An existing path, or no folder to make it in.
    """
    refuse_existing(out)
    with _draft(Path(out)) as draft:
        draft.mkdir()
        yield draft
        os.replace(draft, out)


@contextmanager
def _draft(out: Path) -> Iterator[Path]:
    """The name of ``out`` in a temporary folder beside it: on the same disk, so that it can be renamed."""
    require_folder_of(out)
    parent = out.absolute().parent
    _remove_abandoned(out.name, parent)
    prefix = f".{out.name}.{_HOST}-{os.getpid()}-"
    folder = tempfile.mkdtemp(prefix=prefix, suffix=".partial", dir=parent)
    try:
        yield Path(folder, out.name)
    except OSError as error:
        # Of the draft, whose name nobody knows, or of a stream without one: a full disk, say.
        if error.errno is None or not (error.filename is None or str(error.filename).startswith(folder)):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(out)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


#: Name of this machine as it stands in names of drafts.
_HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())[:32] or "host"


def _remove_abandoned(name: str, parent: Path) -> None:
    """Remove drafts of an output that processes of this machine have left which are no more: they were killed."""
    pattern = re.compile(rf"\.{re.escape(name)}\.{_HOST}-(\d+)-\w+\.partial")
    for draft in parent.iterdir():
        found = pattern.fullmatch(draft.name)
        if found is None:
            continue
        try:
            os.kill(int(found[1]), 0)
        except ProcessLookupError:
            shutil.rmtree(draft, ignore_errors=True)
        except (OSError, OverflowError):
            continue
