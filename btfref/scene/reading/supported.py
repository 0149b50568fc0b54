"""What real-time rendering has of Mitsuba's scenes: sensors, films and lights; what it lacks is refused in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from btfref.errors import InputError
from btfref.scene.emitters.lights import DIRECTED
from btfref.scene.parsing import DELTA_LIGHTS, SURROUNDINGS, ParsedScene, is_kind
from btfref.types import JitArray


def check(parsed: ParsedScene, nodes: Mapping[str, list[JitArray]], shapes: Sequence[JitArray]) -> None:
    """Refuse what real-time rendering does not have: sensors, films, lights, finished objects.

    Parameters
    ----------
    parsed : ParsedScene
    nodes : dict of str to list of mitsuba.parser.SceneNode
        Those of the scene itself, by kind: "Sensor", "Emitter".
    shapes : sequence of mitsuba.parser.SceneNode
        That are drawn.

    Raises
    ------
    InputError
    """
    import mitsuba as mi

    if len(nodes["Sensor"]) != 1:
        raise InputError(
            "one sensor is needed", file=parsed.source, field="sensor", got=len(nodes["Sensor"]), expected=1
        )
    _check_sensor(parsed, nodes["Sensor"][0])
    for node in nodes["Emitter"]:
        _check_light(parsed, node, DELTA_LIGHTS + SURROUNDINGS)
    for node in shapes:
        for _, child in parsed.children(node):
            if is_kind(child, "Emitter"):
                _check_light(parsed, child, ("area",))
    for node in parsed.nodes:
        # Objects that were made before cannot be read under another variant.
        for key, value in node.props.items():
            made = type(value).__module__.startswith("mitsuba") and hasattr(value, "class_name")
            if made and not isinstance(value, mi.Bitmap):
                raise InputError("the scene holds a finished Mitsuba object", file=parsed.source, field=key)


def _check_sensor(parsed: ParsedScene, sensor: JitArray) -> None:
    """Refuse other sensors than pinholes with a whole film."""
    where, plugin = parsed.location(sensor), sensor.props.plugin_name()
    if plugin == "thinlens":
        radius = (
            f" of {float(sensor.props['aperture_radius']):g}" if "aperture_radius" in sensor.props else ""
        )
        raise InputError(
            "unsupported sensor: no depth of field in real time",
            file=where,
            field="aperture_radius",
            got=plugin + radius,
            expected="0, or a perspective sensor",
        )
    if plugin != "perspective":
        raise InputError("unsupported sensor", file=where, field="sensor", got=plugin, expected="perspective")
    for key in ("principal_point_offset_x", "principal_point_offset_y"):
        if key in sensor.props and float(sensor.props[key]) != 0:
            raise InputError("unsupported sensor setting", file=where, field=key, expected=0)
    for _, film in parsed.children(sensor):
        for key in ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y"):
            if is_kind(film, "Film") and key in film.props:
                raise InputError("cropped films are not supported", file=parsed.location(film), field=key)


def _check_light(parsed: ParsedScene, node: JitArray, known: Sequence[str]) -> None:
    """Refuse a light that is none of the known ones, or has a texture."""
    where, plugin = parsed.location(node), node.props.plugin_name()
    if plugin not in known:
        expected = DIRECTED if plugin == "directionalarea" else " or ".join(known)
        raise InputError("unsupported light", file=where, field="emitter", got=plugin, expected=expected)
    field = {"spot": "texture", "area": "radiance"}.get(plugin)
    if field is None:
        return
    index = parsed.references(node).get(field)
    # Colours are plain values, or textures that are the same everywhere.
    inner = None if index is None else parsed.nodes[index]
    if inner is not None and inner.props.plugin_name() not in UNIFORM:
        raise InputError(
            f"unsupported light: a textured {plugin}",
            file=parsed.location(inner),
            field=field,
            got=inner.props.plugin_name(),
            expected="a colour",
        )


#: Mitsuba's spectra, which are the same everywhere.
UNIFORM = ("srgb", "uniform", "d65", "regular", "irregular", "blackbody", "rgb", "spectrum", "rawconstant")
