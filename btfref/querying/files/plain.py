"""Queries as NumPy's ``.npz`` and as Parquet."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import Limit, MissingDependencyError
from btfref.querying.files.zarr_file import COLUMNS

if TYPE_CHECKING:
    from btfref.querying.files.zarr_file import QueryFile

#: Rows of a ``.npz``.
SMALL = Limit(10_000_000, "a .npz is read as a whole; Zarr, HDF5 and Parquet are not")

#: Names of the numbers of a column in Parquet.
_PARTS = {"uv": "uv", "w_light": "xyz", "w_view": "xyz", "B": "rgb", "variance": "rgb"}


def write_npz(queries: QueryFile, out: Path) -> None:
    """Write all columns, and the attributes as JSON text."""
    arrays: dict[str, Any] = {**queries.read(), "attributes": np.array(json.dumps(queries.attributes))}
    np.savez(out, **arrays)


def parquet_columns() -> list[tuple[str, str, int | None]]:
    """Name in Parquet, column it is of and which of its numbers."""
    return [
        (f"{name}_{part}" if name != "uv" else part, name, k)
        for name, (width, _) in COLUMNS.items()
        for k, part in enumerate(_PARTS[name] if width else " ")
        if width
    ] + [(name, name, None) for name, (width, _) in COLUMNS.items() if not width]


def write_parquet(queries: QueryFile, out: Path) -> None:
    """Write flat columns (``u``, ``v``, ``w_light_x``, …), a chunk of rows a row group.

    Raises
    ------
    MissingDependencyError
        pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise MissingDependencyError(
            "pyarrow is not installed, which Parquet needs", "pip install 'btfref[datasets]'"
        ) from None
    columns = parquet_columns()
    types = {"float32": pyarrow.float32(), "uint32": pyarrow.uint32()}
    schema = pyarrow.schema(
        [(label, types[COLUMNS[name][1]]) for label, name, _ in columns],
        metadata={b"btfref": json.dumps(queries.attributes).encode()},
    )
    with parquet.ParquetWriter(out, schema, compression="NONE") as writer:
        for _, rows in queries.batches():
            arrays = [
                pyarrow.array(rows[name] if k is None else np.ascontiguousarray(rows[name][:, k]))
                for _, name, k in columns
            ]
            writer.write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
