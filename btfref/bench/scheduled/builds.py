"""Who hands a plan's tasks to workers: builds, which are timed, one at a time on a machine; answers as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.bench.scheduled.tasks import answered, built, processors_there
from btfref.bench.subjects import Built
from btfref.provenance.told import order
from btfref.sampling.cluster.tasks import one_a_machine, results
from btfref.sampling.scheduling import asked_of_all, cluster, refuse_other_versions

if TYPE_CHECKING:
    import distributed

    from btfref.bench.plan import Entry, Plan
    from btfref.sampling import SampledBTF
    from btfref.sampling.scheduling import Means, Scheduler
    from btfref.types import Facts, PathLike


@dataclass(frozen=True)
class Builders:
    """The workers of a cluster, for one plan.

    Attributes
    ----------
    client : distributed.Client
    means : Means
        Threads of each.
    path : pathlib.Path
        The file that tells them what to be like, in the folder of results.
    """

    client: distributed.Client
    means: Means
    path: Path

    def build(
        self,
        plan: Plan,
        btf: SampledBTF,
        folder: PathLike,
        report: Callable[[str], object] = lambda name: None,
    ) -> tuple[dict[str, Path], dict[str, Facts]]:
        """Build and save all methods of a plan, in each round.

        Parameters
        ----------
        plan : Plan
        btf : SampledBTF
        folder : path-like
            That workers see.
        report : callable, optional
            Called with a name when it is built.

        Returns
        -------
        paths : dict of str to pathlib.Path
        records : dict of str to dict
            As `btfref.bench.measures.timed_builds` has them; and ``worker``, of the first round.
        """
        store = str(self._store(btf, Path(folder)))
        entries = [entry for entry in plan.entries if entry.method]
        files: dict[str, Path] = {}
        records: dict[str, Facts] = {}
        for _ in range(plan.rounds["build"]):
            done: set[str] = set()
            while len(done) < len(entries):
                # An entry that matches another one's bytes comes behind it.
                ready = [e for e in entries if e.name not in done and (not e.bytes_of or e.bytes_of in done)]
                pieces = [
                    (
                        str(self.path),
                        entry,
                        store,
                        btf.attributes,
                        plan.seed,
                        records[entry.bytes_of]["payload"] if entry.bytes_of else None,
                        str(Path(folder).resolve()),
                    )
                    for entry in ready
                ]
                for number, (record, file) in one_a_machine(self.client, built, pieces, self.path.parent):
                    name = ready[number].name
                    report(name)
                    files[name] = Path(file)
                    if name in records:
                        records[name]["warm_s"].append(record["cold_s"])
                    records.setdefault(name, record)
                    done.add(name)
        return files, records

    def answer(
        self,
        kind: str,
        entries: Sequence[Entry],
        files: Mapping[str, Path],
        queries: Path,
        outs: Sequence[Path],
    ) -> Iterator[str]:
        """Have queries answered by what was built.

        Parameters
        ----------
        kind : str
            "error" or "off_grid".
        entries : sequence of Entry
            Methods.
        files : mapping of str to pathlib.Path
            Theirs.
        queries : pathlib.Path
        outs : sequence of pathlib.Path
            Files for the answers of each.

        Yields
        ------
        str
            Name of an entry that is done.
        """
        pieces = [
            (
                str(self.path),
                entry.name,
                kind,
                str(files[entry.name].resolve()),
                str(queries.resolve()),
                str(out.resolve()),
                self.means["threads"],
            )
            for entry, out in zip(entries, outs, strict=True)
        ]
        yield from results(self.client, answered, pieces, self.path.parent)

    def _store(self, btf: SampledBTF, folder: Path) -> Path:
        """The BTF where workers see it."""
        if btf.path is not None:
            return Path(btf.path).resolve()
        path = folder.resolve() / "data.btf.zarr"
        btf.save(path)
        return path


def loaded(path: Path, payload: int) -> Built:
    """What a worker built, in this process."""
    from btfref.representations import load

    made = load(path)
    return Built(made.evaluate, payload, made)


@contextmanager
def builders(
    scheduler: Scheduler, workers: int | None, plan: Plan, folder: PathLike
) -> Iterator[Builders | None]:
    """The workers of a cluster for a plan; None without a scheduler.

    Parameters
    ----------
    scheduler, workers
        See `btfref.sampling.scheduling.run`.
    plan : Plan
    folder : path-like
        Of results, which workers must see.

    Yields
    ------
    Builders or None

    Raises
    ------
    InputError
        A scheduler that cannot be reached, or a worker of another version.
    MissingDependencyError
        Dask is not installed.
    """
    if scheduler is None:
        yield None
        return
    with cluster(scheduler, workers, None) as (client, means):
        refuse_other_versions(client)
        asked_of_all(client, processors_there)
        methods = {entry.method for entry in plan.entries if entry.method}
        with order(folder, [built.__module__], methods) as path:
            yield Builders(client, means, path)
