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
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.bench import measures
from btfref.bench.data import materials
from btfref.bench.scheduled.builds import builders, loaded
from btfref.bench.subjects import build
from btfref.bench.timing import machine
from btfref.querying import off_grid

if TYPE_CHECKING:
    from btfref.bench.plan import Entry, Plan
    from btfref.bench.scheduled.builds import Builders
    from btfref.bench.subjects import Built
    from btfref.sampling import SampledBTF
    from btfref.sampling.scheduling import Scheduler
    from btfref.types import Facts, PathLike, Progress


RESULTS = "results.jsonl"


def run(
    plan: Plan,
    out: PathLike,
    *,
    btf: SampledBTF | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> str:
    """Measure what a plan says.

    Parameters
    ----------
    plan : btfref.bench.plan.Plan
    out : path-like
        Folder; a second run is added to what it holds.
    btf : SampledBTF, optional
        Instead of the plan's mesostructures.
    scheduler, workers
        Who builds and answers: see `btfref.sampling.scheduling.run`; workers must see the folder. Builds are timed on
        all processors of a worker's machine, one at a time there. All other times are this process's, when no worker
        is at work. Peers are built here.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    str
        Number of the run.

    Raises
    ------
    InputError
        A scheduler that cannot be reached, or a worker that does not see the folder, or has other code.
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
    with builders(scheduler, workers, plan, writer.folder) as others:
        for name, sampled in materials(btf, names, progress=progress, **settings):
            _material(plan, name, sampled, writer, others, progress)
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
        name = self.name_of_values()
        np.save(self.folder / name, np.asarray(array, np.float32))
        return name

    def name_of_values(self) -> str:
        return f"values/{uuid.uuid4().hex[:12]}.npy"

    def _line(self, record: Facts) -> None:
        with (self.folder / RESULTS).open("a") as stream:
            stream.write(json.dumps(record) + "\n")


def _material(
    plan: Plan,
    name: str,
    btf: SampledBTF,
    writer: _Writer,
    others: Builders | None,
    progress: Progress | None,
) -> None:
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

    rounds = plan.rounds["build"]
    with tempfile.TemporaryDirectory(dir=writer.folder if others else None) as folder:
        files: dict[str, Path] = {}
        records: dict[str, Facts] = {}
        built: dict[str, Built] = {}
        if others is not None:
            files, records = others.build(plan, btf, folder, lambda entry: report(f"build {entry}"))
            built = {key: loaded(path, records[key]["payload"]) for key, path in files.items()}
        makes = {entry.name: maker(entry) for entry in plan.entries if entry.name not in files}
        here, timed = measures.timed_builds(makes, rounds, lambda entry: report(f"build {entry}"))
        built, records = {**built, **here}, {**records, **timed}
        paths: dict[str, Path | None] = {}
        for entry in plan.entries:
            path = files.get(entry.name) or measures.saved(built[entry.name], entry, folder)
            paths[entry.name] = path
            more = {"file_bytes": path.stat().st_size if path else None}
            writer.add("build", name, entry, {**records[entry.name], **more})
        own = [(entry, path) for entry in plan.entries if (path := paths[entry.name]) is not None]
        answers = _Answers(plan, name, built, files, writer, others, report)
        if "off_grid" in plan.measures:
            truth = measures.off_grid_rows(btf, plan)
            if truth is not None:  # where the geometry is known
                rows = writer.queries(f"{name}-off-grid", off_grid.packed(truth))
                answers.add("off_grid", rows, partial(measures.off_grid_answers, truth=truth))
        if "error" in plan.measures:
            answers.add(
                "error",
                asked,
                lambda made: made.evaluate(queries["uv"], queries["w_light"], queries["w_view"]),
            )
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


@dataclass(frozen=True)
class _Answers:
    """Answers of all entries to the queries of a material, by this process or by workers."""

    plan: Plan
    material: str
    built: Mapping[str, Built]
    files: Mapping[str, Path]
    writer: _Writer
    others: Builders | None
    report: Callable[[str], None]

    def add(self, kind: str, asked: str, answer: Callable[[Built], np.ndarray]) -> None:
        """Records of a kind: answers to the queries of a file, for entries of this process by ``answer``."""
        elsewhere = [entry for entry in self.plan.entries if entry.name in self.files]
        values = {entry.name: self.writer.name_of_values() for entry in elsewhere}
        if self.others is not None:
            folder = self.writer.folder
            outs = [folder / name for name in values.values()]
            for name in self.others.answer(kind, elsewhere, self.files, folder / asked, outs):
                self.report(f"{kind} of {name}")
        for entry in self.plan.entries:
            if entry.name not in values:
                self.report(f"{kind} of {entry.name}")
                values[entry.name] = self.writer.values(answer(self.built[entry.name]))
            record = {"queries": asked, "values": values[entry.name]}
            self.writer.add(kind, self.material, entry, record)


def _has_cuda() -> bool:
    import drjit as dr

    return dr.has_backend(dr.JitBackend.CUDA)
