"""What `btfref fit METHOD --help` prints: the parameters of a method, from the docstring of its fit."""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

from btfref.commands.shared.options import WIDTH, entries
from btfref.registry import Method, broken_points, methods

#: How a docstring says that another one describes a parameter.
_ELSEWHERE = re.compile(r"[Ss]ee :\w+:`~?([\w.]+)`")


def methods_help() -> list[str]:
    """All methods, those of installed packages too, and packages whose methods cannot be had."""
    return [
        "methods (btfref fit METHOD --help: the parameters of one):",
        *entries({key: f"{row.title}; {row.paper}" for key, row in methods().items()}),
        *(f"  {point}" for point in broken_points()),
        "",
    ]


def method_help(row: Method) -> str:
    """Title, parameters with types, defaults and meaning, and presets of a method."""
    documented = parameters_of(row.fit)
    lines = [
        f"usage: btfref fit {row.key} BTF -o FILE.exr [--preset NAME] [--set KEY=VALUE ...]",
        "",
        f"{row.title}; {row.paper}",
        "",
    ]
    for paragraph in summary_of(row.fit):
        lines += [*textwrap.wrap(plain(paragraph), WIDTH), ""]
    lines.append("parameters (--set KEY=VALUE):")
    shown = {}
    for name, default in row.parameters.items():
        kind, text = documented.get(name, ("", ""))
        words = [f"{plain(kind)}." if kind else "", plain(text)]
        shown[f"{name}={typed(default)}"] = " ".join(word for word in words if word)
    lines += entries(shown) if shown else ["  none"]
    lines += ["", "presets (--preset NAME; --set goes before them):"]
    lines += entries({name: preset_text(values) for name, values in row.presets.items()})
    return "\n".join([*lines, "", "All options: btfref fit --help", ""])


def preset_text(values: dict[str, Any]) -> str:
    """The parameters that a preset sets, as they are typed."""
    return " ".join(f"{key}={typed(value)}" for key, value in values.items()) or "the defaults"


def typed(value: Any) -> str:
    """A value as `--set KEY=VALUE` reads it."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"), default=str)


def summary_of(documented: Callable[..., Any]) -> Iterator[str]:
    """The paragraphs of a docstring before its first section."""
    for paragraph in re.split(r"\n\s*\n", inspect.getdoc(documented) or ""):
        if re.search(r"\n-{3,}", paragraph):
            return
        yield " ".join(paragraph.split())


def parameters_of(documented: Callable[..., Any]) -> dict[str, tuple[str, str]]:
    """Parameters of a function or class by name, with type and description, from its numpydoc docstring.

    A description "see :func:`other`" is followed; what is described nowhere is left out.
    """
    found: dict[str, tuple[str, str]] = {}
    for names, kind, text in _entries(inspect.getdoc(documented) or ""):
        elsewhere = _ELSEWHERE.search(text)
        other = parameters_of(_resolved(elsewhere[1], documented)) if elsewhere and not kind else {}
        found |= {name: other.get(name, (kind, text)) for name in names}
    return found


def _entries(text: str) -> Iterator[tuple[list[str], str, str]]:
    """Names, type and description of each entry of the sections Parameters and Attributes."""
    lines = text.splitlines()
    underlines = [n for n, line in enumerate(lines) if re.fullmatch(r"-{3,}", line.strip()) and n]
    for at, end in zip(underlines, [*(n - 1 for n in underlines[1:]), len(lines)], strict=True):
        if lines[at - 1].strip() not in ("Parameters", "Attributes"):
            continue
        for entry in re.split(r"\n(?=\S)", "\n".join(lines[at + 1 : end]).strip("\n")):
            head, _, body = entry.partition("\n")
            names, _, kind = head.partition(" : ")
            yield [name.strip(" *") for name in names.split(",")], kind.strip(), " ".join(body.split())


def _resolved(name: str, documented: Callable[..., Any]) -> Any:
    """What a docstring refers to: a name of its module, or a dotted one."""
    module, _, last = name.rpartition(".")
    return getattr(import_module(module or documented.__module__), last)


def plain(text: str) -> str:
    """Text of a docstring without its markup."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"\1", text)
    text = re.sub(r"`+([^`]*)`+", r"\1", text)
    return re.sub(r'"(\w+)"', r"\1", text)  # choices are typed without quotes
