"""The file of a sampled BTF: a Zarr v3 directory ``NAME.btf.zarr``, written shard by shard and resumable.

======== ============================== =============== ================================================
array    shape                          type            chunks
======== ============================== =============== ================================================
values   view, light, row, column, 3    float16/float32 one (view, light, tile); one file holds a shard
variance the same                       float32         the same; variance of the mean of each value
coverage view, light, tile row, column  uint8           one view; 1 where values (and variance) are there
views    view, 3                        float64         whole
lights   light, 3                       float64         whole
======== ============================== =============== ================================================

A shard is one file, written at once, under a temporary name first: a view, or some tiles of it where a view is
larger than `SHARD`. Inner chunks carry a checksum and are read alone by byte ranges. Coverage is written after
the values it vouches for, so that a killed run never looks complete. Attributes hold every convention; nothing
in the store depends on the time or on the number of attempts.

Stores made to a target error have three more arrays, a view a chunk (see `btfref.sampling.paths.adaptive`):

======== =================== ======= =============================================================================
pilot    view, row, column, 3 float32 of two pilots, mean variance of one sample each; their mean value
samples  view, row, column    uint32  samples that the texel got in this view
reached  view, row, column, 2 float32 mean variance of the mean, and mean value, over lights and channels
======== =================== ======= =============================================================================

Chunks are uncompressed: on noisy half floats zstd saves 15 % and doubles the time of reading. Tiles of 64²
keep a 64² · 81² BTF at one inner chunk a pair (read whole in 1.3 s, in 4.0 s with tiles of 32²: the cost is
per chunk).
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import AXES, COLOUR_SPACE, COSINE_CONVENTION, SCHEMA_VERSION, UNITS
from btfref.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.types import Facts, PathLike

#: Texels along one side of an inner chunk at most: see `side_of`.
TILE = 64

#: Bytes (as 32-bit floats) that a shard holds at most, unless a single chunk is larger: what must be in memory
#: to write a part of a view.
SHARD = 64 << 20

KIND = "sampled-btf"

#: Attributes that every store has, with the only value that this version writes and reads.
CONVENTIONS = {
    "kind": KIND,
    "cosine_convention": COSINE_CONVENTION,
    "colour_space": COLOUR_SPACE,
    "axes": list(AXES),
    "units": UNITS,
    "texels": "row 0 at v = 0, centres at (i + 1/2)/n, wrap-around",
    "interpolation": "rings: linear in phi and theta; scattered: spherical Delaunay, barycentric",
    "variance": "variance of the mean of each value; quantization to the stored type not included",
}

#: Ends the name of whatever is not finished.
DRAFT = ".partial"

#: Ends the name of what says who writes a store: :mod:`btfref.sampling.store.lock`.
LOCK = ".lock.partial"


def attributes_of(path: PathLike) -> Facts:
    """Attributes of a store, read from its header alone.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict

    Raises
    ------
    InputError
        Not a sampled BTF, or one of another convention or a newer schema.
    """
    path = Path(path)
    header = path / "zarr.json"
    if not path.exists():
        raise InputError("no such file", file=path)
    if not path.is_dir() or not header.is_file():
        raise InputError("not a BTF store", file=path, expected="a Zarr v3 directory with zarr.json")
    try:
        attributes = json.loads(header.read_text(encoding="utf-8"))["attributes"]
        kind = attributes.get("kind")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "header cannot be read", file=path, field="zarr.json", got=error, expected="JSON"
        ) from None
    if kind != KIND:
        raise InputError("not a BTF store", file=path, field="kind", got=repr(kind), expected=repr(KIND))
    version = attributes.get("schema_version")
    if not isinstance(version, int) or version > SCHEMA_VERSION or version < 1:
        raise InputError(
            "schema that this version cannot read",
            file=path,
            field="schema_version",
            got=version,
            expected=f"1 to {SCHEMA_VERSION}",
        )
    for key in ("cosine_convention", "colour_space", "axes", "units"):
        if attributes.get(key) != CONVENTIONS[key]:
            raise InputError(
                "store of another convention",
                file=path,
                field=key,
                got=attributes.get(key),
                expected=CONVENTIONS[key],
            )
    return attributes


def shard_shape(n_lights: int, texels: tuple[int, int], tile: tuple[int, int]) -> tuple[int, int, int]:
    """Lights, tile rows and tile columns of one shard.

    Parameters
    ----------
    n_lights : int
    texels : tuple of int
        Rows and columns.
    tile : tuple of int
        Rows and columns of an inner chunk.

    Returns
    -------
    tuple of int
    """
    rows, columns = (-(-n // side) for n, side in zip(texels, tile, strict=True))
    chunk = 12 * tile[0] * tile[1]
    lights = max(1, min(n_lights, SHARD // chunk))
    columns = max(1, min(columns, SHARD // (chunk * lights)))
    whole = -(-texels[1] // tile[1])
    rows = max(1, min(rows, SHARD // (chunk * lights * columns))) if columns == whole else 1
    return lights, rows, columns


def side_of(texels: int, most: int) -> int:
    """Texels along one side of a chunk, for so many in all: as many chunks as there must be, as alike as they can be.

    A chunk is stored whole, also where it reaches beyond the last texel: 400 texels in chunks of 64 take the place of
    448, in chunks of 58 that of 406.

    Parameters
    ----------
    texels : int
    most : int
        Of a chunk.

    Returns
    -------
    int
    """
    return -(-texels // -(-texels // most))


def write_headers(
    path: PathLike,
    views: DirectionSet,
    lights: DirectionSet,
    texels: tuple[int, int],
    dtype: str,
    variance: bool,
    tile: int,
    attributes: Facts | None,
    adaptive: bool = False,
) -> None:
    """Lay out an empty store; arguments as of `btfref.sampling.store.store.create_store`."""
    if dtype not in ("float16", "float32"):
        raise InputError("type of the values", field="dtype", got=repr(dtype), expected="float16 or float32")
    import zarr
    from zarr.codecs import Crc32cCodec

    rows, columns = texels
    n_views, n_lights = len(views), len(lights)
    tile_rows, tile_columns = side_of(rows, tile), side_of(columns, tile)
    n_tiles = -(-rows // tile_rows), -(-columns // tile_columns)
    shard = shard_shape(n_lights, texels, (tile_rows, tile_columns))
    conventions = {"schema_version": SCHEMA_VERSION, **CONVENTIONS}
    arrays = (("values", dtype), ("variance", "float32")) if variance else (("values", dtype),)
    names = {
        "directions": {"views": views.name, "lights": lights.name},
        "arrays": [name for name, _ in arrays],
    }
    group = zarr.create_group(
        store=str(path), zarr_format=3, attributes={**(attributes or {}), **names, **conventions}
    )
    # NaN stands for "not there": no stored value equals it, so that a lost file cannot pass for black texels.
    for name, kind in arrays:
        group.create_array(
            name,
            shape=(n_views, n_lights, rows, columns, 3),
            dtype=kind,
            chunks=(1, 1, tile_rows, tile_columns, 3),
            # A shard holds whole inner chunks, so it may reach beyond the last row and column.
            shards=(1, shard[0], shard[1] * tile_rows, shard[2] * tile_columns, 3),
            compressors=Crc32cCodec(),
            fill_value=float("nan"),
            dimension_names=list(AXES),
        )
    group.create_array(
        "coverage",
        shape=(n_views, n_lights, *n_tiles),
        dtype="uint8",
        chunks=(1, n_lights, *n_tiles),
        compressors=Crc32cCodec(),
        fill_value=0,
        dimension_names=["view", "light", "tile_row", "tile_column"],
    )
    for name, kind, channels in (
        ("pilot", "float32", 3),
        ("samples", "uint32", 0),
        ("reached", "float32", 2),
    ):
        if not adaptive:
            break
        last = (channels,) if channels else ()
        group.create_array(
            name,
            shape=(n_views, rows, columns, *last),
            dtype=kind,
            chunks=(1, rows, columns, *last),
            compressors=Crc32cCodec(),
            fill_value=float("nan") if kind == "float32" else 0,
        )
    for name, vectors in (("views", views.vectors), ("lights", lights.vectors)):
        array = group.create_array(
            name,
            shape=vectors.shape,
            dtype="float64",
            compressors=Crc32cCodec(),
            fill_value=float("nan"),
        )
        array[:] = vectors


def lay_out_whole(path: Path, lay_out: Callable[[Path], None]) -> None:
    """A folder that appears under its name once `lay_out` has made all of it.

    Parameters
    ----------
    path : Path
        Does not exist.
    lay_out : callable
        ``lay_out(draft)`` fills another folder.
    """
    # A fixed name: what a killed run left is found and removed by the next one.
    draft = path.with_name(path.name + DRAFT)
    shutil.rmtree(draft, ignore_errors=True)
    try:
        lay_out(draft)
        os.rename(draft, path)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        if isinstance(error, OSError) and error.errno is not None:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise


def remove_leftovers(path: PathLike) -> None:
    """Remove what killed runs left: drafts beside a store and temporary files inside it.

    Parameters
    ----------
    path : path-like
        The store's final name; it need not exist.
    """
    path = Path(path)
    if path.absolute().parent.is_dir():
        for draft in path.absolute().parent.iterdir():
            if not (draft.name.startswith(path.name + ".") and draft.name.endswith(DRAFT)):
                continue
            if draft.name == path.name + LOCK:  # held, or ended with its process
                continue
            if draft.is_dir():
                shutil.rmtree(draft, ignore_errors=True)
            else:
                draft.unlink(missing_ok=True)
    if path.is_dir():
        for leftover in path.rglob("*" + DRAFT):
            leftover.unlink(missing_ok=True)


def replace_store(draft: PathLike, path: PathLike) -> None:
    """Give a finished store its name, in place of an older *store* of that name; other things are kept.

    Parameters
    ----------
    draft, path : path-like

    Raises
    ------
    InputError
        Something else than a sampled BTF has that name.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        remove_store(path)
    os.rename(draft, path)


def remove_store(path: PathLike) -> None:
    """Remove a sampled BTF; refuses anything that is not one.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    InputError
        Something else than a sampled BTF has that name.
    """
    path = Path(path)
    header = path / "zarr.json"
    if path.is_symlink() or not header.is_file() or b'"sampled-btf"' not in header.read_bytes():
        raise InputError("exists and is not a BTF store; it is left alone", file=path)
    # Renamed first, so that a kill in the middle leaves no store that has lost some of its files.
    removed = path.with_name(path.name + ".removed.partial")
    shutil.rmtree(removed, ignore_errors=True)
    os.rename(path, removed)
    shutil.rmtree(removed)


def check_finite(values: np.ndarray, path: PathLike | None, field: str) -> None:
    """InputError with the place of the first value that is NaN or infinite."""
    # Slab by slab: a full boolean copy of a large BTF would not be small.
    for index, slab in enumerate(values):
        if not np.isfinite(slab).all():
            place = np.argwhere(~np.isfinite(slab))[0].tolist()
            raise InputError(
                "value that is not finite (or beyond the type's range)",
                file=path,
                field=f"{field}[{', '.join(map(str, [index, *place]))}]",
                got=slab[tuple(place)] if place else slab,
                expected="finite",
            )
