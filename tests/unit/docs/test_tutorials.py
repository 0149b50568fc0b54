"""The tutorials run as they are printed, block by block, and print what they say."""

import contextlib
import io
import re
import shlex

import pytest
from pages import PAGES, blocks

from btfref.cli import main

TUTORIALS = sorted((PAGES / "tutorials").glob("*.md"))


def shell(text, where):
    """Run the lines of a block, all of which call btfref, in this process: kernels that are there serve again."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        for line in text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            assert words[:1] == ["btfref"], f"{where}: not a command of btfref: {line}"
            assert main(words[1:]) == 0, f"{where}: {line}\n{err.getvalue()}"
    return out.getvalue()


def matches(printed, promised):
    """Whether the output is that of a `text` block, in which … stands for anything on a line."""
    pattern = ".*".join(re.escape(part) for part in promised.strip().split("…"))
    return re.fullmatch(pattern, printed.strip()) is not None


def run(tutorial):
    """Run a page in the current folder; returns the number of blocks that ran and of outputs that were compared."""
    names, printed, ran, compared = {"__name__": "__main__"}, "", 0, 0
    for block in blocks(tutorial):
        if block.language == "text":
            assert matches(printed, block.text), f"{tutorial.name}:{block.line}: it printed\n{printed}"
            compared += 1
            continue
        if block.language == "sh":
            printed = shell(block.text, f"{tutorial.name}:{block.line}")
        else:
            assert block.language == "python", (
                f"{tutorial.name}:{block.line}: {block.language or 'no language'}"
            )
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(block.text, f"{tutorial.name}:{block.line}", "exec"), names)
            printed = out.getvalue()
        ran += 1
    return ran, compared


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_the_tutorial_runs(tutorial, tmp_path, monkeypatch, need):
    need("llvm")
    need("gl")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BTFREF_CACHE", str(tmp_path / "cache"))
    ran, _ = run(tutorial)
    assert ran >= 5


def test_there_are_three():
    assert [path.stem for path in TUTORIALS] == ["first-picture", "own-arrays", "own-renderer"]


@pytest.mark.parametrize(
    "text",
    [
        "```python\nprint(1)\n```\n\n```text\n2\n```\n",
        "```python\nprint('is off by 3 %, more')\n```\n\n```text\nis off by … %\n```\n",
        "```sh\nbtfref info nothing.exr\n```\n",
        "```sh\nbtfref info nothing.exr\nbtfref --version\n```\n",
        "```sh\nls\n```\n",
        "```\nno language\n```\n",
    ],
)
def test_a_page_that_is_wrong_fails(text, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(AssertionError):
        run(page)
