"""Scenes as Mitsuba's objects, with the film that all pictures have and the maps that they need.

The film is always float32 with a box filter, so that a pixel is the plain mean of its samples: Mitsuba's
default Gaussian filter mixes pixels and its float16 files round.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.sampling.variant import no_collection
from btfref.scene import parsing
from btfref.scene.reading.instances import Where, drawn_nodes, drawn_shapes
from btfref.scene.shapes import refuse_partial_uv
from btfref.types import JitArray, SceneLike

if TYPE_CHECKING:
    import numpy as np

    from btfref.scene.parsing import ParsedScene


#: Maps of files that are loaded: file to "views", "lights", "entries" and "levels", None where all are.
Kept = Mapping[str, Mapping[str, "np.ndarray | None"]]


class loaded:  # noqa: N801 - a context manager that reads as a verb
    """``with loaded(scene, parameters, variant=…, size=…) as mitsuba_scene``; restores the variant.

    ``plain`` loads the shapes alone: materials become diffuse, and BTF files need not exist. ``kept`` says which
    maps are loaded: file to the materials' parameters ``views``, ``lights``, ``entries`` and ``levels``. Without
    ``sampled`` nobody draws light directions, and materials are spared the tables for it; None: where all lights are
    delta lights. ``interpolation`` is that of all materials in place of the scene's; one that is "drawn" is refused
    but where ``draws`` says that the picture is a mean of random samples.
    """

    def __init__(
        self,
        scene: SceneLike,
        parameters: Mapping[str, object] | None = None,
        *,
        variant: str = "llvm_ad_rgb",
        size: tuple[int, int] | None = None,
        plain: bool = False,
        kept: Kept | None = None,
        sampled: bool | None = True,
        interpolation: str | None = None,
        draws: bool = False,
    ) -> None:
        self._arguments = scene, parameters, variant, size, plain, kept, sampled
        self._interpolation, self._draws = interpolation, draws
        self._before = None
        self._uncollected = no_collection()

    def __enter__(self) -> JitArray:
        scene, parameters, variant, size, plain, kept, sampled = self._arguments
        if variant.startswith("llvm"):
            from btfref.platform import prepare_llvm

            prepare_llvm()
        import mitsuba as mi

        self._before = mi.variant()
        parsing.use_variant(variant)
        self._uncollected.__enter__()  # what is traced in the block sees no material go
        try:
            if "scalar" not in variant:
                import mitsuba_plugins

                mitsuba_plugins.register()
            parsed = parsing.parse(scene, parameters, variant=variant, size=size, missing_btf=plain)
            for index in [i for i, node in enumerate(parsed.nodes) if parsing.is_kind(node, "Film")]:
                _plain_film(parsed, index)
            btf_shapes = _btf_shapes(parsed)
            if plain:
                parsing.plain(parsed)
            if sampled is None:
                lights = [node for node in parsed.nodes if parsing.is_kind(node, "Emitter")]
                sampled = any(
                    node.props.plugin_name() not in (*parsing.DELTA_LIGHTS, "area") for node in lights
                )
            for node in parsed.nodes:
                if node.props.plugin_name() != parsing.BTF:
                    continue
                if not sampled:
                    node.props["sampling"] = "cosine"
                self._interpolate(parsed, node)
                if kept:
                    for name, chosen in kept[node.props["filename"]].items():
                        if chosen is not None:
                            node.props[name] = " ".join(map(str, chosen))
            made = parsed.instantiate()
            if not isinstance(made, mi.Scene):
                raise InputError("the file does not describe a scene", file=parsed.source)
            _demand_texture_coordinates(made, btf_shapes)
            if not made.sensors():
                raise InputError("the scene has no sensor", file=parsed.source, field="sensor")
            return made
        except BaseException:
            self.__exit__()
            raise

    def _interpolate(self, parsed: ParsedScene, node: JitArray) -> None:
        """Set how a material interpolates, and refuse draws that no further sample would average."""
        if self._interpolation is not None:
            node.props["interpolation"] = self._interpolation
        if parsing.interpolation_of(parsed, node) == "drawn" and not self._draws:
            raise InputError(
                "only pictures of random samples draw views",
                file=parsed.location(node),
                field="interpolation",
                got="drawn",
                expected="blended",
            )

    def __exit__(self, *_: object) -> None:
        self._uncollected.__exit__(None, None, None)
        if self._before is not None:
            parsing.use_variant(self._before)


def _btf_shapes(parsed: ParsedScene) -> list[tuple[Where, str, str]]:
    """Every drawn shape with a BTF: which, its place, its name; to be asked before instantiation consumes the tree.

    Raises
    ------
    InputError
        For an OBJ file with texture coordinates at some of its faces.
    """

    def shows_btf(node: JitArray) -> bool:
        materials = [child for _, child in parsed.children(node) if parsing.is_kind(child, "BSDF")]
        return any(node.props.plugin_name() == parsing.BTF or shows_btf(node) for node in materials)

    roots = [(i, n) for i, n in parsed.children(parsed.state.root) if parsing.is_kind(n, "Shape")]
    found = []
    for drawn in drawn_nodes(parsed, roots):
        props = drawn.node.props
        if not shows_btf(drawn.node):
            continue
        # Not by identifiers: files need not give any, and all shapes then have the same.
        name, place = drawn.name(props.id() or props.plugin_name()), parsed.location(drawn.node)
        if props.plugin_name() == "obj" and "filename" in props:
            refuse_partial_uv(props["filename"], scene=place, name=name)
        found.append((drawn.where, place, name))
    return found


def _demand_texture_coordinates(made: JitArray, btf_shapes: list[tuple[Where, str, str]]) -> None:
    """Refuse meshes with a BTF but no uv: Mitsuba would use the triangles' barycentric coordinates."""
    shapes = drawn_shapes(made, [where for where, _, _ in btf_shapes])
    for drawn, (_, place, name) in zip(shapes, btf_shapes, strict=True):
        if drawn.shape.is_mesh() and not drawn.shape.has_vertex_texcoords():
            raise InputError("the shape has no texture coordinates", file=place, field=name)


def _plain_film(parsed: ParsedScene, index: int) -> None:
    """Box filter and float32 RGB, whatever the scene says; ``index`` is the film's node."""
    import mitsuba as mi

    film = parsed.nodes[index]
    film.props["component_format"] = "float32"
    film.props["pixel_format"] = "rgb"
    filters = [n for _, n in parsed.children(film) if parsing.is_kind(n, "ReconstructionFilter")]
    for node in filters:
        for key in list(node.props.keys()):
            del node.props[key]
        node.props.set_plugin_name("box")
    if not filters:
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.ReconstructionFilter
        node.props.set_plugin_name("box")
        film.props["rfilter"] = mi.Properties.ResolvedReference(len(parsed.nodes))
        # Last: the list may move, and then no node that was taken from it before is valid any longer.
        parsed.nodes.append(node)
