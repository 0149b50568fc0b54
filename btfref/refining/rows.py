"""What refinement goes by: rows of places, footprints, directions and true values, of queries or of a sampled BTF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.querying.settings import FOOTPRINTS

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import PathLike

#: Rows that are used at most: the first ones of a file, as many random samples of a BTF.
MOST = 1 << 22

#: Columns of a row and their widths, and what stands for a column that may be missing.
_COLUMNS = {"uv": 2, "radius": 0, "w_light": 3, "w_view": 3, "B": 3}


@dataclass(frozen=True)
class Rows:
    """Rows of true values.

    Attributes
    ----------
    columns : dict of str to ndarray of float32
        ``uv`` (n, 2), ``radius`` (n,), ``w_light``, ``w_view``, ``B`` (n, 3).
    footprint : str
        Shape; see `btfref.querying.settings.FOOTPRINTS`.
    source : str
        Where they are from, for the file's history.
    """

    columns: dict[str, np.ndarray]
    footprint: str
    source: str

    def __len__(self) -> int:
        return len(self.columns["B"])

    def part(self, index: np.ndarray) -> Rows:
        """Some of the rows."""
        return Rows({name: a[index] for name, a in self.columns.items()}, self.footprint, self.source)


def rows_of(
    data: PathLike | SampledBTF | Mapping[str, np.ndarray],
    rng: np.random.Generator,
    *,
    footprint: str = "square",
) -> Rows:
    """Rows of whatever data.

    Parameters
    ----------
    data : path-like, SampledBTF or dict of ndarray
        Queries (``.queries.zarr``, or their columns as `btfref.queries` yields them), or a sampled BTF
        (``.btf.zarr``), of which random samples are taken: texel centres, without a footprint.
    rng : numpy.random.Generator
        Chooses the samples of a BTF.
    footprint : str
        Shape of those of columns; a file says its own.

    Raises
    ------
    InputError
        For data that cannot be read, or without rows, or with values that are not finite.
    """
    from btfref.sampling import SampledBTF

    if isinstance(data, Mapping):
        return _checked({name: data.get(name) for name in _COLUMNS}, footprint, "rows")
    if isinstance(data, SampledBTF):
        return _samples(data, rng)
    path = Path(data)
    from btfref.querying.files.zarr_file import ENDING, open_queries

    if path.name.endswith(ENDING):
        file = open_queries(path)
        parts: list[dict[str, np.ndarray]] = []
        for first, rows in file.batches(tuple(_COLUMNS)):
            parts.append(rows)
            if first + len(rows["B"]) >= MOST:
                break
        columns = {name: np.concatenate([part[name] for part in parts])[:MOST] for name in _COLUMNS}
        return _checked(columns, file.attributes["settings"]["footprint"], path.name)
    if path.name.endswith(".zarr") or path.is_dir():
        return _samples(SampledBTF.load(path, variance=False), rng)
    raise InputError(
        "nothing to refine by",
        file=path,
        expected=f"queries (NAME{ENDING}), a sampled BTF (NAME.btf.zarr), or a picture (.exr) and its scene",
    )


def _checked(columns: Mapping[str, np.ndarray | None], footprint: str, source: str) -> Rows:
    if footprint not in FOOTPRINTS:
        raise InputError(
            "unknown footprint", field="footprint", got=repr(footprint), expected=" or ".join(FOOTPRINTS)
        )
    if columns["B"] is None:
        raise InputError("a column is missing", field="B", expected=", ".join(_COLUMNS))
    n = len(columns["B"])
    found = {}
    for name, width in _COLUMNS.items():
        column = columns[name]
        if column is None and name == "radius":
            column = np.zeros(n, np.float32)
        shape = (n, width) if width else (n,)
        got = "nothing" if column is None else np.shape(column)
        if got != shape:
            raise InputError("a column of the rows", field=name, got=got, expected=shape)
        assert column is not None
        found[name] = np.ascontiguousarray(column, np.float32)
        if not np.isfinite(found[name]).all():
            raise InputError("a value that is not finite", field=name)
    return Rows(found, footprint, source)


def _samples(btf: SampledBTF, rng: np.random.Generator) -> Rows:
    """Random samples of a BTF, all where they are few enough; those below the horizon left out."""
    n_views, n_lights, rows, columns, _ = btf.values.shape
    total = n_views * n_lights * rows * columns
    number = np.arange(total) if total <= MOST else rng.integers(0, total, MOST)
    view, light, row, column = np.unravel_index(number, (n_views, n_lights, rows, columns))
    found = {
        "uv": np.stack([(column + 0.5) / columns, (row + 0.5) / rows], -1),
        "radius": np.zeros(len(number)),
        "w_light": btf.lights.vectors[light],
        "w_view": btf.views.vectors[view],
        "B": btf.values[view, light, row, column],
    }
    name = btf.path.name if btf.path else "a sampled BTF"
    return _checked({key: np.asarray(a, np.float32) for key, a in found.items()}, "square", name)
