"""Answers of a sampled BTF or a representation to the rows of a file of queries, and how far off they are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.outputs import new_file
from btfref.querying.accuracy import accuracy
from btfref.querying.files.zarr_file import ASKED, open_queries
from btfref.querying.lookups import FILTERS, load_source, lookups
from btfref.representations.protocol import Representation

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike, Progress

#: Random places in a footprint.
LOOKUPS = 16

#: Its seed: not that of queries whose source is a file.
SEED = 0x5EED

#: Rows that errors are computed from: the first ones; more change no digit that counts.
MOST_JUDGED = 1 << 22


def evaluate(
    source: PathLike | Representation,
    queries: PathLike,
    out: PathLike,
    *,
    count: int = LOOKUPS,
    filter: str = "lookups",
    progress: Progress | None = None,
) -> Facts:
    """Write a method's answers to the rows of a file.

    Parameters
    ----------
    source : path-like or Representation
        ``.exr`` or ``.btf.zarr``.
    queries : path-like
        ``NAME.queries.zarr``, complete.
    out : path-like
        ``NAME.npy``: (n, 3) float32, B in 1/sr.
    count : int
        Random places of a footprint that are averaged; the same for every source.
    filter : {"lookups", "level", "point"}
        Average places in the footprint, take the level of detail of its width, or ignore it.
    progress : callable, optional

    Returns
    -------
    dict
        ``rows``, ``method``, ``filter``, and ``errors``: see `btfref.querying.accuracy.accuracy`; None where the truth
        has no variance.

    Raises
    ------
    InputError
        A source or queries that cannot be read, or a filter that the method does not have.
    """
    if filter not in FILTERS:
        raise InputError("unknown filter", field="filter", got=repr(filter), expected=" or ".join(FILTERS))
    file = open_queries(queries)
    made = source if isinstance(source, Representation) else load_source(source)
    footprint = file.attributes["settings"]["footprint"]
    judged: list[tuple[np.ndarray, ...]] = []
    with new_file(out) as draft:
        values = np.lib.format.open_memmap(draft, "w+", np.float32, (file.n, 3))
        for first, rows in file.batches((*ASKED, "B", "variance")):
            last = first + len(rows["B"])
            found = lookups(
                made, rows, np.arange(first, last), footprint=footprint, count=count, seed=SEED, filter=filter
            )
            values[first:last] = found["B"]
            if first < MOST_JUDGED:
                # Random places of the lookups are noise, too.
                judged.append((found["B"], rows["B"], rows["variance"] + found["variance"]))
            if progress is not None:
                progress(last, file.n, "evaluate")
        values.flush()
        del values
    v, q, s = (np.concatenate(parts) for parts in zip(*judged, strict=True))
    shared = int(file.attributes["settings"].get("lights_per_path", 1))
    return {
        "rows": file.n,
        "method": str(made.meta.get("method")),
        "filter": filter,
        "file": str(Path(out)),
        "errors": accuracy(v, q, s, shared=shared) if np.isfinite(s).all() else None,
    }
