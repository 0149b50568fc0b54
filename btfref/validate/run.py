"""Computing the matrix: jobs in processes, what is cached taken from there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.comparison.comparison import json_safe
from btfref.errors import BtfrefError, InputError
from btfref.gates.verdicts import missing_reference
from btfref.validate.cache import Cache
from btfref.validate.cell import CellResult, cell_key, failed_cell, gate_from, make_cell
from btfref.validate.material import make_material, material_key
from btfref.validate.matrix import FULL, Settings
from btfref.validate.pictures import CARRIER, make_carrier, make_views, views_key
from btfref.validate.pool import Job, Pool, default_workers, local
from btfref.validate.stages.browser import demand_browser
from btfref.validate.stages.checks import make_checks
from btfref.validate.stages.drawn import code_of
from btfref.validate.stages.fits import fit_key, make_fit
from btfref.validate.stages.off_grid import make_truth, truth_key

if TYPE_CHECKING:
    from btfref.gates.verdicts import GateResult
    from btfref.sampling.scheduling import Scheduler
    from btfref.types import Facts, PathLike, Progress
    from btfref.validate.matrix import Spec


@dataclass(frozen=True, eq=False)
class Validation:
    """What a run found.

    Parameters
    ----------
    cells : list of CellResult
    methods : list of dict
        Per mesostructure and method: ``gates`` of its evaluators and its sampling, ``off_grid``.
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
    scheduler: Scheduler = None,
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
    scheduler : str or distributed.Client, optional
        "dask", for so many workers of a local cluster, or a cluster that runs elsewhere, by its address or a client
        of it. Its workers must see the folder of results under the same name, and run the same code.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    Validation

    Raises
    ------
    InputError
        No cells; a scheduler that cannot be reached, or a worker that does not see the folder, or has other code.
    MissingDependencyError
        Without Chromium where ``BTFREF_REQUIRE`` names it, or Dask where there is a scheduler.
    BtfrefError
        When a process dies.
    """
    from btfref.provenance import versions
    from btfref.stress.evaluators import PORTS, present

    demand_browser()
    specs = sorted(set(specs))
    if not specs:
        raise InputError("nothing to validate", field="cells", got=0)
    start, root = time.perf_counter(), str(Cache(cache).root.resolve())
    materials = sorted({spec.mesostructure for spec in specs})
    views = sorted({(spec.mesostructure, spec.scene, spec.lights) for spec in specs})
    methods = [list(group) for _, group in groupby(specs, key=lambda s: (s.mesostructure, s.method))]
    # Nothing begins before its material is there: the longest ones first, each by itself.
    shared = ((_material_job, _material_keys), (_twin_job, _twin_keys), (_truth_job, _truth_keys))
    stages: list[list[Job]] = [
        [Job(*job, (root, name, settings)) for job in shared for name in materials],
        [Job(_views_job, _views_keys, (root, *view, settings)) for view in views],
        [Job(_method_job, _method_keys, (root, group, settings)) for group in methods],
    ]
    total = sum(len(stage) for stage in stages)
    workers = min(workers or default_workers(), max(len(stage) for stage in stages))
    report = progress or (lambda *_: None)
    # Before any process loads code: what changes after that is seen to have changed.
    code = code_of("btfref.validate.cell", *{spec.method for spec in specs})
    for one in sorted({spec.method for spec in specs}):
        code_of("btfref.validate.stages.checks", one)
    results, computed, done = [], 0, 0
    report(0, total, "validating")
    if scheduler is None:
        opened: AbstractContextManager[Pool] = local(workers)
    else:
        from btfref.validate.workers import workers_of

        opened = workers_of(scheduler, workers, root, [spec.method for spec in specs], materials)
    with opened as pool:
        workers = pool.size
        for stage in stages:
            for result, fresh in pool.each(stage):
                results.append(result)
                computed += fresh
                done += 1
                report(done, total, "validating")
    of_methods = [result for result in results if isinstance(result, dict)]
    cells = sorted((c for r in of_methods for c in r.pop("cells")), key=lambda c: c.facts["name"])
    of_methods.sort(key=lambda m: (m["mesostructure"], m["method"]))
    absent = [name for name in PORTS if name not in present(PORTS)]
    facts = {"versions": versions(), "workers": workers, "code": code, "absent": absent}
    return Validation(cells, of_methods, settings, time.perf_counter() - start, computed, total, facts)


def _material_job(root: PathLike, mesostructure: str, settings: Settings) -> tuple[None, bool]:
    cache = Cache(root)
    make_material(cache, mesostructure, settings)
    make_carrier(cache, mesostructure, settings)
    return None, cache.computed > 0


def _material_keys(mesostructure: str, settings: Settings) -> list[str]:
    return [material_key(mesostructure, settings), fit_key(mesostructure, CARRIER, settings)]


def _twin_job(root: PathLike, mesostructure: str, settings: Settings) -> tuple[None, bool]:
    cache = Cache(root)
    make_material(cache, mesostructure, settings, twin=True)
    return None, cache.computed > 0


def _twin_keys(mesostructure: str, settings: Settings) -> list[str]:
    return [material_key(mesostructure, settings)]


def _truth_job(root: PathLike, mesostructure: str, settings: Settings) -> tuple[None, bool]:
    cache = Cache(root)
    make_truth(cache, mesostructure, settings)
    return None, cache.computed > 0


def _truth_keys(mesostructure: str, settings: Settings) -> list[str]:
    return [truth_key(mesostructure, settings)]


def _views_job(
    root: PathLike, mesostructure: str, scene: str | Path, lights: str, settings: Settings
) -> tuple[None, bool]:
    cache = Cache(root)
    try:
        make_views(cache, mesostructure, scene, lights, settings)
    except BtfrefError:
        # Every cell that needs them fails, and says why.
        return None, True
    return None, cache.computed > 0


def _views_keys(mesostructure: str, scene: str | Path, lights: str, settings: Settings) -> list[str]:
    return [views_key(mesostructure, scene, lights, settings)]


def _method_job(root: PathLike, specs: Sequence[Spec], settings: Settings) -> tuple[Facts, bool]:
    """All cells of one method and mesostructure, and the method's own checks."""
    cache, first = Cache(root), specs[0]
    facts = {"mesostructure": first.mesostructure, "method": first.method}
    try:
        make_fit(cache, first.mesostructure, first.method, settings)
        checks = make_checks(cache, first.mesostructure, first.method, settings)
        cells = [make_cell(cache, spec, settings) for spec in specs]
    except BtfrefError as error:
        gates = [g.to_dict() for g in missing_reference("probe.agreement", str(error))]
        checks = {"gates": gates, "off_grid": None, "notes": str(error)}
        cells = [failed_cell(spec, str(error)) for spec in specs]
    return {**facts, **json_safe(checks), "cells": cells}, cache.computed > 0


def _method_keys(specs: Sequence[Spec], settings: Settings) -> list[str]:
    first = specs[0]
    return [
        fit_key(first.mesostructure, first.method, settings),
        *(cell_key(spec, settings) for spec in specs),
    ]


__all__ = ["CellResult", "Validation", "default_workers", "method_name", "validate"]
