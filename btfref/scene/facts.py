"""What a picture shows, as JSON: for the picture's own file, so that pictures of different things are told apart."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import MissingDependencyError
from btfref.platform import prepare_llvm
from btfref.scene import parsing
from btfref.scene.files import digest_of

if TYPE_CHECKING:
    from btfref.scene.parsing import ParsedScene
    from btfref.types import Facts, JitArray, SceneLike

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
