"""What a result was made from: versions of what runs it; :mod:`btfref.provenance.code` finds its code and data."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

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

    found: dict[str, str | None] = {"btfref": __version__, "python": platform.python_version()}
    for name in names:
        found[name] = _llvm() if name == LLVM else _installed(name)
    return found


@cache  # of a process: every artefact asks, and what is imported stays
def _installed(name: str) -> str | None:
    """Version of a distribution."""
    from importlib import metadata

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _llvm() -> str | None:
    """Major version of LLVM, or the file where its name does not tell."""
    from pathlib import Path

    from btfref.platform import choose_llvm

    choice = choose_llvm()
    if choice.path is None or choice.version is not None:
        return None if choice.version is None else str(choice.version)
    return Path(choice.path).name
