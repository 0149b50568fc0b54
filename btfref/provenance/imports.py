"""What a module imports, read from its text: nothing is run.

Imports inside functions count, since the code puts heavy ones there. Those under ``TYPE_CHECKING`` are never run and do
not count, but for a package that brings in its names when they are asked for (``__getattr__``): there they tell where
each name comes from. Text of the form ``"module:object"`` names what a table imports later.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

#: Files of GLSL, as modules name them.
SHADERS = (".glsl", ".vert", ".frag")

#: ``"module:object"``.
_PLACE = re.compile(r"[A-Za-z_]\w*(?:\.\w+)*:[A-Za-z_]\w*")

#: A module whose text holds neither a place nor the name of a shader need not be searched for them.
_WORTH = re.compile(rb"""["'](?:[\w.]+:\w+|[\w./]+\.(?:glsl|vert|frag))["']""")

#: A module that looks for data beside itself.
_DATA = re.compile(rb"\b__file__\b|\bresources\b|\bpkgutil\b")

#: Fields of statements that hold statements.
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")


@dataclass(frozen=True)
class Imported:
    """One import.

    Parameters
    ----------
    module : str
        Absolute name.
    name : str
        What is taken from it; "" for the module itself, or all of it.
    """

    module: str
    name: str = ""


@dataclass
class Text:
    """What the text of a module says.

    Parameters
    ----------
    now : list of Imported
        Imported when the module is.
    later : list of Imported
        Imported by its functions.
    homes : dict of str to Imported
        Names imported under ``TYPE_CHECKING``.
    lazy : bool
        The module brings in names when they are asked for.
    strings : dict of str to set of str
        Places and names of shaders by the top-level class that holds them, "" for what is in none.
    names : dict of str to set of str
        Names that each of these mentions, where there are such strings; those of base classes included.
    data : bool
        It looks for files beside itself.
    """

    now: list[Imported] = field(default_factory=list)
    later: list[Imported] = field(default_factory=list)
    homes: dict[str, Imported] = field(default_factory=dict)
    lazy: bool = False
    strings: dict[str, set[str]] = field(default_factory=dict)
    names: dict[str, set[str]] = field(default_factory=dict)
    data: bool = False

    def named(self, wanted: Iterable[str]) -> set[str]:
        """Strings that count where these names are taken from the module, "" for all of it.

        Those outside of classes count always; those of a class where it is taken, or mentioned by what counts.
        """
        classes = set(self.strings) | set(self.names)
        if "" in (asked := set(wanted)):
            counted = classes
        else:
            counted, open_ = set(), {"", *asked & classes}
            while open_:
                counted |= open_
                open_ = {c for o in open_ for c in self.names.get(o, set()) & classes} - counted
        return {text for owner in counted for text in self.strings.get(owner, set())}


@cache
def read(path: Path, module: str) -> Text:
    """The imports of a module's file.

    Parameters
    ----------
    path : pathlib.Path
    module : str
        Its absolute name; relative imports start there.

    Returns
    -------
    Text
    """
    source = path.read_bytes()
    tree = ast.parse(source, filename=str(path))
    found = Text(data=bool(_DATA.search(source)))
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    _walk(tree.body, found, found.now, package)
    found.lazy = any(isinstance(node, ast.FunctionDef) and node.name == "__getattr__" for node in tree.body)
    if _WORTH.search(source):
        for node in tree.body:
            owner = node.name if isinstance(node, ast.ClassDef) else ""
            found.strings.setdefault(owner, set()).update(_strings(node))
            found.names.setdefault(owner, set()).update(
                inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)
            )
    return found


def _walk(statements: Iterable[ast.stmt], found: Text, target: list[Imported], package: str) -> None:
    for node in statements:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            target += _imports(node, package)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            _walk(node.body, found, found.later, package)
        elif isinstance(node, ast.If) and _never_run(node.test):
            for inner in node.body:
                if isinstance(inner, (ast.Import, ast.ImportFrom)):
                    names = [alias.asname or alias.name for alias in inner.names]
                    found.homes |= dict(zip(names, _imports(inner, package), strict=True))
            _walk(node.orelse, found, target, package)
        else:
            for block in _BLOCKS:
                _walk(getattr(node, block, ()), found, target, package)


def _never_run(test: ast.expr) -> bool:
    return getattr(test, "id", getattr(test, "attr", None)) == "TYPE_CHECKING"


def _imports(node: ast.Import | ast.ImportFrom, package: str) -> list[Imported]:
    if isinstance(node, ast.Import):
        return [Imported(alias.name) for alias in node.names]
    base = node.module or ""
    if node.level:
        above = package.split(".")[: len(package.split(".")) - node.level + 1]
        base = ".".join([*above, base] if base else above)
    return [Imported(base, "" if alias.name == "*" else alias.name) for alias in node.names]


def _strings(node: ast.AST) -> Iterator[str]:
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            text = inner.value
            if _PLACE.fullmatch(text) or (text.endswith(SHADERS) and " " not in text):
                yield text
