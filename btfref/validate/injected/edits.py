"""Faults that edit code: what is cached must not survive them, and the gates must see them.

In a copy of the packages, and with a package of another's method beside it, a small validation is run and found to be
free of failures, then from the cache alone. Each edit then changes one file of the copy and runs its method again, in
a process of its own: it must be computed anew, and the limit that is meant for it must fail.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import BtfrefError
from btfref.validate.matrix import QUICK

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Small enough for seconds a method.
SETTINGS = replace(
    QUICK,
    texels=8,
    spp=4,
    size=24,
    truth_spp=16,
    browser_lights=(),
    browser_ways=(),
    off_grid_rows=60,
    off_grid_spp=8,
    chi2_samples=50_000,
    chi2_intervals=8,
    port_pixels=16,
)

#: The views that every method is shown in: mesostructure, scene, lights.
VIEW = ("checker", "sphere", "directional1")

#: Packages of btfref that are copied.
PACKAGES = ("btfref", "mitsuba_plugins")

#: Key of the other's method.
GUEST = "guest"

#: Its package: a method of its own by derivation, as a third party may write it.
_GUEST = {
    "btfref_guest/__init__.py": """\
from btfref.registry import Method

HOME = "btfref_guest"
METHOD = Method("guest", "A guest", "none", "btfref_guest.definition", "btfref_guest.port", "guest.glsl", HOME)
""",
    "btfref_guest/definition.py": """\
from btfref.representations.tabulated import svd

PRESETS = {"paper": {}}


class Representation(svd.Representation):
    pass


def fit(btf, *, seed=0, progress=None, components=4):
    made = svd.fit(btf, seed=seed, progress=progress, components=components)
    return Representation(made.arrays(), {**made.meta, "method": "guest"})
""",
    "btfref_guest/port.py": """\
from mitsuba_plugins import svd


class Evaluator(svd.Evaluator):
    def evaluate(self, *arguments):
        value = super().evaluate(*arguments)
        return value
""",
    "btfref_guest/guest.glsl": '#include "representations/svd.glsl"\n',
    "btfref_guest-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: btfref-guest\nVersion: 1.0\n",
    "btfref_guest-1.0.dist-info/entry_points.txt": (
        "[btfref.representations]\nguest = btfref_guest:METHOD\n"
    ),
}

PROBE = "probe.agreement.p999"


@dataclass(frozen=True)
class Edit:
    """A fault in code.

    Parameters
    ----------
    name : str
    method : str
        Registry key of what is run again.
    file : str
        In the copy; ``shaders/…`` in the shaders' directory.
    right, wrong : str
        Text that stands there once, and what replaces it.
    meant : str
        The limit that must fail.
    """

    name: str
    method: str
    file: str
    right: str
    wrong: str
    meant: str = PROBE


EDITS = (
    Edit(
        "edit: a factor in a Dr.Jit port that two methods share",
        "lafortune_lut",
        "mitsuba_plugins/lafortune.py",
        "return total * (fade * light.z)",
        "return 1.1 * total * (fade * light.z)",
    ),
    Edit(
        "edit: a factor in a definition",
        "lafortune_lut",
        "btfref/representations/analytic/lafortune_lut.py",
        "return light_functions.evaluate_analytic(",
        "return 1.1 * light_functions.evaluate_analytic(",
    ),
    Edit(
        "edit: a shader that others include",
        GUEST,
        "shaders/lib/lookup/texels.glsl",
        "float(columns), 0.5)",
        "float(columns), 0.25)",
    ),
    Edit(
        "edit: the tabulated BTF",
        "raw",
        "btfref/representations/tabulated/raw.py",
        "return evaluate_tabulated(self,",
        "return 1.1 * evaluate_tabulated(self,",
    ),
    Edit(
        "edit: a base class of a method",
        GUEST,
        "btfref/representations/tabulated/svd.py",
        "return evaluate_tabulated(",
        "return 1.1 * evaluate_tabulated(",
    ),
    Edit(
        "edit: the generator of hard lookups",
        GUEST,
        "btfref/stress/lookups.py",
        'uv = _coordinates(rng, coordinate, representation.meta["texels"])',
        'uv = _coordinates(rng, coordinate, representation.meta["texels"]).astype(float) + 1e4',
    ),
    Edit(
        "edit: a port in another's package",
        GUEST,
        "btfref_guest/port.py",
        "return value",
        "return 1.1 * value",
    ),
)


@dataclass(frozen=True)
class Outcome:
    """What a run in the copy said.

    Parameters
    ----------
    computed, jobs : int
    failed : tuple of str
        Limits that failed.
    loaded : tuple of str
        Modules of the packages that the process loaded.
    """

    computed: int
    jobs: int
    failed: tuple[str, ...]
    loaded: tuple[str, ...] = ()


class Copy:
    """A copy of the packages with a cache of its own; :meth:`run` validates methods in it, in a process of its own.

    Parameters
    ----------
    folder : path-like
        An empty folder for both.
    cache : path-like, optional
        Another cache: what is copied has the keys of the copy.
    """

    def __init__(self, folder: PathLike, cache: PathLike | None = None) -> None:
        from btfref.platform import shader_directory

        self.folder = Path(folder) / "site"
        self.cache = Path(cache).absolute() if cache else Path(folder) / "cache"
        root = Path(__file__).resolve().parents[3]
        leave = shutil.ignore_patterns("__pycache__", "docs", "_shaders")
        for package in PACKAGES:
            shutil.copytree(root / package, self.folder / package, ignore=leave)
        shutil.copytree(shader_directory(), self.folder / "shaders")
        for name, text in _GUEST.items():
            file = self.folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, "utf-8")

    def run(self, methods: Sequence[str]) -> Outcome:
        """Validate methods with `SETTINGS` in the view `VIEW`.

        Raises
        ------
        BtfrefError
            When the process fails, with its last line.
        """
        out = self.folder.parent / "outcome.json"
        out.unlink(missing_ok=True)
        arguments = [str(self.cache), str(out), *methods]
        call = f"from btfref.validate.injected.edits import _validate; _validate({arguments!r})"
        path = os.pathsep.join([str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(
            [sys.executable, "-c", call],
            capture_output=True,
            text=True,
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": path},
            check=False,
        )
        if done.returncode or not out.is_file():
            said = (done.stderr.strip() or "no word").splitlines()[-1]
            raise BtfrefError(f"a validation in a copy of the packages failed: {said}")
        found = json.loads(out.read_text("utf-8"))
        return Outcome(found["computed"], found["jobs"], tuple(found["failed"]), tuple(found["loaded"]))

    @contextmanager
    def edited(self, edit: Edit) -> Iterator[None]:
        """The copy with an edit, which is taken back at the end.

        Raises
        ------
        BtfrefError
            The text is not there, or there more than once.
        """
        file = self.folder / edit.file
        text = file.read_text("utf-8")
        if text.count(edit.right) != 1:
            count = text.count(edit.right)
            raise BtfrefError(f"{edit.file}: the text of an edit must stand there once, not {count} times")
        facts = file.stat()
        file.write_text(text.replace(edit.right, edit.wrong), "utf-8")
        try:
            yield
        finally:
            file.write_text(text, "utf-8")
            os.utime(file, ns=(facts.st_atime_ns, facts.st_mtime_ns))


def _validate(arguments: Sequence[str]) -> None:
    """What runs in the process: folder of the cache, file for the outcome, methods."""
    from btfref.validate.matrix import Spec
    from btfref.validate.run import validate

    cache, out, *methods = arguments
    mesostructure, scene, lights = VIEW
    specs = [Spec(mesostructure, method, scene, lights) for method in methods]
    found = validate(specs, settings=SETTINGS, cache=cache, workers=1)
    failed = sorted({gate.name for _, gate in found.failed_gates})
    loaded = sorted(name for name in sys.modules if name.split(".")[0] in PACKAGES)
    facts: Facts = {"computed": found.computed, "jobs": found.jobs, "failed": failed, "loaded": loaded}
    Path(out).write_text(json.dumps(facts), "utf-8")


@contextmanager
def copied(cache: PathLike | None = None) -> Iterator[Copy]:
    """A `Copy` in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        yield Copy(folder, cache)
