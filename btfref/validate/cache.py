"""Results under names that say what they were made from: what has not changed is not computed again.

A key is the SHA-256 of everything that a result depends on: settings, the keys of its parents, versions, and the text
of the code behind it. A method's three files count for its own results only, so that work on one method leaves the
others' results valid; code that methods share counts for all.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.outputs import new_file

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


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
    """

    def __init__(self, root: PathLike | None = None) -> None:
        self.root = Path(root) if root is not None else folder()

    def path(self, key: str, suffix: str) -> Path:
        """Name of a result; its folder is there."""
        self.root.mkdir(parents=True, exist_ok=True)
        return (self.root / f"{key}{suffix}").resolve()

    def has(self, key: str, suffix: str) -> bool:
        """Whether a result is there, complete."""
        return (self.root / f"{key}{suffix}").exists()

    def write(self, key: str, suffix: str, save: Callable[[Path], object]) -> Path:
        """Make a result by ``save(path)``; it appears under its name when it is complete.

        Returns
        -------
        pathlib.Path
        """
        path = self.path(key, suffix)
        with new_file(path) as draft:
            save(draft)
        return path
