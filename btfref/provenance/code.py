"""What code and data a result depends on: found from the imports of what made it, not listed.

From a module, and from what the registry says of a method, everything is followed that may run: imports (see
:mod:`btfref.provenance.imports`), tables of ``"module:object"``, shaders that are named and what they include, data
beside modules that look for some, gates where verdicts are made. Packages of other people that bring a method count as
a whole. What the interpreter's own directories hold counts by its version.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import site
import sys
import sysconfig
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.provenance import imports
from btfref.provenance.imports import SHADERS, Imported

if TYPE_CHECKING:
    from btfref.registry import Method
    from btfref.types import Facts

#: Packages whose modules are followed wherever they are installed.
OURS = ("btfref", "mitsuba_plugins")

#: The modules that read limits, load Dr.Jit ports and shaders, and look methods up: methods bring their own to them.
GATES, DR_JIT, OPENGL = "btfref.gates.tolerances", "mitsuba_plugins.base", "btfref.rendering.gl.device"
REGISTRY = "btfref.registry"

_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"\n]+)"', re.MULTILINE)


@dataclass(frozen=True)
class Closure:
    """Everything that a result depends on, as far as code tells.

    Parameters
    ----------
    modules : frozenset of str
        Modules whose functions may run.
    files : tuple of pathlib.Path
        Those of the modules and of the packages around them, shaders, data; sorted.
    external : frozenset of str
        Top-level names of what is imported from the interpreter's own directories.
    """

    modules: frozenset[str]
    files: tuple[Path, ...]
    external: frozenset[str]


@cache
def closure(root: str, methods: tuple[str, ...] = (), places: tuple[str, ...] = ()) -> Closure:
    """The closure of a module, and of methods that it works on.

    Parameters
    ----------
    root : str
        The module that makes the result.
    methods : tuple of str
        Keys of the registry. Definition and fit of these count, ports where something loads ports of that kind, limits
        where something reads limits; those of other methods only where something imports them.
    places : tuple of str
        Further ``"module:object"`` that the module looks up by name.

    Returns
    -------
    Closure

    Raises
    ------
    ModuleNotFoundError
        When a module of the registry's is not there.
    """
    from btfref.registry import method

    rows = [method(key) for key in sorted(set(methods))]
    found = _Search(rows, places)
    found.use(Imported(root))
    for place in places:
        found.use(Imported(*place.split(":")))
    for row in rows:
        for module in (row.module, row.fit_module):
            if module:
                found.use(Imported(module))
    for row in rows:
        if DR_JIT in found.used:
            found.use(Imported(row.plugin))
        if row.image_light and "image_light" in found.used.get(REGISTRY, ()):
            found.use(Imported(*row.image_light.split(":")))
    return found.closure()


class _Search:
    """Modules by the names that are taken from them, until no new ones are found."""

    def __init__(self, rows: Sequence[Method], places: Iterable[str]) -> None:
        self.rows = rows
        self.used: dict[str, set[str]] = defaultdict(set)
        self.run: set[str] = set()
        self.external: set[str] = set()
        brought = [*places, *(m for row in rows for m in (row.module, row.plugin))]
        self.guests = {place.partition(":")[0].split(".")[0] for place in brought} - set(OURS)

    def use(self, what: Imported) -> None:
        """Count a module whose functions may run, and what it imports."""
        open_ = [what]
        while open_:
            wanted = open_.pop()
            top = wanted.module.split(".")[0]
            if not self._is_followed(top):
                self.external.add(top)
                continue
            target = self._home(wanted)
            file = module_file(target.module)
            if file is None:
                if target == what:
                    raise ModuleNotFoundError(f"no file of module {what.module!r}", name=what.module)
                continue
            # A package that only hands a name on is run all the same.
            open_ += [*self._run(wanted.module), *self._run(target.module)]
            if target.name in self.used[target.module]:
                continue
            new = not self.used[target.module]
            before = self._strings(target.module)
            self.used[target.module].add(target.name)
            text = imports.read(file, target.module)
            if new:
                open_ += text.later
            if text.lazy and not target.name:
                open_ += text.homes.values()
            places = self._strings(target.module) - before
            open_ += [Imported(*place.split(":")) for place in places if ":" in place]

    def _is_followed(self, top: str) -> bool:
        return top in OURS or top in self.guests or not is_external(top)

    def _home(self, wanted: Imported) -> Imported:
        """The module that a name is in: itself a module, or one of what its package brings in when asked."""
        inner = f"{wanted.module}.{wanted.name}"
        if wanted.name and module_file(inner) is not None:
            return Imported(inner)
        file = module_file(wanted.module)
        if file is not None and wanted.name:
            text = imports.read(file, wanted.module)
            if text.lazy and wanted.name in text.homes:
                return self._home(text.homes[wanted.name])
        return wanted

    def _run(self, module: str) -> Iterator[Imported]:
        """What is imported when a module is: by it and by the packages around it."""
        parts = module.split(".")
        for n in range(1, len(parts) + 1):
            name = ".".join(parts[:n])
            file = module_file(name)
            if name not in self.run and file is not None:
                self.run.add(name)
                yield from imports.read(file, name).now

    def _strings(self, module: str) -> set[str]:
        file = module_file(module)
        return imports.read(file, module).named(self.used[module]) if file and self.used[module] else set()

    def closure(self) -> Closure:
        """What was found, with shaders and data."""
        from btfref.platform import shader_directory

        modules = {name for name, taken in self.used.items() if taken}
        paths = {name: file for name in modules | self.run if (file := module_file(name)) is not None}
        files = set(paths.values())
        library = shader_directory().resolve()
        files |= {p for name in modules if imports.read(paths[name], name).data for p in _data(paths[name])}
        files = {path for path in files if not path.is_relative_to(library)}
        if OPENGL in modules:
            own = [
                Path(root) for row in self.rows if row.shader_package for root in _roots(row.shader_package)
            ]
            named = {s for name in modules for s in self._strings(name) if s.endswith(SHADERS)}
            files |= _included({*named, *(row.shader for row in self.rows)}, [*own, library])
        for top in self.guests:
            files |= {p.resolve() for root in _roots(top) for p in Path(root).rglob("*") if _counts(p)}
        files -= {limits.resolve() for limits in _limits()}
        if GATES in modules:
            # Limits that a method brings decide its verdicts, and nothing else.
            own_limits = (row.tolerances for row in self.rows)
            files |= {path.resolve() for path in own_limits if path is not None and path.is_file()}
        return Closure(frozenset(modules), tuple(sorted(files)), frozenset(self.external))


@cache
def module_file(module: str) -> Path | None:
    """The file of a module, found without importing it or its packages; None for what is no module, or has no file."""
    top, *inner = module.split(".")
    if not inner:
        spec = importlib.util.find_spec(top) if top else None
        origin = spec.origin if spec else None
        return Path(origin).resolve() if origin and origin.endswith(".py") else None
    for root in _roots(top):
        place = Path(root, *inner)
        for path in (place / "__init__.py", place.with_suffix(".py")):
            if path.is_file():
                return path.resolve()
    return None


@cache
def is_external(top: str) -> bool:
    """Whether a top-level module comes from the interpreter or its site-packages, and so counts by its version."""
    if top in sys.stdlib_module_names or top in sys.builtin_module_names:
        return True
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return True
    places = [spec.origin, *(spec.submodule_search_locations or [])] if spec else []
    real = [Path(place).resolve() for place in places if place and place not in ("built-in", "frozen")]
    installed = {Path(p).resolve() for p in (*sysconfig.get_paths().values(), *site.getsitepackages())}
    return not real or any(path.is_relative_to(root) for path in real for root in installed)


@cache
def _roots(top: str) -> tuple[str, ...]:
    spec = importlib.util.find_spec(top)
    return tuple(spec.submodule_search_locations or ()) if spec else ()


def _data(file: Path) -> Iterator[Path]:
    """Files beside a module and in folders below that hold no code."""
    for path in sorted(file.parent.iterdir()):
        if path.is_file() and path.suffix != ".py":
            yield path.resolve()
        elif path.is_dir() and path.name != "__pycache__" and not any(path.glob("*.py")):
            yield from (inner.resolve() for inner in sorted(path.rglob("*")) if _counts(inner))


def _counts(path: Path) -> bool:
    return path.is_file() and path.suffix != ".pyc" and "__pycache__" not in path.parts


def _limits() -> Iterator[Path]:
    from btfref.registry import methods

    return (path for row in methods().values() if (path := row.tolerances) is not None)


def _included(names: Iterable[str], directories: list[Path]) -> set[Path]:
    """Shaders and what they include; placeholders and names that are no files stand for themselves elsewhere."""
    found: set[Path] = set()
    open_ = list(names)
    while open_:
        name = open_.pop()
        path = next((d / name for d in directories if (d / name).is_file()), None)
        if path is not None and path.resolve() not in found:
            found.add(path.resolve())
            open_ += _INCLUDE.findall(path.read_text("utf-8"))
    return found


#: When this process began to load code, as far as it knows.
_BEGAN = time.time_ns()

#: File → size and time of change, and hash: as they were when a key was made of them.
_read: dict[Path, tuple[tuple[int, int], str]] = {}


@cache
def code_of(root: str, *methods: str, places: tuple[str, ...] = ()) -> str:
    """Hash of the code and the data that results of a module depend on, and of the versions of what runs it.

    Parameters
    ----------
    root : str
        The module that makes the result, such as ``"btfref.validate.cell"``.
    *methods : str
    places : tuple of str
        As of `closure`.

    Returns
    -------
    str
    """
    found = closure(root, tuple(sorted(set(methods))), places)
    digest = hashlib.sha256()
    for name, path in sorted((_place(path), path) for path in found.files):
        digest.update(f"{name}\0{_hash_of(path)}\0".encode())
    digest.update(json.dumps(external_versions(found.external), sort_keys=True).encode())
    return digest.hexdigest()


def files_of(found: Closure) -> dict[str, str]:
    """Names within their packages of a closure's files, and their SHA-256."""
    return {_place(path): _hash_of(path) for path in found.files}


def _place(path: Path) -> str:
    """A file's name within its package, so that a copy of the packages has the same keys."""
    for root in _bases():
        if path.is_relative_to(root):
            return path.relative_to(root).as_posix()
    return path.name


@cache
def _bases() -> tuple[Path, ...]:
    return (Path(__file__).resolve().parents[2], *(Path(entry or ".").resolve() for entry in sys.path))


def _hash_of(path: Path) -> str:
    if path not in _read:
        _read[path] = _state(path), hashlib.sha256(path.read_bytes()).hexdigest()
    return _read[path][1]


def _state(path: Path) -> tuple[int, int]:
    facts = path.stat()
    return facts.st_size, facts.st_mtime_ns


def changed() -> list[Path]:
    """Files that keys were made of and that changed since this process began: what runs may be something else."""
    now = time.time_ns()
    return [
        path
        for path, (state, _) in _read.items()
        if not path.is_file() or _state(path) != state or _BEGAN < state[1] <= now
    ]


def remembered() -> dict[Path, tuple[tuple[int, int], str]]:
    """What `recall` takes: the files as this process has read them."""
    return dict(_read)


def forget() -> None:
    """Read all code anew at the next question: for those who change some while they run."""
    remembering: tuple[Any, ...] = (imports.read, closure, code_of, module_file, is_external, _roots, _bases)
    for function in remembering:
        function.cache_clear()
    _read.clear()


def recall(files: dict[Path, tuple[tuple[int, int], str]]) -> None:
    """Take files as another process read them, before this one loads its code."""
    _read.update(files)


#: Modules of distributions of another name; the others are looked for in all that is installed, which takes long.
_ALIASES = {
    "PIL": "pillow",
    "sklearn": "scikit-learn",
    "maxflow": "PyMaxflow",
    "flip_evaluator": "flip-evaluator",
}


def external_versions(external: frozenset[str]) -> Facts:
    """Versions of Python, of what btfref names, of LLVM's very library, and of all distributions that are imported."""
    from btfref.platform import choose_llvm
    from btfref.provenance import versions

    library = choose_llvm().path
    real = Path(library).resolve() if library else None
    facts: Facts = {"LLVM library": [real.name, *_state(real)] if real and real.is_file() else None}
    others = sorted(external - sys.stdlib_module_names)
    return {**versions(), **facts, **{name: _distributed(name) for name in others}}


def _distributed(name: str) -> str | None:
    """Version of the distributions that bring a top-level module; None for what is not there, or in none."""
    from importlib import metadata

    if importlib.util.find_spec(name) is None:
        return None
    try:
        return metadata.version(_ALIASES.get(name, name))
    except metadata.PackageNotFoundError:
        bringing = sorted(set(_distributions().get(name, ())))
        return ", ".join(f"{which} {metadata.version(which)}" for which in bringing) or None


@cache
def _distributions() -> dict[str, list[str]]:
    from importlib import metadata

    return dict(metadata.packages_distributions())
