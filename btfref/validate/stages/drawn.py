"""Code behind what is drawn with OpenGL: its hash holds the driver."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from btfref.provenance import code
from btfref.validate.cache import key_of

if TYPE_CHECKING:
    from btfref.types import Facts


def code_of(root: str, *methods: str) -> str:
    """`btfref.provenance.code.code_of`, and the OpenGL driver."""
    return key_of({"code": code.code_of(root, *methods), "driver": driver()})


def driver() -> str:
    """Vendor, renderer and version of the OpenGL driver, or why there is none; asked for once a run."""
    if not _told:
        _told.append(_asked())
    return _told[0]


#: The driver, where it was asked for, by this process or by the one that started it.
_told: list[str] = []


def _asked() -> str:
    from btfref.errors import MissingDependencyError
    from btfref.rendering.gl import device

    try:
        return json.dumps(device.facts(device.context()), sort_keys=True)
    except MissingDependencyError as error:
        return str(error)


def found() -> Facts:
    """What `recall` takes: the driver and the files of code as this process found them."""
    return {"driver": driver(), "files": code.remembered()}


def recall(facts: Facts) -> None:
    """Take from the process that started this one what it found, before any code of a result is loaded."""
    _told[:] = [facts["driver"]]
    code.recall(facts["files"])
