"""Queries in a Zarr v3 directory ``NAME.queries.zarr``: written chunk by chunk, resumable, any part readable alone.

========= ======= ======= ==========================================================================
array     shape   type    what
========= ======= ======= ==========================================================================
uv        n, 2    float32 place on the tile, [0, 1)
radius    n       float32 of the footprint, tiles; 0 is a point
w_light   n, 3    float32 unit vector to the light
w_view    n, 3    float32 unit vector to the viewer
density   n       float32 of the laws that the row was drawn from
B         n, 3    float32 f · cos θ_light, 1/sr, mean over the footprint
variance  n, 3    float32 of that mean; NaN where a single sample tells none
samples   n       uint32  that the mean is of
coverage  chunks  uint8   1 where a chunk's rows are there
========= ======= ======= ==========================================================================

Rows are chunks of `CHUNK`. Coverage is written after the rows that it vouches for. Nothing depends on the time, on the
number of attempts or on who works.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from btfref.conventions import COLOUR_SPACE, COSINE_CONVENTION, SCHEMA_VERSION, UNITS
from btfref.errors import InputError
from btfref.outputs import require_folder_of
from btfref.sampling.store.layout import lay_out_whole

if TYPE_CHECKING:
    from btfref.sampling.store.arrays import StoredArray
    from btfref.types import Facts, PathLike

KIND = "btf-queries"

#: What names of such stores end in.
ENDING = ".queries.zarr"

#: Rows of a chunk: 9 MB.
CHUNK = 1 << 17

#: Numbers of a row and their types.
COLUMNS = {
    "uv": (2, "float32"),
    "radius": (0, "float32"),
    "w_light": (3, "float32"),
    "w_view": (3, "float32"),
    "density": (0, "float32"),
    "B": (3, "float32"),
    "variance": (3, "float32"),
    "samples": (0, "uint32"),
}

#: Columns that say what was asked.
ASKED = ("uv", "radius", "w_light", "w_view", "density")

#: Attributes that every file has.
CONVENTIONS = {
    "kind": KIND,
    "cosine_convention": COSINE_CONVENTION,
    "colour_space": COLOUR_SPACE,
    "units": UNITS,
    "directions": "unit vectors away from the surface, local frame, z the macro normal",
    "uv": "u along x, v along y, tile 1 x 1, on the sampling plane z = 0",
    "footprint": "about uv on the sampling plane, seen along w_view; radius in tiles",
    "variance": "of the mean B of each row",
    "density": "product of the laws: per sr, per tile area, per tile; probabilities of sets and levels",
}


class QueryFile:
    """Queries on disk.

    Parameters
    ----------
    path : path-like

    Attributes
    ----------
    path : Path
    attributes : dict
    n : int
        Rows.
    chunk : int
        Rows of a chunk.

    Raises
    ------
    InputError
        No such file, or another kind of file.
    """

    def __init__(self, path: PathLike) -> None:
        import zarr

        self.path = Path(path)
        self.attributes = attributes_of(self.path)
        try:
            group = zarr.open_group(str(self.path), mode="r+")
            self._arrays = {name: cast("StoredArray", group[name]) for name in (*COLUMNS, "coverage")}
            shapes = {name: tuple(array.shape) for name, array in self._arrays.items()}
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise InputError("damaged queries", file=self.path, got=error) from error
        for name, (width, kind) in COLUMNS.items():
            last = (width,) if width else ()
            if str(self._arrays[name].dtype) != kind or shapes[name][1:] != last or not shapes[name]:
                expected = f"{kind}, {width or 1} wide"
                raise InputError("damaged queries", file=self.path, field=name, expected=expected)
        self.n, self.chunk = shapes["uv"][0], int(self._arrays["uv"].chunks[0])
        lengths = {shapes[name][0] for name in COLUMNS}
        if lengths != {self.n} or shapes["coverage"] != (-(-self.n // self.chunk),):
            raise InputError("damaged queries", file=self.path, field="n", got=sorted(lengths))

    def __repr__(self) -> str:
        return f"<QueryFile {self.path.name}: {self.n} rows>"

    def __len__(self) -> int:
        return self.n

    @property
    def coverage(self) -> np.ndarray:
        """Which chunks are there, bool."""
        return np.asarray(self._arrays["coverage"][:]) == 1

    @property
    def complete(self) -> bool:
        """Whether all rows are there."""
        return bool(self.coverage.all())

    def extent(self, chunk: int) -> tuple[int, int]:
        """First row of a chunk and the one behind its last."""
        return chunk * self.chunk, min((chunk + 1) * self.chunk, self.n)

    def read(
        self, first: int = 0, last: int | None = None, columns: tuple[str, ...] = tuple(COLUMNS)
    ) -> dict[str, np.ndarray]:
        """Some rows.

        Parameters
        ----------
        first, last : int
            The first row and the one behind the last.
        columns : tuple of str

        Returns
        -------
        dict of str to ndarray

        Raises
        ------
        InputError
            Rows that are not there yet, or that cannot be read.
        """
        last = self.n if last is None else min(last, self.n)
        missing = ~self.coverage[first // self.chunk : -(-last // self.chunk)]
        if missing.any():
            raise InputError(
                "incomplete: its run was interrupted; start the same command again to finish it",
                file=self.path,
                field="coverage",
                got=f"{self.coverage.mean():.1%}",
                expected="100%",
            )
        try:
            return {name: np.asarray(self._arrays[name][first:last]) for name in columns}
        except (ValueError, RuntimeError) as error:  # a checksum that is wrong
            raise InputError(
                "damaged queries", file=self.path, field=", ".join(columns), got=error
            ) from error

    def batches(
        self, columns: tuple[str, ...] = tuple(COLUMNS)
    ) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """All rows, a chunk at a time, each with the number of its first row."""
        for chunk in range(len(self.coverage)):
            first, last = self.extent(chunk)
            yield first, self.read(first, last, columns)

    def write(self, chunk: int, rows: Mapping[str, np.ndarray]) -> None:
        """Store a chunk; it counts as there only when all of it is on disk."""
        first, last = self.extent(chunk)
        for name in COLUMNS:
            self._arrays[name][first:last] = rows[name]
        self._arrays["coverage"][chunk : chunk + 1] = np.ones(1, np.uint8)

    def facts(self) -> Facts:
        """What its headers say, JSON types."""
        size = sum(entry.stat().st_size for entry in self.path.rglob("*") if entry.is_file())
        return {
            "kind": KIND,
            "n": self.n,
            "coverage": float(self.coverage.mean()),
            "complete": self.complete,
            "file_bytes": size,
            **{key: self.attributes.get(key) for key in ("settings", "source", "versions")},
        }


def open_queries(path: PathLike) -> QueryFile:
    """Open a store of queries without reading rows; see `QueryFile`."""
    return QueryFile(path)


def attributes_of(path: PathLike) -> Facts:
    """Attributes of a store of queries, read from its header alone.

    Raises
    ------
    InputError
        No such file, or another kind of file.
    """
    path = Path(path)
    header = path / "zarr.json"
    if not path.exists():
        raise InputError("no such file", file=path)
    if not header.is_file():
        raise InputError("no queries", file=path, expected="a folder NAME.queries.zarr")
    try:
        attributes = json.loads(header.read_text("utf-8"))["attributes"]
        kind, version = attributes.get("kind"), attributes.get("schema_version")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("header cannot be read", file=path, field="zarr.json", got=error) from None
    if kind != KIND:
        raise InputError("no queries", file=path, field="kind", got=repr(kind), expected=repr(KIND))
    if version not in range(1, SCHEMA_VERSION + 1):
        raise InputError(
            "schema that this version cannot read",
            file=path,
            field="schema_version",
            got=version,
            expected=f"1 to {SCHEMA_VERSION}",
        )
    return attributes


def begin(
    path: PathLike, n: int, attributes: Facts, *, overwrite: bool = False, chunk: int | None = None
) -> QueryFile:
    """The store at a path for some attributes: the one that an earlier run began, or an empty one.

    Parameters
    ----------
    path : path-like
    n : int
        Rows.
    attributes : dict
        JSON types: what the rows depend on.
    overwrite : bool
        Replace a store of other attributes.
    chunk : int, optional
        Rows of a chunk; by default `CHUNK`.

    Raises
    ------
    InputError
        Another store, or something else, and `overwrite` is False; no folder to make it in.
    """
    path = Path(path)
    require_folder_of(path)
    wanted = {"schema_version": SCHEMA_VERSION, **CONVENTIONS, **attributes}
    if path.exists() or path.is_symlink():
        try:
            found = QueryFile(path)
            # A finished file stays what it is when a library is updated; a half-done one must not be mixed.
            judged = set(wanted) - ({"versions"} if found.complete else set())
            plain = json.loads(json.dumps(wanted))
            differ = sorted(key for key in judged if found.attributes.get(key) != plain[key])
            if found.n == n and not differ:
                return found
            problem = InputError(
                "queries of other settings; choose another name or overwrite it",
                file=path,
                field=", ".join(differ) or "n",
            )
        except InputError as error:
            problem = error
        if not overwrite or not _is_ours(path):
            raise problem
        shutil.rmtree(path)
    lay_out_whole(path, lambda draft: _lay_out(draft, n, wanted, min(chunk or CHUNK, n)))
    return QueryFile(path)


def _is_ours(path: Path) -> bool:
    """Whether a folder holds queries, of any version: nothing else is replaced."""
    try:
        header = json.loads((path / "zarr.json").read_text("utf-8"))
        return not path.is_symlink() and header["attributes"]["kind"] == KIND
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _lay_out(path: Path, n: int, attributes: Facts, chunk: int) -> None:
    """Headers of an empty store."""
    import zarr
    from zarr.codecs import Crc32cCodec

    group = zarr.create_group(store=str(path), zarr_format=3, attributes=attributes)
    for name, (width, kind) in COLUMNS.items():
        last = (width,) if width else ()
        group.create_array(
            name,
            shape=(n, *last),
            dtype=kind,
            chunks=(chunk, *last),
            compressors=Crc32cCodec(),  # noise does not get smaller
            fill_value=float("nan") if kind == "float32" else 0,
            dimension_names=["row", "channel"] if width else ["row"],
        )
    count = -(-n // chunk)
    group.create_array(
        "coverage",
        shape=(count,),
        dtype="uint8",
        chunks=(1,),  # whoever makes a chunk says so in a file of its own
        compressors=Crc32cCodec(),
        fill_value=0,
        dimension_names=["chunk"],
    )
