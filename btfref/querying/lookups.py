"""Answers of a sampled BTF or a representation to rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.querying.footprints import level, offset
from btfref.representations.protocol import HasLevels

if TYPE_CHECKING:
    from btfref.querying.settings import QuerySettings
    from btfref.representations.protocol import Representation
    from btfref.types import PathLike

#: How a footprint is looked up: "lookups" averages places in it, "level" takes the level of detail of its width,
#: "point" ignores it.
FILTERS = ("lookups", "level", "point")

#: Lookups of one call of an evaluator.
CHUNK = 1 << 16


def load_source(path: PathLike) -> Representation:
    """A representation from its file; a sampled BTF as the table that its definition interpolates.

    Parameters
    ----------
    path : path-like
        A ``.exr`` file or a ``.btf.zarr`` folder.

    Raises
    ------
    InputError
    """
    from pathlib import Path

    if Path(path).is_dir() or Path(path).suffix == ".zarr":
        from btfref.representations.tabulated import raw
        from btfref.sampling import SampledBTF

        return raw.fit(SampledBTF.load(path, variance=False))
    from btfref.representations.file.container import load

    return load(path)


def lookups(
    representation: Representation,
    rows: Mapping[str, np.ndarray],
    number: np.ndarray,
    *,
    footprint: str,
    count: int,
    seed: int = 0,
    filter: str = "lookups",
) -> dict[str, np.ndarray]:
    """B of rows by a representation.

    Parameters
    ----------
    representation : Representation
    rows : dict of ndarray
        ``uv``, ``radius``, ``w_light``, ``w_view``.
    number : ndarray (n,) of int
        Of the rows in the whole set: they select the random numbers.
    footprint : str
        Its shape.
    count : int
        Random places in a footprint; a point is looked up once.
    seed : int
    filter : {"lookups", "level", "point"}

    Returns
    -------
    dict of str to ndarray
        ``B``, ``variance`` of the mean over the footprint (n, 3) float32, ``samples`` (n,) uint32. Variance is 0
        where nothing is random.

    Raises
    ------
    InputError
        ``filter="level"`` of a method without levels.
    """
    n = len(number)
    b, variance = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    wide = (np.asarray(rows["radius"]) > 0) & (filter == "lookups") & (count > 0)
    samples = np.where(wide, count, 1).astype(np.uint32)
    if filter == "level" and not isinstance(representation, HasLevels):
        raise InputError("the method has no levels of detail", field="filter", got=filter, expected="lookups")
    narrow = np.flatnonzero(~wide)
    for start in range(0, len(narrow), CHUNK):
        part = narrow[start : start + CHUNK]
        extra: dict[str, Any] = {}
        if filter == "level":
            texels = min(representation.meta["texels"])
            extra["lod"] = level(footprint, rows["radius"][part], texels)
        b[part] = representation.evaluate(
            *(np.asarray(rows[name][part], float) for name in ("uv", "w_light", "w_view")), **extra
        )
    broad = np.flatnonzero(wide)
    step = max(1, CHUNK // max(count, 1))
    for start in range(0, len(broad), step):
        part = broad[start : start + step]
        uv = rows["uv"][part, None] + rows["radius"][part, None, None] * _places(
            footprint, seed, number[part], count
        )
        w_light, w_view = (
            np.repeat(np.asarray(rows[name][part], float), count, 0) for name in ("w_light", "w_view")
        )
        values = representation.evaluate(uv.reshape(-1, 2), w_light, w_view).reshape(len(part), count, 3)
        b[part] = values.mean(1)
        variance[part] = np.nan if count == 1 else values.var(1, ddof=1) / count
    return {"B": b, "variance": variance, "samples": samples}


def _places(footprint: str, seed: int, number: np.ndarray, count: int) -> np.ndarray:
    """Random places in a footprint of radius 1 for each row, (n, count, 2), by the rows' numbers alone."""
    first = int(number.min())
    spread = int(number.max()) + 1 - first
    key = np.random.SeedSequence([seed, 2]).generate_state(2, np.uint64)
    # Steps of Philox's counter give four numbers: whole steps for each row.
    steps = -(-2 * count // 4)
    if spread > 4 * len(number) + 64:  # rows far apart: each by itself
        return np.concatenate([_places(footprint, seed, one[None], count) for one in number])
    bits = np.random.Philox(key=key).advance(first * steps)
    u = np.random.Generator(bits).random((spread, 4 * steps))[number - first, : 2 * count]
    return offset(footprint, u.reshape(len(number), count, 2))


class LookupSource:
    """Answers of a representation; as `btfref.querying.paths.PathSource`.

    Parameters
    ----------
    representation : Representation
    settings : QuerySettings
        A target error is refused: lookups have no noise worth placing.
    """

    def __init__(self, representation: Representation, settings: QuerySettings) -> None:
        if settings.target_error is not None:
            raise InputError(
                "lookups have no noise", field="target_error", expected="a geometry as the source"
            )
        if settings.lights_per_path > 1:
            raise InputError(
                "lookups trace no paths", field="lights_per_path", expected="a geometry as the source"
            )
        self.representation, self.settings = representation, settings

    def answer(self, rows: Mapping[str, np.ndarray], number: np.ndarray) -> dict[str, np.ndarray]:
        """See `btfref.querying.paths.PathSource.answer`."""
        return lookups(
            self.representation,
            rows,
            number,
            footprint=self.settings.footprint,
            count=self.settings.samples,
            seed=self.settings.seed,
        )
