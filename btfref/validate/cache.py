"""Results under names that say what they were made from: what has not changed is not computed again.

A key is the SHA-256 of everything that a result depends on: settings, the keys of its parents, and the code, data and
versions behind it (:mod:`btfref.provenance.code`). Beside each entry lies its seal, a hash of its bytes: an entry that
is empty, cut or edited does not fit it, and is made again. An entry holds measurements and pictures, never a verdict.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.outputs import new_file
from btfref.provenance import code

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Ending of the files that hold seals.
SEAL = ".sha256"


def folder() -> Path:
    """Where results are kept: ``BTFREF_CACHE``, else btfref's part of the user's cache."""
    given = os.environ.get("BTFREF_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) if given else Path(base) / "btfref"


def key_of(facts: Facts) -> str:
    """A key from JSON-able facts; equal facts, equal key."""
    text = json.dumps(facts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


class Cache:
    """Results in a folder.

    Parameters
    ----------
    root : path-like, optional
        Default: `folder`.

    Attributes
    ----------
    computed : int
        Results that this object made, since they were not there as they should be.
    """

    def __init__(self, root: PathLike | None = None) -> None:
        self.root = Path(root) if root is not None else folder()
        self.computed = 0
        self._whole: set[Path] = set()

    def path(self, key: str, suffix: str) -> Path:
        """Name of a result; its folder is there."""
        self.root.mkdir(parents=True, exist_ok=True)
        return (self.root / f"{key}{suffix}").resolve()

    def has(self, key: str, suffix: str) -> bool:
        """Whether a result is there, byte for byte as it was made."""
        path = (self.root / f"{key}{suffix}").resolve()
        if path not in self._whole and _sealed(path):
            self._whole.add(path)
        return path in self._whole

    def get(self, key: str, suffix: str, save: Callable[[Path], object]) -> Path:
        """A result, made by ``save(path)`` unless it is there.

        Returns
        -------
        pathlib.Path
            A file, or a folder where `save` makes one.
        """
        return self.path(key, suffix) if self.has(key, suffix) else self.write(key, suffix, save)

    def write(self, key: str, suffix: str, save: Callable[[Path], object]) -> Path:
        """Make a result by ``save(path)``; it appears under its name when it is complete.

        It gets no seal, and counts for this object alone, when code has changed since it was read for the key.

        Returns
        -------
        pathlib.Path
        """
        path = self.path(key, suffix)
        self.computed += 1
        seal = path.with_name(path.name + SEAL)
        _remove(seal)
        with new_file(path) as draft:
            save(draft)
            value = None if code.changed() else digest(draft, path.name)
            if path.is_dir() or draft.is_dir():  # only files take each other's place
                _remove(path)
        if value is not None:
            with new_file(seal) as draft:
                draft.write_text(value, "utf-8")
        self._whole.add(path)
        return path


def digest(path: Path, name: str) -> str:
    """SHA-256 of a name and of a file's bytes, or of the names and bytes of all files in a folder.

    Returns
    -------
    str
    """
    found = hashlib.sha256(f"{name}\0".encode())
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, lambda: found).hexdigest()
    for inner in sorted(p for p in path.rglob("*") if p.is_file()):
        found.update(f"{inner.relative_to(path).as_posix()}\0{digest(inner, '')}\0".encode())
    return found.hexdigest()


def _sealed(path: Path) -> bool:
    """Whether an entry fits its seal."""
    try:
        value = path.with_name(path.name + SEAL).read_text("ascii")
        return value == digest(path, path.name)
    except (OSError, UnicodeDecodeError):
        return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
