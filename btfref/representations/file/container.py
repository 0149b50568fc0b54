"""Representations as multi-part OpenEXR files: one part per map, the manifest as an attribute.

How a map stands as an image: :mod:`btfref.representations.file.map_images`. The manifest (JSON, attribute ``btfref``
of the first part) keeps shapes and types, so that the maps come back exactly. OpenEXR has no 8-bit channels: uint8
maps, whose value is code / 255, stand in the file as half floats of that value, which viewers show and which round
back to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import SCHEMA_VERSION
from btfref.errors import InputError
from btfref.images.openexr import write
from btfref.outputs import new_file
from btfref.registry import method
from btfref.representations.file.manifest import (
    BLOCKS,
    KIND_BY_ROW,
    KIND_OF_CHECKSUM,
    TYPES,
    block_of,
    check_parts,
    checksums,
    parsed,
    text_of,
)
from btfref.representations.file.map_images import (
    channel_names,
    kept_along,
    leading_axes,
    planes_of,
    rows_alone,
    rows_of,
)
from btfref.representations.file.pixels import rows_read, whole_file
from btfref.representations.file.resident import needed_rows, select
from btfref.representations.file.rows import RowReader
from btfref.representations.file.validator import check_layout, check_values

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from btfref.representations.file.resident import Taken
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike


#: Share of a file's bytes up to which reading its rows one by one is faster than the whole by OpenEXR: the former
#: takes 2.2 to 2.8 times as long a byte.
WORTH = 0.35
_MAGIC = bytes((0x76, 0x2F, 0x31, 0x01))


def save(representation: Representation, path: PathLike) -> None:
    """Write a representation to ``path`` atomically.

    Parameters
    ----------
    representation : Representation
    path : path-like
        By convention ``NAME.KEY.exr``.

    Raises
    ------
    InputError
        When the directory does not exist or cannot be written.
    """
    import OpenEXR

    path = Path(path)
    arrays = {name: np.asarray(array) for name, array in representation.arrays().items()}
    manifest: Facts = {
        "schema": SCHEMA_VERSION,
        "kind": "representation",
        "meta": representation.meta,
        "arrays": {name: {"shape": list(a.shape), "dtype": a.dtype.name} for name, a in arrays.items()},
    }
    rows_by = {name: leading_axes(type(representation), name) for name in arrays}
    for name, axes in rows_by.items():
        if axes:
            manifest["arrays"][name]["rows"] = axes
    images = {name: _stored_planes(name, array, rows_by[name]) for name, array in arrays.items()}
    alone = {name for name, entry in manifest["arrays"].items() if rows_alone(entry)}
    for name, image in images.items():
        kind = KIND_BY_ROW if name in alone else KIND_OF_CHECKSUM
        manifest["arrays"][name][kind] = checksums(image, BLOCKS[kind])
    display = (
        np.zeros(2, np.int32),
        np.array(
            [
                max(i[0].shape[1] for i in images.values()) - 1,
                max(i[0].shape[0] for i in images.values()) - 1,
            ],
            np.int32,
        ),
    )
    parts: list[OpenEXR.Part] = []
    for name, planes in images.items():
        header = {
            "name": name,
            "type": OpenEXR.scanlineimage,
            "compression": OpenEXR.ZIPS_COMPRESSION if name in alone else OpenEXR.ZIP_COMPRESSION,
            "displayWindow": display,
            "dataWindow": (
                np.zeros(2, np.int32),
                np.array([planes[0].shape[1] - 1, planes[0].shape[0] - 1], np.int32),
            ),
        }
        if not parts:
            header |= text_of(manifest)
        channels = dict(zip(channel_names(len(planes)), planes, strict=True))
        parts.append(OpenEXR.Part(header, channels, name))
    with new_file(path) as draft:
        write(parts, draft)


def _stored_planes(name: str, array: np.ndarray, leading: Sequence[int]) -> list[np.ndarray]:
    """Channels of a map as the images that stand in the file."""
    if array.dtype.name not in TYPES:
        raise TypeError(f"map {name} must be one of {TYPES}, got {array.dtype}")
    planes = planes_of(array, leading)
    return [(p / 255).astype(np.float16) for p in planes] if array.dtype == np.uint8 else planes


def load(
    path: PathLike,
    *,
    views: ArrayLike | None = None,
    lights: ArrayLike | None = None,
    entries: ArrayLike | None = None,
    levels: ArrayLike | None = None,
) -> Representation:
    """Read a representation.

    Parameters
    ----------
    path : path-like
    views, lights : array_like of int, optional
        Keep the maps of these directions only; see :mod:`btfref.representations.file.resident`. What is not kept is not
        read either where it stands in parts or rows of its own and reading the rest alone is worth it.
    entries, levels : array_like of int, optional
        Keep these entries of codebooks (clusters, materials), and these levels of detail, only.

    Returns
    -------
    Representation

    Raises
    ------
    InputError
        When the file is missing, empty, not an OpenEXR file, truncated, written by a newer schema, of an unknown
        method, or holds a value that is not finite; when something cannot be chosen.
    """
    choice = {"views": views, "lights": lights, "entries": entries, "levels": levels}
    chosen = any(indices is not None for indices in choice.values())
    manifest, reader = _opened(path)
    with reader:
        arrays, taken = (_read_some(reader, manifest, choice) if chosen else None) or (None, None)
    if arrays is None:
        arrays = whole_file(path, manifest)
    meta = manifest["meta"]
    kind = method(meta["method"], file=path).representation
    check_values(arrays, manifest, kind, path)
    arrays, meta = select(arrays, meta, kind, **choice, taken=taken, file=path)
    return kind.from_arrays(arrays, meta)


def read_maps(path: PathLike, wanted: Callable[[str], bool]) -> tuple[dict[str, np.ndarray], Facts]:
    """Some maps of a file, the others not read.

    Parameters
    ----------
    path : path-like
    wanted : callable
        Name of a map -> whether it is read.

    Returns
    -------
    arrays : dict of str to ndarray
    meta : dict

    Raises
    ------
    InputError
        As for :func:`load`.
    """
    manifest, reader = _opened(path)
    arrays = {}
    with reader:
        for name, entry in manifest["arrays"].items():
            if wanted(name):
                if not reader.knows(name):
                    raise InputError("a map is missing or compressed in another way", file=path, field=name)
                arrays[name] = rows_read(reader, name, entry, manifest, {})
    check_values(arrays, manifest, method(manifest["meta"]["method"], file=path).representation, path)
    return arrays, manifest["meta"]


def bytes_of_choice(path: PathLike, choice: Mapping[str, ArrayLike | None]) -> int:
    """How many bytes of a file :func:`load` reads for a choice of views, lights, entries and levels.

    Parameters
    ----------
    path : path-like
    choice : dict
        Arguments of :func:`load`.

    Returns
    -------
    int
    """
    manifest, reader = _opened(path)
    with reader:
        read = _read_some(reader, manifest, choice)
        return Path(path).stat().st_size if read is None else reader.bytes_read


def _read_some(
    reader: RowReader, manifest: Facts, choice: Mapping[str, ArrayLike | None]
) -> tuple[dict[str, np.ndarray], Taken] | None:
    """The maps with what a choice needs along axes that are rows, and what :func:`select` is told of these axes.

    None where reading the whole file takes no longer.
    """
    path = reader.path
    kind = method(manifest["meta"]["method"], file=path).representation
    sizes = {
        name: int(np.prod(entry["shape"], dtype=np.int64)) * np.dtype(entry["dtype"]).itemsize
        for name, entry in manifest["arrays"].items()
    }
    wanted = needed_rows(kind, manifest, choice)
    entries = manifest["arrays"]
    plans = {name: rows_of(entries[name], axes) for name, axes in wanted.items()}
    if not all(reader.knows(name) for name in plans):
        return None
    shares = {name: reader.share(name, rows, block_of(entries[name])) for name, rows in plans.items()}
    if sum(sizes[name] * share for name, share in shares.items()) > WORTH * sum(sizes.values()):
        return None
    arrays = {name: rows_read(reader, name, entries[name], manifest, axes) for name, axes in wanted.items()}
    taken = {
        name: {axis: entries[name]["shape"][axis] for axis in kept_along(entries[name], axes)}
        for name, axes in wanted.items()
    }
    return arrays, taken


def read_info(path: PathLike) -> Facts:
    """Facts about a representation, from its headers only.

    Returns
    -------
    dict
        ``kind``, ``method``, ``shape`` [views, lights, rows, columns, 3] of the BTF it stands for, ``directions``,
        ``maps`` with the shape, type and bytes of each, ``payload_bytes`` (the maps alone, counted as the papers
        count: no direction tables, an index map at the width its codebook needs), ``file_bytes``, ``raw_bytes`` (the
        BTF as 32-bit floats), ``ratio``, ``parameters``, ``fit`` (what the fit measured of itself),
        ``parent``, ``versions``; for methods whose paper counts the bytes of
        a layout of its own, ``published_layout`` with those.
    """
    manifest = _header(path)
    meta, maps = manifest["meta"], manifest["arrays"]
    views, lights = meta["views"], meta["lights"]
    shape = [views["count"], lights["count"], *meta["texels"], 3]
    maps = {name: {what: entry[what] for what in ("shape", "dtype")} for name, entry in maps.items()}
    maps = {name: {**entry, "bytes": map_bytes(name, **entry, meta=meta)} for name, entry in maps.items()}
    payload = payload_bytes({name: (entry["shape"], entry["dtype"]) for name, entry in maps.items()}, meta)
    raw = 4 * int(np.prod(shape, dtype=np.int64))
    return {
        "kind": "representation",
        "method": meta["method"],
        "shape": shape,
        "directions": {"views": views, "lights": lights},
        "filter_type": meta["filter_type"],
        "maps": maps,
        "payload_bytes": payload,
        "file_bytes": Path(path).stat().st_size,
        "raw_bytes": raw,
        "ratio": raw / payload,
        **({"published_layout": meta["published_layout"]} if "published_layout" in meta else {}),
        "parameters": meta["parameters"],
        "fit": meta.get("fit", {}),
        "parent": meta["parent"],
        "versions": meta["versions"],
    }


def payload_bytes(maps: Mapping[str, tuple[Sequence[int], str]], meta: Facts) -> int:
    """Bytes of the maps alone, without direction tables.

    Parameters
    ----------
    maps : dict of str to (shape, dtype name)
    meta : dict
        See :func:`map_bytes`.
    """
    return sum(
        map_bytes(name, shape, dtype, meta)
        for name, (shape, dtype) in maps.items()
        if not name.startswith(("view_", "light_"))
    )


def map_bytes(name: str, shape: Sequence[int], dtype: str, meta: Facts) -> int:
    """Bytes of one map.

    Parameters
    ----------
    name : str
    shape : sequence of int
    dtype : str
    meta : dict
        ``index_bytes`` maps the name of an index map to the bytes that one index needs.
    """
    width = meta.get("index_bytes", {}).get(name, np.dtype(dtype).itemsize)
    return width * int(np.prod(shape, dtype=np.int64))


def refuse_store(path: Path) -> None:
    """InputError for a sampled BTF where a representation is wanted, with the command that makes one of it."""
    if path.is_dir() and (path.name.endswith(".btf.zarr") or (path / "zarr.json").is_file()):
        stem = path.name.removesuffix(".zarr").removesuffix(".btf")
        raise InputError(
            "a sampled BTF, not a representation",
            file=path,
            expected=f"one that a fit made: run `btfref fit raw {path} -o {stem}.raw.exr`",
        )


def _opened(path: PathLike) -> tuple[Facts, RowReader]:
    """The manifest of a file and a reader of its rows, after every check that needs no pixels."""
    path = Path(path)
    refuse_store(path)
    if not path.is_file():
        raise InputError("no such file" if not path.exists() else "not a file", file=path)
    if path.stat().st_size == 0:
        raise InputError("the file is empty", file=path)
    with path.open("rb") as stream:
        magic = stream.read(4)
    if magic != _MAGIC:
        raise InputError(
            "not an OpenEXR file", file=path, field="magic number", got=magic.hex(), expected=_MAGIC.hex()
        )
    reader = RowReader(path)
    try:
        found = parsed(reader.attributes, path)
        check_parts(found, reader, path)
        check_layout(found, method(found["meta"]["method"], file=path).representation, path)
    except BaseException:
        reader.close()
        raise
    return found, reader


def _header(path: PathLike) -> Facts:
    """The manifest alone."""
    manifest, reader = _opened(path)
    reader.close()
    return manifest
