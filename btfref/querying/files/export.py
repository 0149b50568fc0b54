"""Which file is written, by its name."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError, refuse_above
from btfref.outputs import new_file
from btfref.querying.files.croissant import write_croissant
from btfref.querying.files.hdf5 import LAYOUTS, TEXELS, h5py, write_product, write_records
from btfref.querying.files.plain import SMALL, write_npz, write_parquet
from btfref.querying.files.zarr_file import ENDING

if TYPE_CHECKING:
    from btfref.querying.files.zarr_file import QueryFile
    from btfref.types import Facts

#: Endings of files of queries.
ENDINGS = (ENDING, ".h5", ".hdf5", ".npz", ".parquet")

#: Stands behind an output's name while its rows are made: an interrupted run goes on from there.
ROWS = ".rows.zarr.partial"


def rows_of(out: Path) -> Path:
    """Where the rows of an output are made: a store itself, or one beside it that is given up when it is written."""
    return out if out.name.endswith(ENDING) else out.with_name(out.name + ROWS)


def check(out: Path, n: int, layout: str | None, dtype: str, picture: object) -> None:
    """Refuse what cannot be written before any row is made.

    Raises
    ------
    InputError, MissingDependencyError
    """
    if not out.name.endswith(ENDINGS):
        raise InputError(
            "cannot tell the file type", file=out, expected=f"a name ending in {', '.join(ENDINGS)}"
        )
    if out.suffix == ".npz":
        refuse_above(SMALL, n, "--n")
    hdf5 = out.suffix in (".h5", ".hdf5")
    if (layout is not None or dtype != "float32") and not hdf5:
        raise InputError(
            "of HDF5 alone", field="--layout, --dtype", got=out.name, expected="a name ending in .h5"
        )
    if hdf5:
        h5py()
        if layout == "product" and picture is None:
            raise InputError(
                "rows that are no pictures", field="--layout", got="product", expected="--picture HxW"
            )
    if out.suffix == ".parquet":
        try:
            import pyarrow  # noqa: F401 - whether it is there
        except ImportError:
            write_parquet(None, out)  # type: ignore[arg-type]  # which says what is missing


def export(
    queries: QueryFile, out: Path, *, layout: str | None, dtype: str = "float32", texels: int = TEXELS
) -> Facts:
    """Write finished rows under a name, and their metadata beside it; give up the rows where they are not the output.

    Parameters
    ----------
    queries : QueryFile
    out : Path
    layout : {"records", "product"} or None
        Of HDF5; None for ``product`` where the rows are pictures, else ``records``.
    dtype : str
        Of HDF5.
    texels : int
        Of HDF5's records.

    Returns
    -------
    dict
        ``file``, ``file_bytes``, ``metadata``.
    """
    if queries.path != out:
        with new_file(out) as draft:
            if out.suffix in (".h5", ".hdf5"):
                if layout is None:
                    layout = LAYOUTS[queries.attributes["settings"]["laws"]["picture"] is not None]
                if layout == "product":
                    write_product(queries, draft, dtype=dtype)
                else:
                    write_records(queries, draft, dtype=dtype, texels=texels)
            elif out.suffix == ".npz":
                write_npz(queries, draft)
            else:
                write_parquet(queries, draft)
    beside = write_croissant(queries, out)
    if queries.path != out:
        shutil.rmtree(queries.path, ignore_errors=True)
    size = sum(p.stat().st_size for p in ([out] if out.is_file() else out.rglob("*")) if p.is_file())
    return {"file": str(out), "file_bytes": size, "metadata": str(beside)}
