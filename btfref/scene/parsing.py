"""Mitsuba scenes as a tree of nodes: parsed once, with the same overrides for every renderer.

Both renderers start from here, so that they agree on file names, film size and parameters.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np

from btfref.errors import InputError, refuse_large_picture
from btfref.numerics.footprint import MODES
from btfref.numerics.interpolations import INTERPOLATIONS
from btfref.numerics.sphere.frames import uv_transform
from btfref.platform import set_variant
from btfref.representations.file.container import refuse_store
from btfref.scene.parameters import check_parameters, search_paths
from btfref.scene.reading.instances import without_merges
from btfref.scene.shapes import BtfMaterial
from btfref.scene.shipped import ENVIRONMENTS, scene_file
from btfref.types import Facts, JitArray, SceneLike
from mitsuba_plugins.lib.parameters import refuse_unknown

#: Emitters that shine on each point from one direction, and those infinitely far away on all sides: one at most.
DELTA_LIGHTS, SURROUNDINGS = ("directional", "point", "spot"), ("envmap", "constant", "sunsky")

#: Emitters of earlier Mitsubas that became settings of another one.
_RENAMED = {"sky": "sunsky with sun_scale 0", "sun": "sunsky with sky_scale 0"}

#: Size of Mitsuba's films by default.
_FILM = (("width", 768), ("height", 576))

#: The BSDF plugin that shows a representation.
BTF = "btf"


@dataclass
class ParsedScene:
    """A parsed scene and what instantiates it.

    Parameters
    ----------
    state : mitsuba.parser.ParserState
    config : mitsuba.parser.ParserConfig
    source : str
        The scene file, or "scene dictionary".
    notes : list of str
        What is drawn otherwise than its name says, a line each.
    """

    state: JitArray
    config: JitArray
    source: str
    notes: list[str] = field(default_factory=list)

    @property
    def nodes(self) -> JitArray:
        """All nodes, referenced by index."""
        return self.state.nodes

    def location(self, node: JitArray) -> str:
        """File and line of a node, for error messages."""
        import mitsuba as mi

        try:
            return mi.parser.file_location(self.state, node) or self.source
        except RuntimeError:
            return self.source

    def children(self, node: JitArray) -> list[tuple[int, JitArray]]:
        """Nodes that ``node`` refers to, in their order, as ``(index, node)``."""
        return [(index, self.nodes[index]) for index in self.references(node).values()]

    def references(self, node: JitArray) -> dict[str, int]:
        """Names of a node's settings that are nodes, and the indices of these, in their order."""
        values = {key: node.props[key] for key in node.props.keys()}
        # Colours take any name for a swizzle, "index" too.
        return {k: v.index() for k, v in values.items() if type(v).__name__ == "ResolvedReference"}

    def instantiate(self) -> JitArray:
        """The Mitsuba scene.

        Raises
        ------
        InputError
            With Mitsuba's reason in one line.
        """
        import mitsuba as mi

        try:
            made = mi.parser.instantiate(self.config, self.state)
        except (RuntimeError, ValueError, TypeError) as error:
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            raise InputError(one_line(error), file=self.source) from error
        return made[0] if isinstance(made, list) else made


def one_line(error: Exception) -> str:
    """Mitsuba's message without its C++ source positions and without the traceback of a plugin in Python."""
    text = re.sub(r"\[[\w./]+\.(?:cpp|h):\d+\]\s*", "", str(error))
    # The last line of a traceback is the exception, after its class name.
    text = re.sub(
        r"Traceback \(most recent call last\):.*\n\S*?(?:Error|Exception): ", "", text, flags=re.DOTALL
    )
    return " ".join(text.split())


def use_variant(name: str) -> None:
    """Make ``name`` the current Mitsuba variant.

    Raises
    ------
    InputError
        For a variant that this Mitsuba lacks.
    """
    import mitsuba as mi

    if name not in mi.variants():
        raise InputError("unknown Mitsuba variant", got=name, expected=", ".join(mi.variants()))
    if mi.variant() != name:
        set_variant(name)


def scalar_types() -> ModuleType:
    """Mitsuba's types of the variant ``scalar_rgb``, whatever the current one is.

    To set that variant and the former one again takes 0.2 s: Mitsuba compiles its integrators in Python anew.
    """
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    return importlib.import_module("mitsuba.scalar_rgb")


def parse(
    scene: SceneLike,
    parameters: Mapping[str, object] | None = None,
    *,
    variant: str,
    size: tuple[int, int] | None = None,
    missing_btf: bool = False,
) -> ParsedScene:
    """Parse a scene for a variant.

    Parameters
    ----------
    scene : path-like or dict
        Mitsuba XML file, name of a shipped scene, or scene dictionary.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    variant : str
        Of the objects that it is instantiated as.
    size : (int, int), optional
        Width and height of the film in place of the scene's.
    missing_btf : bool
        Leave the names of BTF files that do not exist as they are.

    Returns
    -------
    ParsedScene
        File names of ``btf`` materials are absolute: relative ones are looked up in the current directory,
        then beside the scene file. Equal nodes and meshes are kept apart.

    Raises
    ------
    InputError
        For a missing or malformed file, unused or missing parameters, or a missing BTF file.
    """
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    config.merge_equivalent = False
    config.merge_meshes = False
    values = {key: str(value) for key, value in (parameters or {}).items()}
    file = None if isinstance(scene, dict) else scene_file(scene)
    source = "scene dictionary" if file is None else str(file)
    if file is None and values:
        raise InputError("only scene files have parameters", field="parameters", got=", ".join(values))
    if file is not None and not file.is_file():
        raise InputError("a folder, not a scene", file=source)
    if file is not None:
        check_parameters(file, values)
    try:
        if file is None:
            state = mi.parser.parse_dict(config, scene)
        else:
            state = mi.parser.parse_file(config, str(file), **values)
        mi.parser.transform_all(config, state)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(one_line(error), file=source) from error
    parsed = ParsedScene(state, config, source)
    without_merges(parsed)
    for node in parsed.nodes:
        if (plugin := node.props.plugin_name()) in _RENAMED and not _is(node, "Shape"):
            raise InputError(
                "Mitsuba 3 has no such light",
                file=parsed.location(node),
                field="emitter",
                got=plugin,
                expected=_RENAMED[plugin],
            )
    beside = [] if file is None else [file.resolve().parent, *search_paths(file, values)]
    for node in parsed.nodes:
        _resolve_file(parsed, node, beside, missing_btf)
        if _is(node, "Film"):
            _whole_film(node)
        if node.props.plugin_name() == "thinlens":
            _pinhole(parsed, node)
        if _is(node, "Film") and size is not None:
            node.props["width"], node.props["height"] = int(size[0]), int(size[1])
        if _is(node, "Film") and all(name in node.props for name in ("width", "height")):
            sides = [node.props[name] for name in ("width", "height")]
            if all(isinstance(side, int) for side in sides):
                refuse_large_picture((sides[0], sides[1]), "width, height")
    return parsed


def _whole_film(film: JitArray) -> None:
    """Leave out a crop window that is the whole film."""
    props = film.props
    size = [int(props[name]) if name in props else default for name, default in _FILM]
    whole = {"crop_offset_x": 0, "crop_offset_y": 0, "crop_width": size[0], "crop_height": size[1]}
    if all(int(props[name]) == value for name, value in whole.items() if name in props):
        for name in [name for name in whole if name in props]:
            del props[name]


def _pinhole(parsed: ParsedScene, sensor: JitArray) -> None:
    """A lens of no size is a perspective camera; Mitsuba would take the smallest size instead, and say so."""
    props = sensor.props
    if "aperture_radius" in props and float(props["aperture_radius"]) == 0:
        for name in [name for name in ("aperture_radius", "focus_distance") if name in props]:
            del props[name]
        props.set_plugin_name("perspective")
        parsed.notes.append("thinlens with aperture_radius 0: drawn as a perspective camera")


def plain(parsed: ParsedScene, *, btf_alone: bool = False) -> None:
    """Replace what the geometry does not need, so that no material, texture or integrator is loaded.

    With ``btf_alone`` other materials than BTFs stay.
    """
    import mitsuba as mi

    for node in parsed.nodes:
        kinds = {"BSDF": "diffuse", "Integrator": "direct"}
        kind = next((k for k in kinds if is_kind(node, k)), None)
        if kind and not (btf_alone and kind == "BSDF" and node.props.plugin_name() != BTF):
            for key in list(node.props.keys()):
                del node.props[key]
            node.props.set_plugin_name(kinds[kind])
            node.type = getattr(mi.ObjectType, kind)


def _is(node: JitArray, kind: str) -> bool:
    return str(node.type) == f"ObjectType.{kind}"


def is_kind(node: JitArray, kind: str) -> bool:
    """Whether a node is a "Shape", "BSDF", "Emitter", "Sensor", "Film", and so on.

    In dictionaries, plugins that the current variant does not know come without a type.
    """
    return _is(node, kind) or (kind == "BSDF" and node.props.plugin_name() == BTF)


def _resolve_file(
    parsed: ParsedScene, node: JitArray, beside: Sequence[Path], missing_btf: bool = False
) -> None:
    """Make the node's relative file name absolute.

    Mitsuba looks beside the scene file, and in the folders that it names, only when it loads the file itself. BTF files
    come from the command line, so that the current directory goes first for them.
    """
    is_btf = node.props.plugin_name() == BTF
    if is_btf:
        refuse_unknown(node.props.keys(), file=parsed.location(node))
    name = node.props["filename"] if "filename" in node.props else None
    if not isinstance(name, str) or not name:
        if is_btf:
            raise InputError("a btf material without a file", file=parsed.location(node), field="filename")
        return
    for directory in (Path.cwd(), *beside) if is_btf else (*beside, Path.cwd()):
        if (directory / name).is_file():
            node.props["filename"] = str((directory / name).resolve())
            return
        if is_btf:
            refuse_store(directory / name)
    if node.props.plugin_name() == "envmap":
        _shipped_environment(parsed, node, name)
    if is_btf and not missing_btf:
        raise InputError("no such BTF file", file=parsed.location(node), field="filename", got=name)


def _shipped_environment(parsed: ParsedScene, node: JitArray, name: str) -> None:
    """Give an ``envmap`` the picture of a shipped environment that its file name stands for."""
    import mitsuba as mi

    from btfref.scene.environments import is_shipped, shipped

    if not is_shipped(name):
        expected = f"a picture, or {', '.join(ENVIRONMENTS)}"
        raise InputError(
            "no such environment", file=parsed.location(node), field="filename", got=name, expected=expected
        )
    del node.props["filename"]
    node.props["bitmap"] = mi.Bitmap(np.ascontiguousarray(shipped(name).radiance))


def interpolation_of(parsed: ParsedScene, node: JitArray) -> str:
    """How a ``btf`` material interpolates between measured views.

    Raises
    ------
    InputError
        For a way that there is not.
    """
    found = node.props["interpolation"] if "interpolation" in node.props else INTERPOLATIONS[0]
    if found not in INTERPOLATIONS:
        raise InputError(
            "unknown interpolation",
            file=parsed.location(node),
            field="interpolation",
            got=found,
            expected=" or ".join(INTERPOLATIONS),
        )
    return str(found)


def material_of(parsed: ParsedScene, shape: JitArray) -> tuple[str, BtfMaterial | None]:
    """Plugin name of the shape's BSDF, and the BTF material if it is one.

    Returns
    -------
    plugin : str
    material : BtfMaterial or None

    Raises
    ------
    InputError
        For settings that real-time rendering does not have, or that are out of range.
    """
    bsdfs = [child for _, child in parsed.children(shape) if is_kind(child, "BSDF")]
    if not bsdfs:
        # Mitsuba's own choice: grey, or black for a light.
        lit = any(is_kind(child, "Emitter") for _, child in parsed.children(shape))
        return "none" if lit else "diffuse", None
    node, twosided = bsdfs[0], False
    plugin = node.props.plugin_name()
    if plugin == "twosided":
        inner = [child for _, child in parsed.children(node)]
        if len(inner) > 1:
            if all(child.props.plugin_name() != BTF for child in inner):
                return plugin, None
            raise InputError(
                "unsupported: twosided with two materials", file=parsed.location(node), field="twosided"
            )
        if inner:
            node, twosided, plugin = inner[0], True, inner[0].props.plugin_name()
    if plugin != BTF:
        return plugin, None
    props = node.props
    filter_type = props["filter_type"] if "filter_type" in props else None
    if filter_type not in (None, "nearest", "bilinear"):
        where = parsed.location(node)
        raise InputError(
            "unknown texel filter",
            file=where,
            field="filter_type",
            got=filter_type,
            expected="nearest or bilinear",
        )
    matrix = np.eye(4) if "to_uv" not in props else np.array(props["to_uv"].matrix, float)
    affine, _ = uv_transform(matrix, file=parsed.location(node))
    numbers: Facts = {name: float(props[name]) for name in ("scale", "lod_bias", "lod_unit") if name in props}
    mode = str(props["lod"]) if "lod" in props else "auto"
    if mode not in MODES:
        where, expected = parsed.location(node), " or ".join(MODES)
        raise InputError("unknown level of detail", file=where, field="lod", got=mode, expected=expected)
    if not numbers.get("lod_unit", 1.0) > 0:
        where, got = parsed.location(node), numbers["lod_unit"]
        raise InputError(
            "the lod_unit is out of range", file=where, field="lod_unit", got=got, expected="> 0"
        )
    numbers |= {"lod": mode, "interpolation": interpolation_of(parsed, node)}
    material = BtfMaterial(
        props["filename"], filter_type, numbers.pop("scale", 1.0), affine, twosided, **numbers
    )
    return plugin, material
