"""Parameters of scene files, ``-D KEY=VALUE``: which there are, so that a wrong one is told beside those.

Mitsuba itself says "included file not found" and "unused parameters". What cannot be read here, as a malformed file or
one with search paths of its own, is left to it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from btfref.errors import InputError
from btfref.scene.shipped import ENVIRONMENTS

_NAME = re.compile(r"\$(\w+)")


def check_parameters(file: Path, parameters: Mapping[str, str]) -> None:
    """Refuse parameters that a scene does not have, and values that name a file which is not there.

    Parameters
    ----------
    file : pathlib.Path
        The scene, Mitsuba XML.
    parameters : mapping of str to str
        Values for ``$name`` in the file.

    Raises
    ------
    InputError
        In one line that says which names or values there are.
    """
    values: dict[str, str] = {}
    used: set[str] = set()
    try:
        for path, node in nodes(file, values, parameters):
            if node.tag == "path":  # further folders for files that are included
                return
            for attribute in node.attrib.values():
                names = _NAME.findall(attribute)
                used.update(names)
                for name in names:
                    if name not in values and name not in parameters:
                        expected = "-D environment=NAME, a picture or " + ", ".join(ENVIRONMENTS)
                        raise InputError(
                            "the scene needs a value for a parameter",
                            file=file,
                            field=name,
                            expected=expected if name == "environment" else f"-D {name}=VALUE",
                        )
            if node.tag == "include":
                _check_include(file, path, node.attrib.get("filename", ""), values | dict(parameters))
    except (ElementTree.ParseError, OSError, UnicodeDecodeError):
        return
    for name in parameters:
        if name not in used:
            raise InputError(
                "the scene has no such parameter" + _not_with(file, name, parameters),
                file=file,
                field="-D",
                got=f"{name}={parameters[name]}",
                expected=", ".join(sorted(used)),
            )


def nodes(
    file: Path, values: dict[str, str], parameters: Mapping[str, str]
) -> Iterator[tuple[Path, ElementTree.Element]]:
    """Every node of a scene and of what it includes, in order, with its file; ``values`` collects defaults."""
    for node in ElementTree.parse(file).getroot().iter():
        if node.tag == "default":
            values.setdefault(node.attrib.get("name", ""), node.attrib.get("value", ""))
        yield file, node
        if node.tag == "include":
            name = filled(node.attrib.get("filename", ""), values | dict(parameters))
            yield from nodes(file.parent / name, values, parameters)


def search_paths(file: Path, parameters: Mapping[str, str]) -> list[Path]:
    """Folders that a scene names with ``<path value="…"/>``, for files that are not beside it.

    Parameters
    ----------
    file : pathlib.Path
        The scene, Mitsuba XML.
    parameters : mapping of str to str
        Values for ``$name`` in the file.

    Returns
    -------
    list of pathlib.Path
        In their order; those that are there.
    """
    values: dict[str, str] = {}
    found = []
    with contextlib.suppress(ElementTree.ParseError, OSError, UnicodeDecodeError):
        for path, node in nodes(file, values, parameters):
            if node.tag == "path":
                text = filled(node.attrib.get("value", ""), values | dict(parameters))
                found += [folder for folder in (path.parent / text, Path(text)) if folder.is_dir()][:1]
    return found


def filled(text: str, values: Mapping[str, str]) -> str:
    """A text with the values of its ``$name``; those without a value stay."""
    return _NAME.sub(lambda match: values.get(match[1], match[0]), text)


def _check_include(scene: Path, file: Path, pattern: str, values: Mapping[str, str]) -> None:
    """The file that a value chooses must be there: ``lights_$lights.xml`` says which values there are."""
    names = _NAME.findall(pattern)
    if len(names) != 1 or (file.parent / filled(pattern, values)).is_file():
        return
    before, after = pattern.split(f"${names[0]}")
    found = sorted(file.parent.glob(f"{before}*{after}"))
    known = [path.name.removeprefix(before).removesuffix(after) for path in found]
    if known:
        raise InputError(
            f"no such {names[0]}",
            file=scene,
            field=f"-D {names[0]}",
            got=values[names[0]],
            expected=", ".join(known),
        )


def _not_with(file: Path, name: str, parameters: Mapping[str, str]) -> str:
    """A hint where another choice of lights has the parameter: an environment without ``lights=envmap``."""
    for other in sorted(file.parent.glob("lights_*.xml")):
        lights = other.stem.removeprefix("lights_")
        if f"${name}" in other.read_text("utf-8") and parameters.get("lights") != lights:
            return f" without lights={lights}"
    return ""
