"""Results under names that say what they were made from: what has not changed is not computed again.

A key is the SHA-256 of everything that a result depends on: settings, the keys of its parents, versions, and the text
of the code behind it. A method's three files count for its own results only, so that work on one method leaves the
others' results valid; code that methods share counts for all.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import tempfile
from functools import cache as remembered
from pathlib import Path

from btfref.platform import shader_directory
from btfref.registry import methods
from btfref.versions import versions

#: Stage → the code that its results depend on, besides that of the stages before: folders and files of the packages.
CODE = {
    "material": (
        "btfref/numerics",
        "btfref/mesostructure",
        "btfref/sampling",
        "btfref/conventions.py",
        "btfref/validate/material.py",
    ),
    "fit": ("btfref/representations", "btfref/decomposition"),
    "picture": (
        "btfref/render",
        "btfref/scenes",
        "btfref/compare",
        "btfref/validate",
        "mitsuba_plugins",
        "shaders",
    ),
}

#: Stages that a stage builds upon.
BEFORE = {"material": (), "fit": ("material",), "picture": ("material", "fit")}


def folder():
    """Where results are kept: ``BTFREF_CACHE``, else btfref's part of the user's cache."""
    given = os.environ.get("BTFREF_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) if given else Path(base) / "btfref"


def key_of(facts):
    """A key from JSON-able facts; equal facts, equal key."""
    text = json.dumps(facts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@remembered
def code_of(stage, method=None):
    """Hash of the code that results of a stage depend on.

    Parameters
    ----------
    stage : {"material", "fit", "picture"}
    method : str, optional
        Registry key: its three files count, those of other methods never do.

    Returns
    -------
    str
    """
    owned = {path for row in methods().values() for path in method_files(row)}
    stages = (*BEFORE[stage], stage)
    files = [path for name in stages for place in CODE[name] for path in _files(place) if path not in owned]
    if method is not None:
        files += method_files(methods()[method])
    digest = hashlib.sha256()
    for path in sorted(set(files)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    digest.update(json.dumps(versions(), sort_keys=True).encode())
    return digest.hexdigest()


def method_files(row):
    """Files of a method: fit module, Dr.Jit port, GLSL port; all of its package where that is a third party's."""
    found = []
    for module in (row.module, row.plugin):
        place = Path(importlib.util.find_spec(module).origin)
        if module.split(".")[0] in ("btfref", "mitsuba_plugins"):
            found.append(place)
        else:
            top = importlib.util.find_spec(module.split(".")[0])
            roots = list(top.submodule_search_locations or [])
            found += [p for root in roots for p in Path(root).rglob("*") if _is_code(p)] or [place]
    if not row.shader_package:
        found.append(shader_directory() / row.shader)
    return [path.resolve() for path in found]


def _files(place):
    packages = Path(__file__).resolve().parents[2]
    root = shader_directory() if place == "shaders" else packages / place
    return (
        [root.resolve()] if root.is_file() else [p.resolve() for p in sorted(root.rglob("*")) if _is_code(p)]
    )


def _is_code(path):
    return path.suffix in (".py", ".glsl", ".vert", ".frag", ".toml", ".xml", ".ply", ".csv")


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
        handle, temporary = tempfile.mkstemp(dir=self.root, prefix=f".{key}.", suffix=suffix)
        os.close(handle)
        try:
            save(Path(temporary))
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
        return path
