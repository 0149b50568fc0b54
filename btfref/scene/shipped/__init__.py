"""Scenes that btfref ships: Mitsuba XML beside its meshes, made to be read and edited."""

from __future__ import annotations

from pathlib import Path

from btfref.errors import InputError

_FOLDER = Path(__file__).resolve().parent


def names():
    """Names of the shipped scenes, sorted; the files of lights that they include are none."""
    return sorted(path.stem for path in _FOLDER.glob("*.xml") if not path.stem.startswith("lights_"))


def scene_file(scene):
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
