"""Types that many signatures share."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

#: What names a file.
PathLike = str | os.PathLike[str]

#: A scene: Mitsuba's file, the name of a shipped one, or Mitsuba's dictionary.
SceneLike = PathLike | dict[str, Any]

#: Called as ``progress(done, total, label)``.
Progress = Callable[[int, int, str], object]

#: JSON-able facts: parameters, attributes, manifests.
Facts = dict[str, Any]

#: An array, mask or vector of Dr.Jit, or an object of Mitsuba: its class depends on the variant set at run time.
JitArray = Any
