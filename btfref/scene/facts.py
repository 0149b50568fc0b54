"""What a scene is made of, its files, and what a picture of it shows: JSON for the picture's own file.

Pictures of different things are then told apart.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from btfref.errors import MissingDependencyError
from btfref.platform import prepare_llvm
from btfref.scene import parsing
from btfref.scene.parameters import filled, nodes
from btfref.scene.shipped import scene_file

if TYPE_CHECKING:
    from btfref.scene.parsing import ParsedScene
    from btfref.types import Facts, JitArray, PathLike, SceneLike

#: Reading scenes needs no LLVM: this variant is compiled ahead of time.
VARIANT = "scalar_rgb"

#: Digits of a hash that tell files apart.
DIGITS = 16


def scene_content(
    scene: SceneLike, parameters: Mapping[str, object] | None = None, *, size: tuple[int, int] | None = None
) -> Facts:
    """What a scene shows: its lights, its camera, its representations.

    Parameters
    ----------
    scene : path-like or dict
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    size : (int, int), optional
        Width and height of the film in place of the scene's.

    Returns
    -------
    dict
        JSON-able: ``scene``, name or file as it was given; ``parameters``; ``lights`` and ``camera``, plugins with
        their settings as the scene file has them; ``representation``, for each file its ``file``, ``method`` and the
        beginning of its SHA-256, ``hash``.

    Raises
    ------
    InputError
        For a scene that cannot be read.
    """
    from btfref.representations.file.container import read_info

    # Importing Mitsuba loads some LLVM, whatever the variant: where there is a good one, it shall be that.
    with contextlib.suppress(MissingDependencyError):
        prepare_llvm()
    parsing.scalar_types()
    parsed = parsing.parse(scene, parameters, variant=VARIANT, size=size)
    nodes = list(parsed.nodes)
    kinds = {k: [n for n in nodes if parsing.is_kind(n, k)] for k in ("Emitter", "Sensor")}
    files = sorted({str(n.props["filename"]) for n in nodes if n.props.plugin_name() == parsing.BTF})
    cameras = [_described(parsed, node) for node in kinds["Sensor"]]
    return {
        "scene": "scene dictionary" if isinstance(scene, dict) else str(scene),
        "parameters": {name: str(value) for name, value in (parameters or {}).items()},
        "lights": [_described(parsed, node) for node in kinds["Emitter"]],
        "camera": cameras[0] if len(cameras) == 1 else cameras,
        "representation": [
            {"file": file, "method": read_info(file)["method"], "hash": digest_of(file)[:DIGITS]}
            for file in files
        ],
    }


def _described(parsed: ParsedScene, node: JitArray) -> Facts:
    """A plugin's name and settings, those of what it holds within; samplers say nothing of what is seen."""
    found: Facts = {"type": node.props.plugin_name()}
    children = dict(parsed.children(node))
    for key in node.props.keys():
        value = node.props[key]
        if type(value).__name__ != "ResolvedReference":
            found[key] = _plain(value)
        elif not parsing.is_kind(inner := children[value.index()], "Sampler"):
            # What has no name is named after what it is: "film", "rfilter".
            name = str(inner.type).rpartition(".")[2].lower() if key.startswith("_arg") else key
            found[name] = _described(parsed, inner)
    return found


def _plain(value: Any) -> Any:
    """A setting as JSON knows it."""
    if isinstance(value, (bool, int, float, str)) or value is None:
        return value
    if "Transform" in type(value).__name__:  # arrays of Dr.Jit take any name for a swizzle, "matrix" too
        return np.round(np.array(value.matrix, float), 6).tolist()
    if type(value).__name__ == "Bitmap":
        pixels = np.array(value)
        return (
            f"{pixels.shape[1]} × {pixels.shape[0]} {hashlib.sha256(pixels.tobytes()).hexdigest()[:DIGITS]}"
        )
    with contextlib.suppress(TypeError, ValueError):
        return [round(float(value[i]), 6) for i in range(len(value))]
    return " ".join(str(value).split())


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
