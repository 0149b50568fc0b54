"""Scenes that btfref ships: Mitsuba XML beside its meshes, made to be read and edited."""

from __future__ import annotations

import re
from pathlib import Path

from btfref.errors import InputError
from btfref.types import PathLike

_FOLDER = Path(__file__).resolve().parent

#: Begins the names of files that hold lights, which the scenes include: ``lights_$lights.xml``.
_LIGHTS = "lights_"

#: Environments that :func:`btfref.scene.environments.shipped` makes, for messages; "sky" takes any elevation of the sun
#: from 1 to 90. Apart, so that a command line knows them without loading NumPy.
ENVIRONMENTS = ("constant", "sky", "sky10", "sky60", "studio", "harmonics", "bright-texel")


def names() -> list[str]:
    """Names of the shipped scenes, sorted; the files of lights that they include are none."""
    return sorted(path.stem for path in _FOLDER.glob("*.xml") if not path.stem.startswith(_LIGHTS))


def lights() -> list[str]:
    """Names of the lights that shipped scenes can have (``-D lights=NAME``), sorted."""
    return sorted(path.stem.removeprefix(_LIGHTS) for path in _FOLDER.glob(f"{_LIGHTS}*.xml"))


def described(scene: str) -> tuple[str, dict[str, str]]:
    """What a shipped scene shows, and its parameters, from the comment at the head of its file.

    Parameters
    ----------
    scene : str
        One of :func:`names`.

    Returns
    -------
    summary : str
    parameters : dict of str to str
        Name, or names that belong together, to their meaning.
    """
    comment = (_FOLDER / f"{scene}.xml").read_text("utf-8").partition("<!--")[2].partition("-->")[0]
    summary, _, rest = comment.partition("Parameters (-D name=value):")
    parameters = dict(re.split(r"  +", line.strip(), maxsplit=1) for line in rest.strip().splitlines())
    return " ".join(summary.split()).rstrip("."), parameters


def scene_file(scene: PathLike) -> Path:
    """Path of a scene: a file, or one of the shipped scenes by its name.

    Parameters
    ----------
    scene : path-like

    Returns
    -------
    pathlib.Path

    Raises
    ------
    InputError
        When it is neither.
    """
    if Path(scene).exists():
        return Path(scene)
    if str(scene) in names():
        return _FOLDER / f"{scene}.xml"
    expected = f"a Mitsuba scene file, or one of {', '.join(names())}"
    raise InputError("no such scene", file=scene, expected=expected)
