"""New files and folders: they appear under their names when they are complete, and never replace another."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

from btfref.errors import InputError


def refuse_existing(path):
    """InputError when the path is taken."""
    if path.exists() or path.is_symlink():
        raise InputError("exists already", file=path, expected="a new name (or to overwrite)")


@contextmanager
def new_folder(out):
    """A folder to fill, which gets its name ``out`` when all is written; nothing is left behind otherwise.

    Raises
    ------
    InputError
        An existing path, or no folder to make it in.
    """
    out = Path(out)
    refuse_existing(out)
    if not out.absolute().parent.is_dir():
        raise InputError("no such folder", file=out.parent)
    temporary = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.absolute().parent))
    try:
        folder = temporary / "maps"
        folder.mkdir()
        yield folder
        os.replace(folder, out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
