"""The picture of real time drawn once more, by WebGL 2 in a headless Chromium: where there is one."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from btfref.comparison import compare
from btfref.errors import MissingDependencyError
from btfref.system import CHROMIUM, chromium, mend_command

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from btfref.gates.verdicts import GateResult
    from btfref.rendering import RenderResult
    from btfref.types import Facts
    from btfref.validate.matrix import Settings

#: Gates of such a picture against the reference: its rasterizer is coarser than OpenGL's.
GATES = ("image.browser", "image.browser_edges", "image.background")

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


def browser_gates(image: np.ndarray, reference: np.ndarray, classes: np.ndarray) -> list[GateResult]:
    """Its gates, which say whose they are."""
    found = compare(image, reference, classes=classes, gate=GATES, flip=False)
    return [gate.named(TITLE) for gate in found.gates]
