"""System libraries and programs that pip cannot bring: what is missing, and the apt command that brings it.

Only the standard library is used, since the Makefile asks before anything else is known to work.
"""

from __future__ import annotations

import ctypes
import glob
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from btfref.errors import MissingDependencyError
from btfref.platform import MINIMUM_LLVM, choose_llvm

#: The LLVM package asked for when apt cannot be queried.
DEFAULT_LLVM_PACKAGE = "libllvm19"

#: A download that breaks off is tried again; another apt, such as the daily one, is waited for.
PATIENCE = ("-o", "Acquire::Retries=3", "-o", "DPkg::Lock::Timeout=120")


@dataclass(frozen=True)
class Requirement:
    """One thing that the operating system must bring.

    Parameters
    ----------
    name : str
        What it is, for a reader.
    packages : tuple of str
        Debian and Ubuntu packages that bring it.
    present : callable
        Returns whether it is there, from actual files.
    for_tests : bool
        Needed by the test suite only.
    """

    name: str
    packages: tuple[str, ...]
    present: Callable[[], bool]
    for_tests: bool = False


def _loads(library: str) -> bool:
    """Whether the dynamic loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _has_gl_driver() -> bool:
    """Whether Mesa's DRI driver or NVIDIA's EGL library is there; libEGL itself is only a dispatcher."""
    patterns = (
        "/usr/lib/*/dri/*_dri.so",
        "/usr/lib/dri/*_dri.so",
        "/usr/lib64/dri/*_dri.so",
        "/usr/lib/*/libEGL_nvidia.so.*",
    )
    return any(glob.glob(pattern) for pattern in patterns)


def chromium() -> str | None:
    """Path of a Chromium or Chrome that can run headless, or None."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next((path for path in map(shutil.which, names) if path), None)


LLVM = Requirement(
    f"LLVM {MINIMUM_LLVM} or later", (DEFAULT_LLVM_PACKAGE,), lambda: choose_llvm().path is not None
)

#: For WebGL 2; the tests also open reports in it.
CHROMIUM = Requirement("Chromium", ("chromium",), lambda: chromium() is not None, True)

REQUIREMENTS = (
    LLVM,
    # Dr.Jit's extension links against it; GCC's runtime libraries of a minimal system lack it.
    Requirement("libatomic", ("libatomic1",), lambda: _loads("libatomic.so.1")),
    Requirement("libEGL", ("libegl1",), lambda: _loads("libEGL.so.1")),
    Requirement("libGL", ("libgl1",), lambda: _loads("libGL.so.1")),
    Requirement("libGLESv2", ("libgles2",), lambda: _loads("libGLESv2.so.2")),
    Requirement("an OpenGL driver", ("libgl1-mesa-dri", "libegl-mesa0"), _has_gl_driver),
    Requirement(
        "glslangValidator", ("glslang-tools",), lambda: shutil.which("glslangValidator") is not None, True
    ),
    CHROMIUM,
)


def missing(tests: bool = False) -> list[Requirement]:
    """Requirements that this machine does not meet.

    Parameters
    ----------
    tests : bool
        Include what only the test suite needs.

    Returns
    -------
    list of Requirement
    """
    return [
        requirement
        for requirement in REQUIREMENTS
        if (tests or not requirement.for_tests) and not requirement.present()
    ]


def llvm_package(listing: str) -> str | None:
    """LLVM package to install, given the output of ``apt-cache pkgnames libllvm``.

    Version 19, which the tests run with, if offered; else the newest; None when no version is usable.
    """
    versions = [int(number) for number in re.findall(r"^libllvm(\d+)(?:t64)?$", listing, re.MULTILINE)]
    usable = [version for version in versions if version >= MINIMUM_LLVM]
    if not usable:
        return None
    names = set(listing.split())
    name = f"libllvm{19 if 19 in usable else max(usable)}"
    return name if name in names else f"{name}t64"


def packages(requirements: Iterable[Requirement], listing: str = "") -> list[str]:
    """Packages that bring `requirements`, each once; `listing` is apt's list of ``libllvm…`` packages."""
    names = []
    for requirement in requirements:
        for name in requirement.packages:
            if name == DEFAULT_LLVM_PACKAGE:
                name = llvm_package(listing) or name
            if name not in names:
                names.append(name)
    return names


def mend_command(requirements: Iterable[Requirement]) -> str:
    """The shell line that brings `requirements` on Debian or Ubuntu."""
    return "sudo apt-get install -y --no-install-recommends " + " ".join(packages(requirements))


def install(
    requirements: Sequence[Requirement], run: Callable[..., subprocess.CompletedProcess] = subprocess.run
) -> list[str]:
    """Bring `requirements` with apt, as root or through sudo.

    Parameters
    ----------
    requirements : list of Requirement
    run : callable
        Stands in for `subprocess.run` in tests.

    Returns
    -------
    list of str
        The packages that were installed; empty when nothing was asked for.

    Raises
    ------
    MissingDependencyError
        Without apt, without the right to use it, or when apt fails; the message has the line to run by hand.
    """
    if not requirements:
        return []
    names = ", ".join(requirement.name for requirement in requirements)
    trouble = MissingDependencyError(
        f"missing on this machine: {names}", f"run: {mend_command(requirements)}"
    )
    if shutil.which("apt-get") is None:
        raise trouble
    prefix = []
    if os.geteuid() != 0:
        # Without a terminal sudo must not wait for a password that nobody can type.
        if shutil.which("sudo") is None or run(["sudo", "-n", "true"], capture_output=True).returncode != 0:
            raise trouble
        prefix = ["sudo", "-n"]
    apt = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", *PATIENCE]
    # Lists may be absent (container images) or stale: refresh, and let the installation itself decide.
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    run([*apt, "update", "-qq"], **quiet)
    listing = run(["apt-cache", "pkgnames", "libllvm"], capture_output=True, text=True).stdout or ""
    wanted = packages(requirements, listing)
    command = [*apt, "install", "-y", "-qq", "--no-install-recommends", *wanted]
    done = run(command, **quiet)
    if done.returncode != 0 or any(not requirement.present() for requirement in requirements):
        # What apt complained of, its own warnings left out.
        said = [line for line in (done.stderr or "").splitlines() if line.startswith("E: ")]
        raise MissingDependencyError(" ".join([trouble.what, *said[-1:]]), trouble.mend)
    return wanted
