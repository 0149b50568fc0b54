"""Directions in the names of images: ``tl`` and ``pl`` of the light, ``tv`` and ``pv`` of the camera, in degrees.

The names decide, no grid is assumed. Where light and camera coincide the light cannot stand and is moved; its
image then carries the angles where it stood. Such an image takes the place of the pair that it was made for.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Generic, TypeVar

import numpy as np

from btfref.errors import InputError
from btfref.formats.source import LARGEST_COUNT, direction_set
from btfref.numerics.sphere.directions import DirectionSet
from btfref.types import PathLike

_ANGLE = re.compile(r"(?<![a-z])(tl|pl|tv|pv)(\d{1,3}(?:\.\d{1,6})?)(?![0-9.]*\d)")

#: A light this far from the camera (degrees) was not moved out of its way; rigs move it by 5 to 15.
FARTHEST_MOVE = 30.0


#: θ_l, φ_l, θ_v and φ_v in degrees.
Angles = tuple[float, float, float, float]

#: θ and φ in degrees.
Direction = tuple[float, float]

#: What stands for an image: its name, or its pixels.
Image = TypeVar("Image")


@dataclass(frozen=True)
class Grid(Generic[Image]):
    """Views × lights with the image of each pair.

    Parameters
    ----------
    views, lights : DirectionSet
    images : dict of (int, int) to object
        Image of (view, light): its name, or its pixels.
    moved : dict of (int, int) to (float, float)
        Where the light really stood, polar angle and azimuth in degrees.
    present : ndarray of bool, shape (views, lights)
    """

    views: DirectionSet
    lights: DirectionSet
    images: dict[tuple[int, int], Image]
    moved: dict[tuple[int, int], Direction]
    present: np.ndarray


def angles_of(name: str) -> Angles | None:
    """(θ_l, φ_l, θ_v, φ_v) in degrees of an image's name, or None.

    φ lies in [0, 360); at the pole it is 0, whatever the name says.
    """
    found = _ANGLE.findall(PurePosixPath(name).stem)
    if len(found) != 4 or len({key for key, _ in found}) != 4:
        return None
    return in_order({key: float(text) for key, text in found})


def in_order(angle: Mapping[str, float]) -> Angles:
    """(θ_l, φ_l, θ_v, φ_v) of angles by the names of a name's fields; φ as of `angles_of`."""
    light, view = ((angle[t], angle[p] % 360 if angle[t] else 0.0) for t, p in (("tl", "pl"), ("tv", "pv")))
    return light + view


def style_of(names: Iterable[str]) -> str | None:
    """How the first image with angles writes them: "spectral", "utia", "ubo", or None.

    "spectral" puts the camera first, and has OpenEXR alone; "utia" joins light first by underscores; "ubo" is anything
    else.
    """
    for name in names:
        stem = PurePosixPath(name).stem
        if angles_of(name) is not None:
            if re.search(r"tv[\d.]+_pv[\d.]+_tl[\d.]+_pl", stem):
                return "spectral" if name.lower().endswith(".exr") else "ubo"
            return "utia" if re.search(r"tl[\d.]+_pl[\d.]+_tv[\d.]+_pv", stem) else "ubo"
    return None


def grid(
    names: Iterable[str],
    file: PathLike,
    *,
    allow_missing: bool = False,
    angles_in: Callable[[str], Angles | None] = angles_of,
) -> Grid[str]:
    """Views × lights of images by name.

    Parameters
    ----------
    names : iterable of str
        Names without angles are passed over.
    file : path-like
        For errors.
    allow_missing : bool
        Accept pairs without an image.
    angles_in : callable
        Finds the angles in a name, as `angles_of` does.

    Returns
    -------
    Grid
        Directions sorted by θ, then φ, so that rings are found.

    Raises
    ------
    InputError
        No image, one pair twice, pairs missing, or directions below the horizon.
    """
    entries: dict[Angles, str] = {}
    seen = ""
    for name in names:
        seen = seen or name
        angles = angles_in(name)
        if angles is None:
            continue
        if not (0 <= angles[0] <= 90 and 0 <= angles[2] <= 90):
            raise InputError("direction below the horizon", file=file, field=name, got=angles)
        if angles in entries:
            raise InputError(
                "two images of one pair of directions", file=file, field=name, got=f"also {entries[angles]}"
            )
        entries[angles] = name
    if not entries:
        if angles_in is not angles_of:
            raise InputError(
                "no image whose name is of the pattern", file=file, field="pattern", got=seen or "none"
            )
        raise InputError("no image with tl, pl, tv and pv in its name", file=file)
    return arrange(entries, file, allow_missing=allow_missing)


def arrange(entries: Mapping[Angles, Image], file: PathLike, *, allow_missing: bool = False) -> Grid[Image]:
    """Views × lights of images whose directions are known.

    Parameters
    ----------
    entries : dict of (float, float, float, float) to object
        Image by its θ_l, φ_l, θ_v, φ_v in degrees.
    file, allow_missing
        As of `grid`.

    Returns
    -------
    Grid
    """
    views = sorted({(tv, pv) for _, _, tv, pv in entries})
    moved = _moved(entries, len(views), file)
    lights = sorted({(tl, pl) for tl, pl, tv, pv in entries if ((tl, pl), (tv, pv)) not in moved})
    if max(len(views), len(lights)) > LARGEST_COUNT or len(views) * len(lights) > 64 * len(entries) + 4096:
        raise InputError(
            "light directions differ from view to view",
            file=file,
            got=f"{len(entries)} images of {len(views)} views and {len(lights)} lights",
            expected="every light at every view",
        )
    at = {view: i for i, view in enumerate(views)}, {light: i for i, light in enumerate(lights)}
    images, where = {}, {}
    for (tl, pl, tv, pv), name in entries.items():
        nominal = (tv, pv) if ((tl, pl), (tv, pv)) in moved else (tl, pl)
        pair = at[0][tv, pv], at[1][nominal]
        images[pair] = name
        if nominal != (tl, pl):
            where[pair] = (tl, pl)
    present = np.zeros((len(views), len(lights)), bool)
    present[tuple(np.array(list(images)).T)] = True
    if not present.all() and not allow_missing:
        view, light = np.argwhere(~present)[0]
        raise InputError(
            "images are missing",
            file=file,
            field="light {:g}° {:g}°, camera {:g}° {:g}°".format(*lights[light], *views[view]),
            got=f"{int((~present).sum())} of {present.size} missing",
            expected="all (or to allow missing ones)",
        )
    sets = []
    for found in (views, lights):
        theta, phi = np.radians(found).T
        sets.append(direction_set(theta, phi, file))
    return Grid(sets[0], sets[1], images, where, present)


def _moved(
    entries: Mapping[Angles, object], n_views: int, file: PathLike
) -> set[tuple[Direction, Direction]]:
    """((θ_l, φ_l), (θ_v, φ_v)) of images whose light was moved out of the camera's way."""
    views_of = defaultdict(set)
    for tl, pl, tv, pv in entries:
        views_of[tl, pl].add((tv, pv))
    common = {light for light, seen in views_of.items() if 2 * len(seen) >= n_views}
    moved = set()
    for light, seen in views_of.items():
        if light not in common and all(
            view in common and view not in views_of[view] and _apart(light, view) <= FARTHEST_MOVE
            for view in seen
        ):
            moved |= {(light, view) for view in seen}
    twice = [view for view, count in Counter(view for _, view in moved).items() if count > 1]
    if twice:
        raise InputError("several lights moved for one camera", file=file, got=twice[0], expected="one")
    return moved


def _apart(first: Direction, second: Direction) -> float:
    """Angle between two directions given in degrees, in degrees."""
    a, b = np.radians(first), np.radians(second)
    cosine = np.cos(a[0]) * np.cos(b[0]) + np.sin(a[0]) * np.sin(b[0]) * np.cos(a[1] - b[1])
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
