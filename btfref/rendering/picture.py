"""What a picture's file says of the picture, and how two pictures differ by that."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.provenance import versions

if TYPE_CHECKING:
    from btfref.rendering import RenderResult
    from btfref.types import Facts, PathLike, SceneLike

#: Attribute of the OpenEXR header, JSON.
ATTRIBUTE = "btfref_picture"

#: What a renderer says of itself and belongs in the file, there or not.
ALWAYS = ("renderer", "grid", "spp", "seed", "shadows")

#: The same, where there is some.
SOMETIMES = (
    *("variant", "integrator", "rounds", "batches", "max_depth", "mesostructure", "estimated_error"),
    *("area_light_points", "area_light_error", "interpolation", "frames"),
    *("environment_path", "environment_lights", "order", "window", "gl_vendor", "gl_renderer", "gl_version"),
)


def picture_facts(
    result: RenderResult,
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    size: tuple[int, int] | None = None,
) -> Facts:
    """What a picture shows and how it was made.

    Parameters
    ----------
    result : RenderResult
    scene : path-like or dict
    parameters : dict of str to str, optional
    size : (int, int), optional
        As they were given to the renderer.

    Returns
    -------
    dict
        JSON-able: what :func:`btfref.scene.facts.scene_content` tells; ``renderer``, ``grid``, ``spp``, ``seed`` and
        ``shadows``, None where that renderer has none; further facts of the renderer; ``versions``.

    Raises
    ------
    InputError
        For a scene that cannot be read.
    """
    from btfref.scene.facts import scene_content

    meta = result.meta
    return {
        **scene_content(scene, parameters, size=size),
        **{name: meta.get(name) for name in ALWAYS},
        **{name: meta[name] for name in SOMETIMES if meta.get(name) is not None},
        "versions": versions(),
    }


def attributes(facts: Facts) -> dict[str, str]:
    """Facts as attributes for :func:`btfref.images.save_image`."""
    return {ATTRIBUTE: json.dumps(facts, sort_keys=True, default=str)}


def read_picture_facts(path: PathLike) -> Facts | None:
    """What a picture's file says of it; None for a file that says nothing, or is no OpenEXR file."""
    from btfref.images.files import read_attribute

    text = read_attribute(path, ATTRIBUTE) if Path(path).suffix.lower() == ".exr" else None
    try:
        facts = json.loads(text) if text is not None else None
    except ValueError:
        return None
    return facts if isinstance(facts, dict) else None


def differences(test: Facts, reference: Facts) -> list[str]:
    """What two pictures do not have in common, besides the renderer and its random numbers.

    Parameters
    ----------
    test, reference : dict
        As `picture_facts` gives them.

    Returns
    -------
    list of str
        A clause for each, such as "grid 4 against 2"; empty where the pictures should be the same.
    """
    return list(_differences(test, reference))


def _differences(a: Facts, b: Facts) -> Iterator[str]:
    def against(name: str, x: object, y: object) -> Iterator[str]:
        if x != y:
            yield f"{name} {_text(x)} against {_text(y)}"

    yield from against("scene", *(Path(str(f.get("scene"))).name for f in (a, b)))
    yield from against("representation", *(_representations(f) for f in (a, b)))
    if a.get("lights") != b.get("lights"):
        kinds = [_kinds(f) for f in (a, b)]
        yield from against("lights", *kinds)
        if kinds[0] == kinds[1]:
            yield f"other {kinds[0]} lights"
    cameras = [_camera(f) for f in (a, b)]
    yield from against("size", *(size for size, _ in cameras))
    if cameras[0][1] != cameras[1][1]:
        yield "another camera"
    yield from against("grid", a.get("grid"), b.get("grid"))
    if bool(a.get("shadows")) != bool(b.get("shadows")):
        yield f"shadows in the {'test' if a.get('shadows') else 'reference'} alone"
    # Those that name what is told above.
    told = ("btf", "lights", "environment")
    given = [_dict(f.get("parameters")) for f in (a, b)]
    for name in sorted((given[0].keys() | given[1].keys()) - set(told)):
        yield from against(name, given[0].get(name), given[1].get(name))
    installed = [_dict(f.get("versions")) for f in (a, b)]
    for name in sorted(installed[0].keys() & installed[1].keys()):
        yield from against(name, installed[0][name], installed[1][name])


def _text(value: object) -> str:
    return "none" if value is None or value == "" else str(value)


def _dict(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _representations(facts: Facts) -> str:
    """Name, method and the beginning of the hash, of each; equal files are equal wherever they lie."""
    found = facts.get("representation") or []
    return ", ".join(sorted(f"{one.get('method')} {str(one.get('hash'))[:8]}" for one in map(_dict, found)))


def _kinds(facts: Facts) -> str:
    kinds = Counter(str(_dict(light).get("type")) for light in facts.get("lights") or [])
    return ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))


def _camera(facts: Facts) -> tuple[str, Facts]:
    """Size of the film; and the camera without its film, whose other settings every renderer replaces."""
    camera = dict(_dict(facts.get("camera")))
    film = _dict(camera.pop("film", None))
    return f"{film.get('width')} × {film.get('height')}", camera
