"""What this machine and this installation offer: the LLVM that Dr.Jit may load, and the shader directory."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import MissingDependencyError

if TYPE_CHECKING:
    from btfref.types import PathLike

#: LLVM 14 to 16 abort the process under Dr.Jit 1.5 on AVX-512 machines ("Cannot select … fminimum").
MINIMUM_LLVM = 17

_SEARCH = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
)


@dataclass(frozen=True)
class LLVMChoice:
    """The LLVM library that Dr.Jit is given, and why.

    Parameters
    ----------
    path : str or None
        Library to load; None when this machine has no usable one.
    version : int or None
        Its major version, None when the file name does not tell.
    reason : str
        One clause for the reader of ``btfref doctor``.
    refused : tuple of (int, str)
        Major version and path of each library found that must not be loaded.
    """

    path: str | None
    version: int | None
    reason: str
    refused: tuple[tuple[int, str], ...]


def llvm_version(path: PathLike) -> int | None:
    """Major version of an LLVM shared library, read from its real file name.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    int or None
    """
    match = re.search(r"libLLVM(?:\.so\.|-)(\d+)", Path(os.path.realpath(path)).name)
    return int(match.group(1)) if match else None


def find_llvm(patterns: Iterable[str] = _SEARCH) -> list[tuple[int, str]]:
    """All LLVM libraries on this machine as ``(major version, path)``, newest first."""
    found: dict[str, tuple[int, str]] = {}
    for pattern in patterns:
        for path in sorted(glob.glob(pattern)):
            version = llvm_version(path)
            if version is not None and os.path.exists(path):
                found.setdefault(os.path.realpath(path), (version, path))
    return sorted(found.values(), reverse=True)


@cache
def _installed_llvm() -> tuple[tuple[int, str], ...]:
    """The libraries of this machine, looked for once: every render and fit asks."""
    return tuple(find_llvm())


def choose_llvm(
    environment: Mapping[str, str] | None = None, found: Sequence[tuple[int, str]] | None = None
) -> LLVMChoice:
    """Decide which LLVM library Dr.Jit is to load; loads nothing itself.

    Parameters
    ----------
    environment : mapping, optional
        Where ``DRJIT_LIBLLVM_PATH`` is looked up; the process environment by default.
    found : list of (int, str), optional
        Candidates as `find_llvm` gives them, newest first.

    Returns
    -------
    LLVMChoice
    """
    given = (os.environ if environment is None else environment).get("DRJIT_LIBLLVM_PATH")
    found = _installed_llvm() if found is None else found
    refused = tuple(candidate for candidate in found if candidate[0] < MINIMUM_LLVM)
    passed_over = ""
    if given:
        version = llvm_version(given)
        if not os.path.exists(given):
            passed_over = f"DRJIT_LIBLLVM_PATH names {given}, which is not there; "
        elif version is not None and version < MINIMUM_LLVM:
            passed_over = f"DRJIT_LIBLLVM_PATH names LLVM {version}, which aborts the process; "
        else:
            return LLVMChoice(given, version, "named by DRJIT_LIBLLVM_PATH", refused)
    for version, path in found:
        if version >= MINIMUM_LLVM:
            reason = f"{passed_over}newest found of version {MINIMUM_LLVM} or later"
            return LLVMChoice(path, version, reason, refused)
    return LLVMChoice(None, None, f"{passed_over}none found of version {MINIMUM_LLVM} or later", refused)


def prepare_llvm() -> str:
    """Point Dr.Jit at an LLVM library that works; call before Dr.Jit loads one.

    Returns
    -------
    str
        Path of the chosen library. ``DRJIT_LIBLLVM_PATH`` is respected when it names a usable version.

    Raises
    ------
    MissingDependencyError
        When no LLVM of version 17 or later is there.
    """
    choice = choose_llvm()
    if choice.path is None:
        there = ", ".join(str(version) for version, _ in choice.refused)
        raise MissingDependencyError(
            f"no LLVM library of version {MINIMUM_LLVM} or later for Mitsuba's llvm variants"
            + (f" (found {there}, which abort the process)" if there else ""),
            "install libllvm19 (or newer) or set DRJIT_LIBLLVM_PATH",
        )
    os.environ["DRJIT_LIBLLVM_PATH"] = choice.path
    return choice.path


def use_processors(threads: int) -> None:
    """Tell Dr.Jit how many threads it may use, at least two: with one Mitsuba waits forever for an OpenEXR file.

    Parameters
    ----------
    threads : int
    """
    import drjit as dr

    wanted = max(2, threads)
    if dr.thread_count() != wanted:
        dr.set_thread_count(wanted)


def set_variant(name: str) -> None:
    """Set a variant of Mitsuba.

    Parameters
    ----------
    name : str
        One of ``mitsuba.variants()``.

    Raises
    ------
    MissingDependencyError
        Where this machine lacks what the variant computes with.
    """
    import mitsuba as mi

    try:
        mi.set_variant(name)
    except (ImportError, RuntimeError) as error:
        what = "a CUDA device" if name.startswith("cuda") else "a library"
        said = " ".join(str(error).split())
        raise MissingDependencyError(
            f"{what} is missing for Mitsuba's variant {name} ({said})",
            "see btfref doctor, or use llvm_ad_rgb",
        ) from error


def shader_directory() -> Path:
    """Directory of the GLSL library: ``shaders/`` of a checkout, else the copy inside the installed package.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    MissingDependencyError
        When neither is there, so the installation is broken.
    """
    package = Path(__file__).resolve().parent
    for candidate in (package / "_shaders", package.parent / "shaders"):
        if (candidate / "lib").is_dir():
            return candidate
    raise MissingDependencyError("the shaders of btfref are not in this installation", "reinstall btfref")
