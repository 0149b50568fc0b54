"""What this machine offers: the LLVM library that Dr.Jit may load."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path

from btfref.errors import MissingDependencyError

#: LLVM 14 to 16 abort the process under Dr.Jit 1.5 on AVX-512 machines ("Cannot select … fminimum").
MINIMUM_LLVM = 17

_SEARCH = ("/usr/lib/*/libLLVM*.so*", "/usr/lib/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*")


def llvm_version(path):
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


def find_llvm():
    """All LLVM libraries on this machine as ``(major version, path)``, newest first."""
    found = {}
    for pattern in _SEARCH:
        for path in glob.glob(pattern):
            version = llvm_version(path)
            if version is not None:
                found.setdefault(os.path.realpath(path), (version, path))
    return sorted(found.values(), reverse=True)


def prepare_llvm():
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
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        version = llvm_version(given)
        if version is None or version >= MINIMUM_LLVM:
            return given
    for version, path in find_llvm():
        if version >= MINIMUM_LLVM:
            os.environ["DRJIT_LIBLLVM_PATH"] = path
            return path
    raise MissingDependencyError(
        f"no LLVM library of version {MINIMUM_LLVM} or later for Mitsuba's llvm variants",
        "install libllvm19 (or newer) or set DRJIT_LIBLLVM_PATH",
    )
