"""The files that a scene is made of: itself, what it includes, what it names."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from btfref.scene.parameters import filled, nodes
from btfref.scene.shipped import scene_file

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


def digest_of(path: PathLike) -> str:
    """SHA-256 of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def scene_files(scene: PathLike, parameters: Mapping[str, str] | None = None) -> list[Path]:
    """The files of a scene.

    Parameters
    ----------
    scene : path-like
        A Mitsuba scene file, or the name of a shipped scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.

    Returns
    -------
    list of pathlib.Path
        The scene first, then sorted: what it includes, and every file that one of its values names, in the current
        directory, beside the file with that value, or in one of the scene's own search paths. Of a file that cannot be
        read as XML itself alone.
    """
    file, given = scene_file(scene), dict(parameters or {})
    values: dict[str, str] = {}
    found: set[Path] = set()
    named: set[tuple[Path, str]] = set()
    searched = {Path()}
    try:
        for path, node in nodes(file, values, given):
            found.add(path)
            if node.tag == "default":
                continue
            texts = [filled(text, values | given) for text in node.attrib.values()]
            named.update((path.parent, text) for text in texts if text)
            if node.tag == "path":
                searched.update(path.parent / text for text in texts)
    except (ElementTree.ParseError, OSError, UnicodeDecodeError):
        found = {file}
    for beside, text in named:
        found.update(place for folder in {beside, *searched} if _is_file(place := folder / text))
    others = {path.resolve() for path in found} - {file.resolve()}
    return [file, *sorted(others)]


def scene_facts(scene: PathLike, parameters: Mapping[str, str] | None = None) -> Facts:
    """What a scene's pictures depend on, as far as files and parameters tell; wherever the files lie.

    Returns
    -------
    dict
        JSON-able: ``parameters``, files among them by their hash; ``files``, names and hashes.
    """
    given = dict(parameters or {})
    files = scene_files(scene, given)
    return {
        "parameters": {name: digest_of(v) if _is_file(Path(v)) else v for name, v in given.items()},
        "files": sorted((path.name, digest_of(path)) for path in files),
    }


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a text that is too long for a name, or holds a zero
        return False
