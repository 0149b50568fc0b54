"""What tests read in the documentation: pages, their blocks, the command lines they show."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "btfref" / "docs" / "pages"


class Block(NamedTuple):
    """A fenced block: its language, its text, the line it starts in."""

    language: str
    text: str
    line: int


def documents():
    """README and all pages, and what else of the top is for people."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(PAGES.rglob("*.md"))]


def blocks(path):
    """The fenced blocks of a page."""
    text = path.read_text("utf-8")
    found = re.finditer(r"^```(\w*)[^\n]*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [Block(m[1], m[2], text.count("\n", 0, m.start()) + 1) for m in found]


def command_lines(path):
    """The lines that call btfref, in shell blocks; a backslash at the end joins the next one."""
    shell = "\n".join(b.text for b in blocks(path) if b.language == "sh").replace("\\\n", " ")
    return re.findall(r"^(?:\.venv/bin/)?(btfref .*)$", shell, re.MULTILINE)
