"""The picture of real time drawn once more, by WebGL 2 in a headless Chromium: where there is one.

Under delta lights it is a picture of a cell, beside the one of real time. Under an environment real time approximates:
there a small picture of each method is judged against the same approximation in float64.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import MissingDependencyError
from btfref.system import CHROMIUM, chromium, mend_command

if TYPE_CHECKING:
    from btfref.comparison.picture_gates import Rounding
    from btfref.gates.verdicts import GateResult
    from btfref.rendering import RenderResult
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike
    from btfref.validate.matrix import Settings

#: Gates of such a picture against the reference: its rasterizer is coarser than OpenGL's.
GATES = ("image.browser", "image.browser_edges", "image.background")

#: Gates of a picture under an environment against float64.
ENVIRONMENT_GATES = ("image.browser_environment",)

#: That picture: scene, samples and size.
SCENE = "sphere"
PICTURE: Facts = {"grid": 1, "size": (24, 24)}

#: Its environment: a window in the dark, before the sphere. Rows and columns of the picture, of the window in it, and
#: its radiance. Prefiltering takes as long as there is light to filter: 20 s of processor time for a whole sky.
ROOM, WINDOW, RADIANCE = (16, 32), (slice(3, 7), slice(13, 18)), (3.0, 2.0, 1.5)

#: Ways in which an environment lights, and what keeps them quick. Float64 says what each of them should show.
WAYS: dict[str, Facts] = {"prefiltered": {}, "sh": {"order": 3}, "lights": {"lights": 24}}

#: Name of the renderer in gates and tables.
TITLE = "WebGL 2"


def demand_browser() -> None:
    """Refuse to go on without a browser where ``BTFREF_REQUIRE`` names one.

    Raises
    ------
    MissingDependencyError
    """
    wanted = {word.strip() for word in os.environ.get("BTFREF_REQUIRE", "").split(",")}
    if wanted & {"chromium", "all"} and chromium() is None:
        raise MissingDependencyError(
            f"Chromium is not on this machine, but BTFREF_REQUIRE={os.environ['BTFREF_REQUIRE']}",
            f"run: {mend_command([CHROMIUM])}",
        )


def draws(lights: str, settings: Settings) -> bool:
    """Whether the browser draws the cells under some lights."""
    return lights in settings.browser_lights and chromium() is not None


def left_out(lights: str, settings: Settings) -> str:
    """Why there is no such picture where there should be one, for a reader; else empty."""
    missing = lights in settings.browser_lights and not draws(lights, settings)
    return f" {TITLE} drew nothing: Chromium is not on this machine." if missing else ""


def browser_picture(path: Path, lights: str, settings: Settings, shared: Facts) -> RenderResult | None:
    """The picture, read back as floats; None for lights under which the browser draws none, or without Chromium.

    Raises
    ------
    BtfrefError
        For a lost device, a blank frame or a missing extension.
    """
    if not draws(lights, settings):
        return None
    from btfref.rendering.web.context import webgl

    return webgl(path, shadows=False, **shared)


def environment_ways(representation: Representation) -> list[str]:
    """Ways in which an environment lights a representation."""
    from btfref.registry import methods
    from btfref.representations.protocol import LitByHarmonics

    row = methods().get(representation.meta["method"])
    having = {
        "prefiltered": row is not None and bool(row.image_light),
        "sh": isinstance(representation, LitByHarmonics),
        "lights": True,
    }
    return [way for way in WAYS if having[way]]


def environment_gates(file: PathLike, wanted: Sequence[str]) -> list[GateResult]:
    """A method's small picture under an environment against float64, in those of some ways that it has.

    Parameters
    ----------
    file : path-like
        A representation.
    wanted : sequence of str
        Some of :data:`WAYS`.

    Returns
    -------
    list of GateResult
        ``image.browser_environment`` of each way; the detail says which. Empty without Chromium.

    Raises
    ------
    BtfrefError
        For a lost device, a blank frame or a missing extension.
    """
    if not wanted or chromium() is None:
        return []
    from btfref.images import save_image
    from btfref.rendering.offline.approximate import approximate
    from btfref.rendering.offline.rounding import rounding_of
    from btfref.rendering.web.context import webgl
    from btfref.representations import load
    from btfref.scene.pixel_classes import pixel_classes
    from btfref.scene.shipped import scene_file

    found: list[GateResult] = []
    ways = [way for way in environment_ways(load(file)) if way in wanted]
    if not ways:
        return found
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder) / "window.exr"
        radiance = np.zeros((*ROOM, 3), np.float32)
        radiance[WINDOW] = RADIANCE
        save_image(room, radiance)
        parameters = {"btf": str(file), "lights": "envmap", "environment": str(room), "tiling": "4"}
        scene, shared = scene_file(SCENE), {"parameters": parameters, **PICTURE}
        classes = pixel_classes(scene, **shared)
        for way in ways:
            image = webgl(scene, environment=way, **shared, **WAYS[way]).image
            exact = approximate(scene, path=way, **shared, **WAYS[way]).image
            rounding = rounding_of(scene, path=way, **shared, **WAYS[way])
            compared = compare(
                image, exact, classes=classes, gate=ENVIRONMENT_GATES, flip=False, rounding=rounding
            )
            found += [gate.named(f"{TITLE}, {way}") for gate in compared.gates]
    return found


def browser_classes(classes: np.ndarray) -> np.ndarray:
    """Pixel classes for a picture of the browser: background beside a covered pixel is a silhouette.

    SwiftShader snaps vertices to a 16th of a pixel, so that a surface may cover a sample a 32nd outside of it.

    Parameters
    ----------
    classes : (H, W) uint8 array

    Returns
    -------
    (H, W) uint8 array
    """
    covered = np.pad(classes != PixelClass.BACKGROUND, 1)
    near = sliding_window_view(covered, (3, 3)).any((2, 3))
    return np.where(near & (classes == PixelClass.BACKGROUND), np.uint8(PixelClass.SILHOUETTE), classes)


def browser_gates(
    image: np.ndarray, reference: np.ndarray, classes: np.ndarray, rounding: Rounding | None = None
) -> list[GateResult]:
    """Its gates, which say whose they are; ``rounding`` as for :func:`btfref.compare`."""
    found = compare(
        image, reference, classes=browser_classes(classes), gate=GATES, flip=False, rounding=rounding
    )
    return [gate.named(TITLE) for gate in found.gates]
