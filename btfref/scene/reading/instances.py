"""Shapes that are drawn more than once: Mitsuba's ``shapegroup`` and ``instance``; and ``merge``, which is a list.

A scene's own shapes are ``mitsuba.Scene.shapes()``, where instances stand for what they show. What is drawn are shapes
in this order, each instance replaced by the shapes of its group.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.scene.parsing import ParsedScene

#: Plugins of shapes that hold shapes.
GROUP, INSTANCE, MERGE = "shapegroup", "instance", "merge"


@dataclass(frozen=True)
class Where:
    """Which of Mitsuba's shapes is drawn.

    Parameters
    ----------
    number : int
        Of the shape, or of the instance, among those of the scene.
    group : int or None
        Number of the instance's group among the scene's groups; None for a shape of the scene itself.
    member : int
        Of the group.
    """

    number: int
    group: int | None = None
    member: int = 0


@dataclass(frozen=True)
class DrawnNode:
    """A shape that is drawn, as the scene file has it.

    Parameters
    ----------
    node : mitsuba.parser.SceneNode
    where : Where
    instance : mitsuba.parser.SceneNode or None
        That shows the shape.
    """

    node: JitArray
    where: Where
    instance: JitArray | None = None

    @property
    def outer(self) -> np.ndarray:
        """Transform of the instance, shape (4, 4): the identity for a shape of the scene itself."""
        props = None if self.instance is None else self.instance.props
        return np.array(props["to_world"].matrix, float) if props and "to_world" in props else np.eye(4)

    def name(self, own: str) -> str:
        """What messages call the shape, from its own identifier."""
        return own if self.instance is None else f"{self.instance.props.id() or INSTANCE}/{own}"


def without_merges(parsed: ParsedScene) -> None:
    """Put the shapes of every ``merge`` in its place: it joins meshes for speed and changes no picture."""
    import mitsuba as mi

    merges = {i for i, node in enumerate(parsed.nodes) if node.props.plugin_name() == MERGE}

    def members(index: int) -> Iterator[int]:
        for inner, _ in parsed.children(parsed.nodes[index]):
            yield from members(inner) if inner in merges else (inner,)

    for index, node in enumerate(parsed.nodes if merges else ()):
        props, held = node.props, parsed.references(node)
        for key in [key for key, inner in held.items() if inner in merges and index not in merges]:
            del props[key]
            for number, inner in enumerate(members(held[key])):
                props[f"{key}_{number}"] = mi.Properties.ResolvedReference(inner)


def drawn_nodes(parsed: ParsedScene, shapes: Sequence[tuple[int, JitArray]]) -> list[DrawnNode]:
    """What is drawn of the scene's own shapes.

    Parameters
    ----------
    parsed : ParsedScene
    shapes : sequence of (int, mitsuba.parser.SceneNode)
        Of the scene itself, groups among them, each with its index.

    Raises
    ------
    InputError
        For an instance without one group, or a group within a group.
    """
    groups = {index: (k, node) for k, (index, node) in enumerate(_of(GROUP, shapes))}
    drawn, number = [], 0
    for _, group in groups.values():
        for _, inner in _of(INSTANCE, _shapes_in(parsed, group)) + _of(GROUP, _shapes_in(parsed, group)):
            raise InputError(
                "instances within instances are not supported, as in Mitsuba",
                file=parsed.location(inner),
                field=group.props.id() or GROUP,
                got=inner.props.plugin_name(),
                expected="shapes",
            )
    for index, node in shapes:
        if index in groups:
            continue
        if node.props.plugin_name() != INSTANCE:
            drawn.append(DrawnNode(node, Where(number)))
        else:
            held = _shapes_in(parsed, node)
            if len(held) != 1 or held[0][0] not in groups:
                raise InputError(
                    "an instance shows one shapegroup of the scene",
                    file=parsed.location(node),
                    field=node.props.id() or INSTANCE,
                    got=", ".join(one.props.plugin_name() for _, one in held) or "nothing",
                    expected=GROUP,
                )
            k, group = groups[held[0][0]]
            members = _shapes_in(parsed, group)
            drawn += [DrawnNode(one, Where(number, k, m), node) for m, (_, one) in enumerate(members)]
        number += 1
    return drawn


@dataclass(frozen=True)
class Drawn:
    """A shape that is drawn, as Mitsuba made it: what a surface interaction says of it.

    Parameters
    ----------
    shape : mitsuba.Shape
    instance : mitsuba.Shape or None
    """

    shape: JitArray
    instance: JitArray | None = None


def drawn_shapes(scene: JitArray, places: Iterable[Where]) -> list[Drawn]:
    """Mitsuba's shapes at some places.

    Parameters
    ----------
    scene : mitsuba.Scene
    places : iterable of Where

    Returns
    -------
    list of Drawn
        One for each place.
    """
    shapes, groups = scene.shapes(), _groups(scene)
    return [
        Drawn(shapes[w.number]) if w.group is None else Drawn(groups[w.group][w.member], shapes[w.number])
        for w in places
    ]


def every_shape(scene: JitArray) -> list[JitArray]:
    """All shapes of a scene that have a surface: its own but for instances, and those of its groups, each once."""
    own = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    return own + [shape for group in _groups(scene) for shape in group]


def _groups(scene: JitArray) -> list[list[JitArray]]:
    """Shapes of every group of a scene."""
    return [_held(group) for group in _held(scene) if group.class_name().startswith("ShapeGroup")]


def _held(thing: JitArray) -> list[JitArray]:
    """Shapes that a scene or a group holds, in their order."""
    import mitsuba as mi

    found: list[JitArray] = []

    class Shapes(mi.TraversalCallback):
        def put_object(self, name: str, value: Any, flags: int) -> None:
            self.put(name, value, flags)

        def put(self, name: str, value: Any, *flags: object) -> None:
            if hasattr(value, "ray_intersect_preliminary"):
                found.append(value)

        def put_value(self, name: str, value: Any, *flags: object) -> None:
            pass

    thing.traverse(Shapes())
    return found


def _of(plugin: str, nodes: Sequence[tuple[int, JitArray]]) -> list[tuple[int, JitArray]]:
    return [(index, node) for index, node in nodes if node.props.plugin_name() == plugin]


def _shapes_in(parsed: ParsedScene, node: JitArray) -> list[tuple[int, JitArray]]:
    from btfref.scene.parsing import is_kind

    return [(index, child) for index, child in parsed.children(node) if is_kind(child, "Shape")]
