"""Computing the matrix: jobs in processes, what is cached taken from there."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.comparison.comparison import json_safe
from btfref.errors import BtfrefError, InputError
from btfref.gates.verdicts import missing_reference
from btfref.provenance import code_of
from btfref.validate.cache import Cache, key_of
from btfref.validate.cell import CellResult, failed_cell, gate_from, make_cell
from btfref.validate.held_out import held_out_error
from btfref.validate.material import fit_key, load_material, make_fit, make_material
from btfref.validate.matrix import FULL, Settings
from btfref.validate.pictures import make_carrier, make_views

if TYPE_CHECKING:
    from btfref.gates.verdicts import GateResult
    from btfref.types import Facts, PathLike, Progress
    from btfref.validate.matrix import Spec


#: Memory that a process needs: a BTF of 64² texels and 81² directions twice over, and its pictures.
MEMORY_PER_WORKER = 3 << 30


#: A function of a process, which also tells whether it computed anything now, and its arguments.
_Job = tuple[Callable[..., tuple[Any, bool]], tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class Validation:
    """What a run found.

    Parameters
    ----------
    cells : list of CellResult
    methods : list of dict
        Per mesostructure and method: ``gates`` of its evaluators and its sampling, ``held_out``.
    settings : Settings
    seconds : float
    computed : int
        Jobs that were not answered from the cache; ``jobs`` in all.
    jobs : int
    """

    cells: list[CellResult]
    methods: list[Facts]
    settings: Settings
    seconds: float = 0.0
    computed: int = 0
    jobs: int = 0
    facts: Facts = field(default_factory=dict)

    @property
    def failed_gates(self) -> list[tuple[str, GateResult]]:
        """``(where, GateResult)`` of every gate that did not pass."""
        pairs = [(cell.facts["name"], gate) for cell in self.cells for gate in cell.gates]
        pairs += [(method_name(facts), gate_from(g)) for facts in self.methods for g in facts["gates"]]
        return [(name, gate) for name, gate in pairs if not gate.passed]

    @property
    def passed(self) -> bool:
        """Whether there are cells and every gate passed."""
        return bool(self.cells) and not self.failed_gates

    def to_dict(self) -> Facts:
        """Strict JSON; see ``btfref/validate/schema.json``."""
        return json_safe(
            {
                "kind": "validation",
                "schema": 1,
                "passed": self.passed,
                "settings": self.settings.to_dict(),
                "seconds": self.seconds,
                "jobs": self.jobs,
                "computed": self.computed,
                "facts": self.facts,
                "cells": [{**cell.facts, "outcome": cell.outcome} for cell in self.cells],
                "methods": self.methods,
            }
        )


def method_name(facts: Facts) -> str:
    """Name of a method's own checks, for people."""
    return f"{facts['method']} · evaluators · {facts['mesostructure']}"


def validate(
    specs: Sequence[Spec],
    *,
    settings: Settings = FULL,
    cache: PathLike | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Compute cells of the matrix.

    Parameters
    ----------
    specs : sequence of btfref.validate.matrix.Spec
    settings : Settings
    cache : path-like, optional
        Folder of results; `btfref.validate.cache.folder` by default.
    workers : int, optional
        Processes; by default one a core as far as memory allows. One runs in this process.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    Validation

    Raises
    ------
    InputError
        No cells.
    BtfrefError
        When a process dies.
    """
    from btfref.provenance import versions

    specs = sorted(set(specs))
    if not specs:
        raise InputError("nothing to validate", field="cells", got=0)
    start, root = time.perf_counter(), str(Cache(cache).root)
    materials = sorted({spec.mesostructure for spec in specs})
    views = sorted({(spec.mesostructure, spec.scene, spec.lights) for spec in specs})
    methods = [list(group) for _, group in groupby(specs, key=lambda s: (s.mesostructure, s.method))]
    stages: list[list[_Job]] = [
        [(_material_job, (root, name, settings)) for name in materials],
        [(_views_job, (root, *view, settings)) for view in views],
        [(_method_job, (root, group, settings)) for group in methods],
    ]
    total = sum(len(stage) for stage in stages)
    workers = min(workers or default_workers(), max(len(stage) for stage in stages))
    report = progress or (lambda *_: None)
    found, computed, done = [], 0, 0
    report(0, total, "validating")
    with _pool(workers) as pool:
        for stage in stages:
            for result, fresh in _each(pool, stage):
                found.append(result)
                computed += fresh
                done += 1
                report(done, total, "validating")
    of_methods = [result for result in found if isinstance(result, dict)]
    cells = sorted((c for r in of_methods for c in r.pop("cells")), key=lambda c: c.facts["name"])
    of_methods.sort(key=lambda m: (m["mesostructure"], m["method"]))
    facts = {"versions": versions(), "workers": workers, "code": code_of("picture")}
    return Validation(cells, of_methods, settings, time.perf_counter() - start, computed, total, facts)


def default_workers() -> int:
    """Processes that cores and memory allow."""
    from btfref.sampling.memory import default_budget

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, default_budget() // MEMORY_PER_WORKER))


class _Here:
    """The pool of one worker: this process."""

    def __enter__(self) -> _Here:
        return self

    def __exit__(self, *_: object) -> None:
        return None


def _pool(workers: int) -> _Here | ProcessPoolExecutor:
    if workers == 1:
        return _Here()
    # Spawned: neither Dr.Jit nor a GL driver survives a fork.
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start_worker)


def _start_worker() -> None:
    """One core a process: their threads would only wait for each other."""
    os.environ["LP_NUM_THREADS"] = "1"
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    from btfref.errors import MissingDependencyError
    from btfref.platform import prepare_llvm

    try:
        prepare_llvm()
    except MissingDependencyError:
        return  # the jobs say so
    import drjit as dr

    dr.set_thread_count(1)


def _each(pool: _Here | ProcessPoolExecutor, jobs: Sequence[_Job]) -> Iterator[tuple[Any, bool]]:
    """Results of jobs as they come; ``(result, whether it was computed now)``."""
    if isinstance(pool, _Here):
        for job, arguments in jobs:
            yield job(*arguments)
        return
    futures = [pool.submit(job, *arguments) for job, arguments in jobs]
    try:
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise BtfrefError(
            "a process of the validation died, most likely for want of memory; try --workers 1"
        ) from error


def _material_job(root: PathLike, mesostructure: str, settings: Settings) -> tuple[None, bool]:
    cache = Cache(root)
    before = len(os.listdir(root)) if os.path.isdir(root) else 0
    make_material(cache, mesostructure, settings)
    make_carrier(cache, mesostructure, settings)
    return None, len(os.listdir(root)) != before


def _views_job(
    root: PathLike, mesostructure: str, scene: str | Path, lights: str, settings: Settings
) -> tuple[None, bool]:
    before = len(os.listdir(root))
    try:
        make_views(Cache(root), mesostructure, scene, lights, settings)
    except BtfrefError:
        # Every cell that needs them fails, and says why.
        return None, True
    return None, len(os.listdir(root)) != before


def _method_job(root: PathLike, specs: Sequence[Spec], settings: Settings) -> tuple[Facts, bool]:
    """All cells of one method and mesostructure, and the method's own checks."""
    cache, first = Cache(root), specs[0]
    facts = {"mesostructure": first.mesostructure, "method": first.method}
    before = set(os.listdir(root))
    try:
        file = make_fit(cache, first.mesostructure, first.method, settings)
        checks = _checks(cache, first, file, settings)
        cells = [make_cell(cache, spec, settings) for spec in specs]
    except BtfrefError as error:
        gates = [g.to_dict() for g in missing_reference("probe.agreement", str(error))]
        checks = {"gates": gates, "held_out": None, "notes": str(error)}
        cells = [failed_cell(spec, str(error)) for spec in specs]
    return {**facts, **json_safe(checks), "cells": cells}, set(os.listdir(root)) != before


def _checks(cache: Cache, spec: Spec, file: PathLike, settings: Settings) -> Facts:
    """Agreement of the evaluators, sampling, and held-out directions of a method; cached."""
    from btfref.registry import method
    from btfref.representations import between
    from btfref.representations.file.container import read_info
    from btfref.validate.method_gates import probe_gates, sampling_gates

    key = key_of(
        {
            "checks": fit_key(spec.mesostructure, spec.method, settings),
            "code": code_of("picture", spec.method),
            "samples": settings.chi2_samples,
            "held_out_texels": settings.held_out_texels,
        }
    )
    if cache.has(key, ".checks.json"):
        return json.loads(cache.path(key, ".checks.json").read_text("utf-8"))
    start = time.perf_counter()
    info = read_info(file)
    gates = [
        *probe_gates(file),
        *sampling_gates(file, samples=settings.chi2_samples),
        *between.gates(spec.method, info["fit"].get("between_samples", {})),
    ]
    btf = load_material(make_material(cache, spec.mesostructure, settings)[0])
    fit = method(spec.method).fit
    error = held_out_error(fit, btf, texels=settings.held_out_texels)
    checks = json_safe(
        {
            "gates": [gate.to_dict() for gate in gates],
            "held_out": error,
            "bytes": info["payload_bytes"],
            "fit": info["fit"],
            "seconds": time.perf_counter() - start,
        }
    )
    cache.write(key, ".checks.json", lambda path: path.write_text(json.dumps(checks), "utf-8"))
    return checks


__all__ = ["CellResult", "Validation", "default_workers", "method_name", "validate"]
