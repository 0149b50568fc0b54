"""Queries as they come, without a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.querying.settings import QuerySettings

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.querying.job import QueryJob
    from btfref.representations.protocol import Representation
    from btfref.types import PathLike

#: Rows of a batch where nobody asks for another number.
BATCH = 1 << 16


def queries(
    source: PathLike | Mesostructure | Representation = "checker",
    settings: QuerySettings | None = None,
    *,
    batch: int = BATCH,
    first: int = 0,
    **keywords: Any,
) -> Iterator[dict[str, np.ndarray]]:
    """Yield B at random places, footprints and pairs of directions, batch by batch.

    Parameters
    ----------
    source : str, path-like, Mesostructure or Representation
        A modelled surface, a mesh, a height map or a folder of maps, as `btfref.synthesize` takes them; or a sampled
        BTF (``.btf.zarr``) or a representation (``.exr``).
    settings : QuerySettings, optional
        By default those of `btfref.querying.settings.QuerySettings`, whose documentation says what they are.
    batch : int
        Rows of a batch; without influence on any row.
    first : int
        Row to begin with.
    **keywords
        Single settings, such as ``n=100_000, light="cosine"``; all others are parameters of the mesostructure.

    Yields
    ------
    dict of str to ndarray
        ``uv`` (n, 2), ``radius`` (n,), ``w_light``, ``w_view`` (n, 3), ``density`` (n,), ``B`` (n, 3) in 1/sr with the
        cosine, ``variance`` (n, 3) of that mean, ``samples`` (n,).

    Raises
    ------
    InputError
        A source or a setting that cannot be used.

    Examples
    --------
    >>> import btfref
    >>> batch = next(btfref.queries("checker", n=4, spp=2, radius=0.01))
    >>> batch["B"].shape, batch["samples"].tolist()
    ((4, 3), [2, 2, 2, 2])
    """
    from btfref.querying.job import QueryJob

    if isinstance(batch, bool) or not isinstance(batch, int) or batch < 1:
        raise InputError("rows of a batch", field="batch", got=batch, expected="a whole number ≥ 1")
    job = QueryJob.of(source, settings, keywords)
    n = job.settings.n
    if not 0 <= first <= n:
        raise InputError("row to begin with", field="first", got=first, expected=f"0 to {n}")
    return _batches(job, batch, first)


def _batches(job: QueryJob, batch: int, first: int) -> Iterator[dict[str, np.ndarray]]:
    """The rows; the source is made inside, since a block of a variant must not stay open between batches."""
    answering = None
    for start in range(first, job.settings.n, batch):
        with job.ready():
            answering = answering or job.make_source()
            rows = job.rows(answering, start, min(batch, job.settings.n - start))
        yield rows
