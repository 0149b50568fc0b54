"""What a result was made from: code, and versions of what runs it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from btfref.registry import Method

__version__ = "0.2.0"

#: Distributions whose version can change a result; recorded in every artefact.
RELEVANT = (
    "numpy",
    "scipy",
    "mitsuba",
    "drjit",
    "OpenEXR",
    "zarr",
    "trimesh",
    "moderngl",
    "scikit-learn",
    "PyMaxflow",
    "flip-evaluator",
)

#: The library that compiles the kernels of Mitsuba's llvm variants; no distribution of Python's, so asked for apart.
#: Likewise the OpenGL driver, which only those know who have a context: it stands in what they make, as ``gl_…``.
LLVM = "LLVM"


def versions(names: Iterable[str] = (*RELEVANT, LLVM)) -> dict[str, str | None]:
    """Versions of btfref, Python and what is installed, read from metadata without importing anything of it.

    Parameters
    ----------
    names : iterable of str, optional
        Names of distributions, and `LLVM` for the library that Dr.Jit is given; what is not there maps to None.

    Returns
    -------
    dict of str to str or None
        ``btfref`` and ``python`` first, then `names` in their order.
    """
    import platform
    from importlib import metadata

    found: dict[str, str | None] = {"btfref": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = _llvm() if name == LLVM else metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def _llvm() -> str | None:
    """Major version of LLVM, or the file where its name does not tell."""
    from pathlib import Path

    from btfref.platform import choose_llvm

    choice = choose_llvm()
    if choice.path is None or choice.version is not None:
        return None if choice.version is None else str(choice.version)
    return Path(choice.path).name


#: Stage → the code that its results depend on, besides that of the stages before: folders and files of the packages.
CODE = {
    "material": (
        "btfref/numerics",
        "btfref/mesostructure",
        "btfref/sampling",
        "btfref/conventions.py",
        "btfref/precision.py",
        "btfref/validate/material.py",
    ),
    "fit": ("btfref/representations",),
    "picture": (
        "btfref/rendering",
        "btfref/scene",
        "btfref/images",
        "btfref/gates",
        "btfref/comparison",
        "btfref/stress",
        "btfref/validate",
        "mitsuba_plugins",
        "shaders",
    ),
}

#: Stages that a stage builds upon.
BEFORE = {"material": (), "fit": ("material",), "picture": ("material", "fit")}


@cache
def code_of(stage: str, method: str | None = None) -> str:
    """Hash of the code that results of a stage depend on.

    Parameters
    ----------
    stage : {"material", "fit", "picture"}
    method : str, optional
        Registry key: its three files count, and for pictures its limits; those of other methods never do.

    Returns
    -------
    str
    """
    import hashlib
    import json

    from btfref.registry import methods

    rows = methods()
    limits = {key: [row.tolerances.resolve()] if row.tolerances else [] for key, row in rows.items()}
    owned = {path for key, row in rows.items() for path in (*method_files(row), *limits[key])}
    stages = (*BEFORE[stage], stage)
    files = [path for name in stages for place in CODE[name] for path in _files(place) if path not in owned]
    if method is not None:
        files += method_files(rows[method])
        if stage == "picture":  # a limit decides a verdict, and no fit
            files += [path for path in limits[method] if path.is_file()]
    digest = hashlib.sha256()
    for path in sorted(set(files)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    digest.update(json.dumps(versions(), sort_keys=True).encode())
    return digest.hexdigest()


def method_files(row: Method) -> list[Path]:
    """Files of a method: fit module, Dr.Jit port, GLSL port; all of its package where that is a third party's."""
    import importlib.util
    from pathlib import Path

    from btfref.platform import shader_directory

    found = []
    for module in (row.module, row.plugin):
        spec = importlib.util.find_spec(module)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(f"no file of module {module!r}", name=module)
        place = Path(spec.origin)
        if module.split(".")[0] in ("btfref", "mitsuba_plugins"):
            found.append(place)
        else:
            top = importlib.util.find_spec(module.split(".")[0])
            roots = [] if top is None else list(top.submodule_search_locations or [])
            found += [p for root in roots for p in Path(root).rglob("*") if _is_code(p)] or [place]
    if not row.shader_package:
        found.append(shader_directory() / row.shader)
    return [path.resolve() for path in found]


def _files(place: str) -> list[Path]:
    from pathlib import Path

    from btfref.platform import shader_directory

    packages = Path(__file__).resolve().parents[1]
    root = shader_directory() if place == "shaders" else packages / place
    return (
        [root.resolve()] if root.is_file() else [p.resolve() for p in sorted(root.rglob("*")) if _is_code(p)]
    )


def _is_code(path: Path) -> bool:
    return path.suffix in (".py", ".glsl", ".vert", ".frag", ".toml", ".xml", ".ply", ".csv")
