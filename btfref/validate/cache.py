"""Results under names that say what they were made from: what has not changed is not computed again.

A key is the SHA-256 of everything that a result depends on: settings, the keys of its parents, versions, and the text
of the code behind it. A method's three files count for its own results only, so that work on one method leaves the
others' results valid; code that methods share counts for all.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from btfref.outputs import new_file


def folder():
    """Where results are kept: ``BTFREF_CACHE``, else btfref's part of the user's cache."""
    given = os.environ.get("BTFREF_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) if given else Path(base) / "btfref"


def key_of(facts):
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

    def __init__(self, root=None):
        self.root = Path(root) if root is not None else folder()

    def path(self, key, suffix):
        """Name of a result; its folder is there."""
        self.root.mkdir(parents=True, exist_ok=True)
        return (self.root / f"{key}{suffix}").resolve()

    def has(self, key, suffix):
        """Whether a result is there, complete."""
        return (self.root / f"{key}{suffix}").exists()

    def write(self, key, suffix, save):
        """Make a result by ``save(path)``; it appears under its name when it is complete.

        Returns
        -------
        pathlib.Path
        """
        path = self.path(key, suffix)
        with new_file(path) as draft:
            save(draft)
        return path
