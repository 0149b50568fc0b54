"""The example of another project's continuous integration, as its page prints it, judges the floats of a browser."""

import shlex

import numpy as np
import pytest
from pages import PAGES, blocks

from btfref.cli import main
from btfref.rendering.web.context import webgl
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("renderers")

PAGE = PAGES / "guide" / "your-renderer.md"
HEADING = "### In continuous integration"


@pytest.fixture(scope="module")
def example():
    """Blocks of the section: JavaScript, workflow, picture, judgement, test."""
    text = PAGE.read_text("utf-8")
    start = text.count("\n", 0, text.index(HEADING)) + 1
    found = [block for block in blocks(PAGE) if block.line > start]
    assert [block.language for block in found[:5]] == ["js", "yaml", "python", "sh", "python"]
    return found[:5]


@pytest.fixture(scope="module")
def frame(fits, need):
    """What the other project's page draws: the browser's picture, lowest row first, with alpha."""
    need("chromium")
    parameters = {"btf": str(fits.path("lpca")), "lights": "points2"}
    image = webgl(scene_file("sphere"), parameters=parameters, grid=4, size=(64, 64), shadows=False).image
    return np.concatenate([image[::-1], np.ones((64, 64, 1), np.float32)], -1).astype("<f4")


def test_the_example_judges_a_frame(example, frame, fits, tmp_path, monkeypatch, matches_reference):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BTFREF_CACHE", "references")
    (tmp_path / "checker.lpca.exr").write_bytes(fits.path("lpca").read_bytes())
    _, workflow, picture, judgement, test = (block.text for block in example)
    (command,) = judgement.replace("\\\n", " ").splitlines()
    names = {}
    exec(compile(test, PAGE.name, "exec"), names)
    for factor in (1.0, 1.05):
        (factor * frame).astype("<f4").tofile("frame.f32")
        exec(compile(picture, PAGE.name, "exec"), {})
        assert main([*shlex.split(command)[1:], "--overwrite"]) == (0 if factor == 1 else 1)
        if factor == 1:
            names["test_frame"](matches_reference)
        else:
            with pytest.raises(AssertionError, match=r"image\.browser"):
                names["test_frame"](matches_reference)
    for name in ("frame.py", "judge.sh", "test_frame.py"):
        assert name in workflow
