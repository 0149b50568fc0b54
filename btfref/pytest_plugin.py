"""The pytest plugin: fixture ``matches_reference``, option ``--btfref-report``."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import numpy as np

    from btfref.comparison import Comparison
    from btfref.types import PathLike


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.getgroup("btfref").addoption(
        "--btfref-report", metavar="FOLDER", help="write a page for every picture that fails its reference"
    )


@pytest.fixture
def matches_reference(request: pytest.FixtureRequest) -> Callable[..., Comparison]:
    """`btfref.testing.assert_matches_reference`, with a page for failures where the command line asks for it."""
    folder, count = request.config.getoption("--btfref-report"), 0

    def check(image: PathLike | np.ndarray, scene: PathLike, **arguments: Any) -> Comparison:
        from btfref.testing import assert_matches_reference

        __tracebackhide__ = True
        nonlocal count
        count += 1
        if folder and "report" not in arguments:
            Path(folder).mkdir(parents=True, exist_ok=True)
            name = re.sub(r"\W+", "_", request.node.name)
            arguments["report"] = Path(folder) / f"{name}.{count}.html"
        return assert_matches_reference(image, scene, **arguments)

    return check
