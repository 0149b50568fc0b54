"""Can the gates fail? Known faults, each to be caught by the gate that is meant for it.

A fault is put where such a fault would be: into a copy of a shader, into maps on their way to the GPU, into a picture
on its way to the comparison, into the code of a copy of the packages. What has no fault must pass all the same gates
first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from btfref.errors import BtfrefError
from btfref.gates.tolerances import gate_table, limits
from btfref.gates.verdicts import with_class
from btfref.platform import shader_directory
from btfref.system import chromium
from btfref.validate.injected.bench import Bench
from btfref.validate.injected.edits import EDITS, copied
from btfref.validate.injected.faults import FAULTS

if TYPE_CHECKING:
    from btfref.gates.verdicts import GateResult
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike, Progress
    from btfref.validate.injected.edits import Edit
    from btfref.validate.injected.faults import Fault


@dataclass(frozen=True)
class Caught:
    """What became of a fault.

    Parameters
    ----------
    name, meant : str
    caught : bool
        The limit that is meant for it failed, and had passed without the fault.
    failed : tuple of str
        All limits that failed.
    clean : tuple of str
        Limits that failed without the fault: there should be none.
    """

    name: str
    meant: str
    caught: bool
    failed: tuple[str, ...]
    clean: tuple[str, ...]

    #: Head of a table of faults.
    HEAD: ClassVar = ("fault", "meant for", "by it", "gates that failed")

    @property
    def row(self) -> list[str]:
        """Cells of a table with the head `HEAD`; limits with the class of pixels that they judge."""
        failed = ", ".join(map(with_class, self.failed)) or "none"
        return [self.name, with_class(self.meant), "caught" if self.caught else "MISSED", failed]

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {**vars(self), "failed": list(self.failed), "clean": list(self.clean)}


def self_test(*, edits: Sequence[Edit] = EDITS, progress: Progress | None = None) -> list[Caught]:
    """Inject every fault.

    Parameters
    ----------
    edits : sequence of btfref.validate.injected.edits.Edit
        Faults that edit code, each a process of its own.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    list of Caught
        In the order of `FAULTS`, those that are `possible`, then of the edits.

    Raises
    ------
    BtfrefError
        When a shader or a module no longer holds the text that a fault replaces, or what is in the cache is computed
        again although nothing has changed.
    MissingDependencyError
        Without LLVM or OpenGL.
    """
    faults = possible()
    report, total = progress or (lambda *_: None), len(faults) + len(edits)
    results: list[Caught] = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for fault in faults:
            report(len(results), total, "injecting faults")
            results.append(_inject(bench, fault))
    for caught in edit_test(edits):
        report(len(results), total, "editing code")
        results.append(caught)
    report(total, total, "injecting faults")
    return results


def possible() -> tuple[Fault, ...]:
    """Those of `FAULTS` that this machine can look for: pictures of a browser need Chromium."""
    return tuple(fault for fault in FAULTS if not fault.look.startswith("browser") or chromium() is not None)


def edit_test(edits: Sequence[Edit] = EDITS) -> Iterator[Caught]:
    """Edit code in a copy of the packages, after a run without failures that filled its cache.

    Yields
    ------
    Caught
        What was taken from the cache all the same failed nothing, and so is not caught.

    Raises
    ------
    BtfrefError
        As `self_test`.
    """
    if not edits:
        return
    methods = sorted({edit.method for edit in edits})
    with copied() as copy:
        clean = copy.run(methods).failed
        if again := copy.run(methods).computed:
            raise BtfrefError(f"{again} jobs were computed again although nothing had changed")
        for edit in edits:
            with copy.edited(edit):
                found = copy.run([edit.method])
            caught = edit.meant in found.failed and found.computed > 0 and not clean
            yield Caught(edit.name, edit.meant, caught, found.failed, clean)


def _inject(bench: Bench, fault: Fault) -> Caught:
    clean = _failed(bench.clean(fault))
    if fault.edit:
        with edited_shader(bench.folder / fault.name.replace(" ", "_"), *fault.edit):
            failed = _failed(getattr(bench, fault.look)(fault.subject))
    else:
        failed = _failed(getattr(bench, fault.look)(fault.subject, change=fault.change))
    caught = fault.meant in failed and not clean
    return Caught(fault.name, fault.meant, caught, failed, clean)


def _failed(gates: Sequence[GateResult]) -> tuple[str, ...]:
    return tuple(sorted({gate.name for gate in gates if not gate.passed}))


@contextmanager
def edited_shader(folder: PathLike, file: str, right: str, wrong: str) -> Iterator[None]:
    """All representations with a copy of one shader file in which a text is replaced.

    Parameters
    ----------
    folder : path-like
        For the copy.
    file : str
        Relative to the shaders' directory.
    right, wrong : str
        Text that stands there once, and what replaces it.

    Raises
    ------
    BtfrefError
        The text is not there, or there more than once.
    """
    from btfref.rendering.gl import device

    text = (shader_directory() / file).read_text("utf-8")
    if text.count(right) != 1:
        raise BtfrefError(f"{file}: the text of a fault must stand there once, not {text.count(right)} times")
    target = Path(folder) / file
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text.replace(right, wrong), "utf-8")
    shipped = device.shader_file

    def faulty(rep: Representation) -> tuple[str, list[Path]]:
        shader, directories = shipped(rep)
        return shader, [Path(folder), *directories]

    device.shader_file = faulty
    try:
        yield
    finally:
        device.shader_file = shipped


def used_gates() -> set[str]:
    """Keys of all gates that a validation, a comparison with another renderer or this self-test applies.

    Returns
    -------
    set of str
    """
    from btfref.validate import cell, method_gates, own_renderer
    from btfref.validate.stages import browser

    keys = {"image.finite", "waterfall.closure", "environment.agreement", *cell.GATES, *method_gates.GATES}
    keys.update(*cell.ENVIRONMENT_GATES.values(), browser.GATES, browser.ENVIRONMENT_GATES)
    return keys.union(own_renderer.LINEAR, own_renderer.EIGHT_BIT, own_renderer.NOISY)


def entries(keys: Iterable[str]) -> set[str]:
    """All limits of gates, as ``gate.entry``."""
    return {f"{key}.{entry}" for key in keys for entry in limits(gate_table(key))}
