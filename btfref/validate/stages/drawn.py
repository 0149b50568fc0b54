"""Code behind what is drawn with OpenGL or in a browser: its hash holds the driver and the browser."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING

from btfref.provenance import code
from btfref.system import chromium
from btfref.validate.cache import key_of

if TYPE_CHECKING:
    from btfref.types import Facts


def code_of(root: str, *methods: str) -> str:
    """`btfref.provenance.code.code_of`, the OpenGL driver and the browser."""
    return key_of({"code": code.code_of(root, *methods), "driver": driver()})


def driver() -> str:
    """The OpenGL driver (vendor, renderer, version), or why there is none, and the browser; asked for once a run."""
    if not _told:
        _told.append(_asked())
    return _told[0]


#: The driver, where it was asked for, by this process or by the one that started it.
_told: list[str] = []


def _asked() -> str:
    from btfref.errors import MissingDependencyError
    from btfref.rendering.gl import device

    try:
        told = json.dumps(device.facts(device.context()), sort_keys=True)
    except MissingDependencyError as error:
        told = str(error)
    return f"{told}; {_browser()}"


def _browser() -> str:
    """What Chromium says of its version: what draws WebGL 2 comes with it."""
    program = chromium()
    if program is None:
        return "no browser"
    try:
        said = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"browser: {error}"
    return said.stdout.strip()


def found() -> Facts:
    """What `recall` takes: the driver and the files of code as this process found them."""
    return {"driver": driver(), "files": code.remembered()}


def recall(facts: Facts) -> None:
    """Take from the process that started this one what it found, before any code of a result is loaded."""
    _told[:] = [facts["driver"]]
    code.recall(facts["files"])
