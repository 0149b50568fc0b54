"""One set of queries: its source and settings, checked before anything is written, and the file that it fills."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure import Mesostructure, build
from btfref.mesostructure.materials import load_bsdf
from btfref.provenance import LLVM, versions
from btfref.querying.files.zarr_file import begin
from btfref.querying.lookups import LookupSource, load_source
from btfref.querying.paths import PathSource, path_facts
from btfref.querying.settings import QuerySettings
from btfref.representations.protocol import Representation
from btfref.sampling.job import VERSIONS
from btfref.sampling.store.layout import remove_leftovers
from btfref.sampling.store.lock import writing
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from collections.abc import Mapping

    from btfref.querying.files.zarr_file import QueryFile
    from btfref.sampling.scheduling import Scheduler
    from btfref.types import Facts, PathLike, Progress


class Source(Protocol):
    """What answers rows."""

    def answer(self, rows: Mapping[str, np.ndarray], number: np.ndarray) -> dict[str, np.ndarray]:
        """See `btfref.querying.paths.PathSource.answer`."""


class QueryJob:
    """One set of queries; nothing of it can fail for a setting once the file is there.

    Parameters
    ----------
    source : Mesostructure or Representation
    settings : QuerySettings
    facts : dict, optional
        Of the source, as a file says it.
    stream : int
        Selects other random numbers for the same rows, of geometry.

    Attributes
    ----------
    source, settings, stream
    attributes : dict
        Of the file.
    """

    def __init__(
        self,
        source: Mesostructure | Representation,
        settings: QuerySettings,
        facts: Facts | None = None,
        stream: int = 0,
    ) -> None:
        self.source, self.settings, self.stream = source, settings, stream
        if isinstance(source, Mesostructure):
            with mitsuba_variant(settings.variant):
                for part in source.parts:
                    load_bsdf(part)
            facts = path_facts(source)
            used: tuple[str, ...] = (*VERSIONS, LLVM) if settings.variant.startswith("llvm") else VERSIONS
        else:
            LookupSource(source, settings)  # which refuses what it cannot do
            used = ("numpy",)
        self.attributes: Facts = {
            "settings": settings.facts(),
            "source": facts or _representation_facts(source),  # type: ignore[arg-type]  # it is one
            "versions": versions(used),
        }
        if stream:  # files of the first do without
            self.attributes["stream"] = stream

    @classmethod
    def of(
        cls,
        source: PathLike | Mesostructure | Representation,
        settings: QuerySettings | None = None,
        keywords: Facts | None = None,
        *,
        stream: int = 0,
    ) -> QueryJob:
        """The job of a source by its name or file, and of keywords that are settings or the mesostructure's.

        Other streams ask the same rows of geometry, and answer them by other random numbers.

        Raises
        ------
        InputError
        """
        settings, parameters = (settings or QuerySettings()).changed(keywords or {})
        if isinstance(source, Mesostructure):
            return cls(build(source, **parameters), settings, stream=stream)
        if isinstance(source, Representation):
            return cls(_without(source, parameters), settings)
        if is_answering_file(source):
            facts = {"kind": "file", "name": Path(source).name, "hash": fingerprint(source)}
            return cls(_without(load_source(source), parameters), settings, facts)
        with mitsuba_variant(settings.variant):  # whose absence is told before geometry is read
            pass
        return cls(build(source, **parameters), settings, stream=stream)

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Block in which a source is made and used."""
        if isinstance(self.source, Mesostructure):
            with mitsuba_variant(self.settings.variant):
                yield
        else:
            yield

    def make_source(self, stream: int | None = None) -> Source:
        """What answers; make and use it inside :meth:`ready`.

        Parameters
        ----------
        stream : int, optional
            In place of the job's.
        """
        if isinstance(self.source, Mesostructure):
            return PathSource(self.source, self.settings, self.stream if stream is None else stream)
        return LookupSource(self.source, self.settings)

    def rows(self, source: Source, first: int, count: int) -> dict[str, np.ndarray]:
        """Some rows, complete; see `btfref.querying.files.zarr_file`.

        Raises
        ------
        InputError
            A value that is not finite.
        """
        rows = self.settings.laws.rows(self.settings.seed, first, count)
        found = rows | source.answer(rows, np.arange(first, first + count))
        bad = ~np.isfinite(found["B"]).all(-1)
        if bad.any():
            row = first + int(np.flatnonzero(bad)[0])
            raise InputError("a value that is not finite", field=f"B[{row}]", got=found["B"][row - first])
        return found

    def fill(self, file: QueryFile, chunks: list[int], done: Callable[[int], object] | None = None) -> None:
        """Make some chunks of a file; ``done(chunk)`` is called after each."""
        if not chunks:
            return
        with self.ready():
            source = self.make_source()
            for chunk in chunks:
                first, last = file.extent(chunk)
                file.write(chunk, self.rows(source, first, last - first))
                if done is not None:
                    done(chunk)


def query_file(
    out: PathLike,
    source: PathLike | Mesostructure | Representation = "checker",
    settings: QuerySettings | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
    **keywords: Any,
) -> QueryFile:
    """Write queries to a Zarr store, from where an earlier run of the same settings stopped.

    Parameters
    ----------
    out : path-like
        ``NAME.queries.zarr``.
    source, settings, **keywords
        As for `btfref.queries`.
    overwrite : bool
        Replace a store of other settings.
    progress : callable, optional
        Called as ``progress(done, total, label)`` with rows.
    scheduler, workers
        Who does the work, see `btfref.sampling.scheduling.run`; without influence on any byte.

    Returns
    -------
    QueryFile

    Raises
    ------
    InputError
        A source or a setting that cannot be used, or a store of other settings at `out`.
    """
    job = QueryJob.of(source, settings, keywords)
    return fill_file(job, out, overwrite=overwrite, progress=progress, scheduler=scheduler, workers=workers)


def fill_file(
    job: QueryJob,
    out: PathLike,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
) -> QueryFile:
    """As `query_file`, of a job."""
    from btfref.querying.distribute import distribute

    if scheduler is not None and not isinstance(job.source, Mesostructure):
        raise InputError(
            "lookups are made by this process", field="scheduler", expected="a geometry as the source"
        )
    with writing(out):
        remove_leftovers(out)
        file = begin(out, job.settings.n, job.attributes, overwrite=overwrite)
        missing = [int(chunk) for chunk in np.flatnonzero(~file.coverage)]
        there = [file.n - sum(b - a for a, b in map(file.extent, missing))]

        def done(chunk: int) -> None:
            first, last = file.extent(chunk)
            there[0] += last - first
            if progress is not None:
                progress(there[0], file.n, "queries")

        if progress is not None:
            progress(there[0], file.n, "queries")
        if scheduler is None:
            job.fill(file, missing, done)
        else:
            distribute(job, file, missing, scheduler, workers, done)
        remove_leftovers(out)
    return file


def is_answering_file(source: PathLike) -> bool:
    """Whether a name is that of a sampled BTF or a representation; any other is a mesostructure's."""
    path = Path(source)
    if path.name.endswith(".zarr"):
        return True
    if path.suffix.lower() != ".exr" or not path.is_file():
        return False
    with path.open("rb") as stream:  # height maps are OpenEXR files, too
        return b"btfref\0string\0" in stream.read(1 << 20)


def fingerprint(path: PathLike) -> str:
    """Hash of a file, or of a folder's files and their names."""
    import hashlib

    path, state = Path(path), hashlib.sha256()
    for one in [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file()):
        if path.is_dir():
            state.update(one.relative_to(path).as_posix().encode())
        with one.open("rb") as stream:
            while block := stream.read(1 << 20):
                state.update(block)
    return state.hexdigest()[:32]


def _representation_facts(source: Representation) -> Facts:
    """What a file says of a representation that has none."""
    import hashlib

    state = hashlib.sha256()
    for name, array in sorted(source.arrays().items()):
        state.update(f"{name} {array.dtype} {array.shape}".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return {"kind": "representation", "method": source.meta.get("method"), "hash": state.hexdigest()[:32]}


def _without(source: Representation, parameters: Facts) -> Representation:
    if parameters:
        raise InputError("a file takes no parameters", field=", ".join(sorted(parameters)), expected="none")
    return source
