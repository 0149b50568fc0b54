"""Runs a plan: everything that it measures, of every entry, on every material; raw results as JSON lines.

A folder holds ``results.jsonl``, a line for the run and then one a record; ``queries/MATERIAL.npz``, the entries of the
BTF that every representation was asked for; ``values/NUMBER.npy``, the answers. Metrics are computed from these by
:mod:`btfref.bench.metrics`, so that a new metric needs no new run.
"""

from __future__ import annotations

import json
import tempfile
import uuid
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.bench import measures
from btfref.bench.data import materials
from btfref.bench.subjects import build
from btfref.bench.timing import machine
from btfref.querying import off_grid

if TYPE_CHECKING:
    from btfref.bench.plan import Entry, Plan
    from btfref.bench.subjects import Built
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, PathLike, Progress


RESULTS = "results.jsonl"


def run(plan: Plan, out: PathLike, *, btf: SampledBTF | None = None, progress: Progress | None = None) -> str:
    """Measure what a plan says.

    Parameters
    ----------
    plan : btfref.bench.plan.Plan
    out : path-like
        Folder; a second run is added to what it holds.
    btf : SampledBTF, optional
        Instead of the plan's mesostructures.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    str
        Number of the run.
    """
    writer = _Writer(Path(out), plan)
    if {"eval", "render", "sampling"} & set(plan.measures):
        import mitsuba_plugins
        from btfref.platform import prepare_llvm

        # Before Dr.Jit is asked what it has.
        prepare_llvm()
        mi = mitsuba_plugins.ready("cuda_ad_rgb" if _has_cuda() else "llvm_ad_rgb")
        writer.run["variant"] = mi.variant()
    writer.header()
    data = dict(plan.data)
    names = data.pop("mesostructures")
    directions = data.pop("directions")
    settings = {**data, "views": directions, "lights": directions, "seed": plan.seed}
    for name, sampled in materials(btf, names, progress=progress, **settings):
        _material(plan, name, sampled, writer, progress)
    return writer.run["id"]


class _Writer:
    """Adds records to a folder as they come: what was measured survives an interruption."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder = folder
        for sub in ("queries", "values"):
            (folder / sub).mkdir(parents=True, exist_ok=True)
        self.run: Facts = {
            "record": "run",
            "id": uuid.uuid4().hex[:12],
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "plan": plan.to_dict(),
            "machine": machine(),
        }

    def header(self) -> None:
        self._line(self.run)

    def add(self, kind: str, material: str, entry: Entry, record: Facts) -> None:
        described = {"entry": entry.name, "method": entry.method, "peer": entry.peer, "build": entry.build}
        if entry.bytes_of:
            described["bytes_of"] = entry.bytes_of
        self._line({"record": kind, "run": self.run["id"], "material": material, **described, **record})

    def plain(self, kind: str, material: str, record: Facts) -> None:
        self._line({"record": kind, "run": self.run["id"], "material": material, "plain": True, **record})

    def queries(self, material: str, arrays: Mapping[str, Any]) -> str:
        name = f"queries/{self.run['id']}-{material}.npz"
        np.savez(self.folder / name, **arrays)
        return name

    def values(self, array: np.ndarray) -> str:
        name = f"values/{uuid.uuid4().hex[:12]}.npy"
        np.save(self.folder / name, np.asarray(array, np.float32))
        return name

    def _line(self, record: Facts) -> None:
        with (self.folder / RESULTS).open("a") as stream:
            stream.write(json.dumps(record) + "\n")


def _material(plan: Plan, name: str, btf: SampledBTF, writer: _Writer, progress: Progress | None) -> None:
    rng = np.random.default_rng(plan.seed)
    queries = measures.sample_queries(btf, plan.settings["error_samples"], rng)
    asked = writer.queries(name, queries)
    total = len(plan.entries) * (plan.rounds["build"] + len(plan.measures) - 1)
    steps = iter(range(total + 1))

    def report(label: str) -> None:
        if progress:
            progress(next(steps, total), total, f"{name}: {label}")

    def maker(entry: Entry) -> Callable[[dict[str, Built]], Built]:
        def make(built: dict[str, Built]) -> Built:
            payload = built[entry.bytes_of].payload if entry.bytes_of else None
            return build(entry, btf, seed=plan.seed, payload=payload)

        return make

    makes = {entry.name: maker(entry) for entry in plan.entries}
    built, records = measures.timed_builds(
        makes, plan.rounds["build"], lambda entry: report(f"build {entry}")
    )
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for entry in plan.entries:
            paths[entry.name] = measures.saved(built[entry.name], entry, folder)
            path = paths[entry.name]
            more = {"file_bytes": path.stat().st_size if path else None}
            writer.add("build", name, entry, {**records[entry.name], **more})
        own = [(entry, path) for entry in plan.entries if (path := paths[entry.name]) is not None]
        if "off_grid" in plan.measures:
            _off_grid(plan, name, btf, built, writer, report)
        if "error" in plan.measures:
            for entry in plan.entries:
                report(f"error of {entry.name}")
                found = built[entry.name].evaluate(queries["uv"], queries["w_light"], queries["w_view"])
                writer.add("error", name, entry, {"queries": asked, "values": writer.values(found)})
        if "eval" in plan.measures:
            for entry in plan.entries:
                report(f"evaluations of {entry.name}")
                path = paths[entry.name]
                for record in measures.measure_eval(built[entry.name], path, plan, entry, rng):
                    writer.add("eval", name, entry, record)
        built.clear()
        if "render" in plan.measures:
            report("pictures")
            for shown, record in measures.measure_render(own, btf, plan):
                if shown is None:
                    writer.plain("render", name, record)
                else:
                    writer.add("render", name, shown, record)
        for kind, measure in (
            ("sampling", measures.measure_sampling),
            ("realtime", measures.measure_realtime),
        ):
            if kind in plan.measures:
                for entry, path in own:
                    report(f"{kind} of {entry.name}")
                    for record in measure(entry, path, plan):
                        writer.add(kind, name, entry, record)


def _off_grid(
    plan: Plan,
    name: str,
    btf: SampledBTF,
    built: Mapping[str, Built],
    writer: _Writer,
    report: Callable[[str], None],
) -> None:
    """Answers of every entry at directions that nobody fitted, where the geometry is known."""
    truth = measures.off_grid_rows(btf, plan)
    asked = "" if truth is None else writer.queries(f"{name}-off-grid", off_grid.packed(truth))
    for entry in plan.entries:
        report(f"{entry.name} off the grid")
        if truth is not None:
            answers = measures.off_grid_answers(built[entry.name], truth)
            writer.add("off_grid", name, entry, {"queries": asked, "values": writer.values(answers)})


def _has_cuda() -> bool:
    import drjit as dr

    return dr.has_backend(dr.JitBackend.CUDA)
