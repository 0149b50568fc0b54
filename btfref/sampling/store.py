"""The file of a sampled BTF: a Zarr v3 directory ``NAME.btf.zarr``, written view by view and resumable.

======== ============================== =============== ================================================
array    shape                          type            chunks
======== ============================== =============== ================================================
values   view, light, row, column, 3    float16/float32 one (view, light, tile); one file holds a view
variance the same                       float32         the same; variance of the mean of each value
coverage view, light, tile row, column  uint8           one view; 1 where values (and variance) are there
views    view, 3                        float64         whole
lights   light, 3                       float64         whole
======== ============================== =============== ================================================

A view is one shard (one file): it is written at once, under a temporary name first. Inner chunks carry a
checksum and are read alone by byte ranges. Coverage is written after the values it vouches for, so that a
killed run never looks complete. Attributes hold every convention; nothing in the store depends on the time
or on the number of attempts.

Chunks are uncompressed: on noisy half floats zstd saves 15 % and doubles the time of reading. Tiles of 64²
keep a 64² · 81² BTF at one inner chunk a pair (read whole in 1.3 s, in 4.0 s with tiles of 32²: the cost is
per chunk).
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np

from btfref.conventions import AXES, COLOUR_SPACE, COSINE_CONVENTION, SCHEMA_VERSION, UNITS
from btfref.errors import InputError
from btfref.numerics.directions import checked

#: Texels along one side of an inner chunk.
TILE = 64

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

_SUFFIX = ".partial"


def _zarr():
    import zarr

    return zarr


def attributes_of(path):
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


def create_store(path, *, views, lights, texels, dtype="float16", variance=True, tile=TILE, attributes=None):
    """An empty store; it appears under its name only when all its headers are there.

    Parameters
    ----------
    path : path-like
        Must not exist.
    views, lights : DirectionSet
    texels : tuple of int
        Rows and columns.
    dtype : {"float16", "float32"}
        Type of the values.
    variance : bool
        Whether the variance of the mean is stored.
    tile : int
        Texels along one side of an inner chunk.
    attributes : dict, optional
        JSON types, beside the conventions: seed, parameters, parent, versions …

    Returns
    -------
    BTFStore

    Raises
    ------
    InputError
        The path exists, or its folder does not.
    """
    path = Path(path)
    refuse_existing(path)
    if not path.absolute().parent.is_dir():
        raise InputError("no such folder", file=path.parent)
    # A fixed name: what a killed run left is found and removed by the next one.
    draft = path.with_name(path.name + _SUFFIX)
    shutil.rmtree(draft, ignore_errors=True)
    _write_headers(draft, views, lights, texels, dtype, variance, tile, attributes)
    os.rename(draft, path)
    return BTFStore(path)


def refuse_existing(path):
    """InputError when the path is taken."""
    if path.exists() or path.is_symlink():
        raise InputError("exists already", file=path, expected="a new name (or to overwrite)")


def _write_headers(path, views, lights, texels, dtype, variance, tile, attributes):
    if dtype not in ("float16", "float32"):
        raise InputError("type of the values", field="dtype", got=repr(dtype), expected="float16 or float32")
    zarr = _zarr()
    rows, columns = texels
    n_views, n_lights = len(views), len(lights)
    tile_rows, tile_columns = min(tile, rows), min(tile, columns)
    n_tiles = -(-rows // tile_rows), -(-columns // tile_columns)
    conventions = {"schema_version": SCHEMA_VERSION, **CONVENTIONS}
    names = {"directions": {"views": views.name, "lights": lights.name}}
    group = zarr.create_group(
        store=str(path), zarr_format=3, attributes={**(attributes or {}), **names, **conventions}
    )
    # NaN stands for "not there": no stored value equals it, so that a lost file cannot pass for black texels.
    for name, kind in (("values", dtype), ("variance", "float32")) if variance else (("values", dtype),):
        group.create_array(
            name,
            shape=(n_views, n_lights, rows, columns, 3),
            dtype=kind,
            chunks=(1, 1, tile_rows, tile_columns, 3),
            # A shard holds whole inner chunks, so it may reach beyond the last row and column.
            shards=(1, n_lights, n_tiles[0] * tile_rows, n_tiles[1] * tile_columns, 3),
            compressors=zarr.codecs.Crc32cCodec(),
            fill_value=float("nan"),
            dimension_names=list(AXES),
        )
    group.create_array(
        "coverage",
        shape=(n_views, n_lights, *n_tiles),
        dtype="uint8",
        chunks=(1, n_lights, *n_tiles),
        compressors=zarr.codecs.Crc32cCodec(),
        fill_value=0,
        dimension_names=["view", "light", "tile_row", "tile_column"],
    )
    for name, vectors in (("views", views.vectors), ("lights", lights.vectors)):
        array = group.create_array(
            name,
            shape=vectors.shape,
            dtype="float64",
            compressors=zarr.codecs.Crc32cCodec(),
            fill_value=float("nan"),
        )
        array[:] = vectors


def open_store(path):
    """Open a store without reading values.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    BTFStore

    Raises
    ------
    InputError
        Not a sampled BTF, or a damaged one.
    """
    return BTFStore(path)


def remove_leftovers(path):
    """Remove what killed runs left: drafts beside a store and temporary files inside it.

    Parameters
    ----------
    path : path-like
        The store's final name; it need not exist.
    """
    path = Path(path)
    if path.absolute().parent.is_dir():
        for draft in path.absolute().parent.iterdir():
            if draft.name.startswith(path.name + ".") and draft.name.endswith(_SUFFIX) and draft.is_dir():
                shutil.rmtree(draft, ignore_errors=True)
    if path.is_dir():
        for leftover in path.rglob("*" + _SUFFIX):
            leftover.unlink(missing_ok=True)


class BTFStore:
    """A sampled BTF on disk.

    Attributes
    ----------
    path : Path
    attributes : dict
        Conventions, parameters, parent, versions.
    views, lights : DirectionSet
    texels : tuple of int
        Rows and columns.
    dtype : numpy.dtype
        Type of the stored values.
    has_variance : bool
    """

    def __init__(self, path, *, store=None):
        self.path = Path(path)
        self.attributes = attributes_of(self.path)
        self._group = self._guard("zarr.json", lambda: _zarr().open_group(store or str(self.path), mode="r+"))
        self._values = self._array("values", 5)
        self.has_variance = (self.path / "variance").is_dir()
        self._variance = self._array("variance", 5) if self.has_variance else None
        self._coverage = self._array("coverage", 4)
        names = self.attributes.get("directions", {})
        self.views, self.lights = (
            self._directions(key, names.get(key, "custom")) for key in ("views", "lights")
        )
        self.dtype = np.dtype(self._values.dtype)
        self.texels = tuple(self._values.shape[2:4])
        n_views, n_lights, rows, columns, channels = self._values.shape
        self.tile = tuple(self._values.chunks[2:4])
        if (n_views, n_lights, channels) != (len(self.views), len(self.lights), 3) or 0 in (rows, columns):
            raise InputError(
                "values and directions do not fit",
                file=self.path,
                field="values",
                got=self._values.shape,
                expected=f"({len(self.views)}, {len(self.lights)}, rows, columns, 3)",
            )
        if self.dtype not in (np.float16, np.float32):
            raise InputError(
                "type of the values", file=self.path, field="values", got=self.dtype, expected="float16/32"
            )
        if self.has_variance and self._variance.shape != self._values.shape:
            raise InputError(
                "variance and values do not fit", file=self.path, field="variance", got=self._variance.shape
            )

    def _guard(self, field, action):
        """Whatever Zarr makes of a damaged file becomes one clear line."""
        try:
            return action()
        except InputError:
            raise
        except Exception as error:
            raise InputError("damaged store", file=self.path, field=field, got=error) from error

    def _array(self, name, ndim):
        array = self._guard(name, lambda: self._group[name])
        if getattr(array, "ndim", None) != ndim:
            raise InputError("damaged store", file=self.path, field=name, expected=f"an array of {ndim} axes")
        return array

    def _directions(self, name, spec):
        array = self._array(name, 2)
        return checked(self._guard(name, lambda: array[:]), spec, file=self.path)

    @property
    def coverage(self):
        """Which parts are there: bool, shape (views, lights, tile rows, tile columns)."""
        return self._guard("coverage", lambda: self._coverage[:]) == 1

    @property
    def complete(self):
        """Whether every view, light and tile is there."""
        return bool(self.coverage.all())

    def info(self):
        """Header facts, without reading values.

        Returns
        -------
        dict
            JSON types: kind, shape, directions, type, bytes, coverage, attributes.
        """
        rows, columns = self.texels
        files = [entry for entry in self.path.rglob("*") if entry.is_file()]
        count = len(self.views) * len(self.lights) * rows * columns * 3
        return {
            "kind": KIND,
            "method": "sampled",
            "shape": [len(self.views), len(self.lights), rows, columns, 3],
            "directions": {
                "views": {"name": self.views.name, "count": len(self.views)},
                "lights": {"name": self.lights.name, "count": len(self.lights)},
            },
            "dtype": str(self.dtype),
            "payload_bytes": count * self.dtype.itemsize,
            # As for representations: a ratio is against 32-bit floats.
            "raw_bytes": 4 * count,
            "file_bytes": sum(entry.stat().st_size for entry in files),
            "ratio": 4 / self.dtype.itemsize,
            "coverage": float(self.coverage.mean()),
            "complete": self.complete,
            "has_variance": self.has_variance,
            "parameters": self.attributes.get("parameters", {}),
            "parent": self.attributes.get("parent", {}),
            "seed": self.attributes.get("seed"),
            "versions": self.attributes.get("versions", {}),
            "attributes": self.attributes,
        }

    def write_view(self, view, values, variance=None):
        """Store one view; it counts as there only when all of it is on disk.

        Parameters
        ----------
        view : int
        values : ndarray, shape (lights, rows, columns, 3)
            B in 1/sr, finite; rounded to the stored type.
        variance : ndarray of the same shape, optional
            Variance of the mean; wanted exactly when the store keeps it.

        Raises
        ------
        InputError
            Wrong shape, a value that is not finite, or one beyond the stored type.
        """
        shape = self._values.shape[1:]
        if (variance is not None) != self.has_variance:
            raise InputError(
                "variance of a view", file=self.path, expected="given" if self.has_variance else "none"
            )
        for field, array, target in (
            ("values", values, self._values),
            ("variance", variance, self._variance),
        ):
            if array is None:
                continue
            with np.errstate(over="ignore"):
                stored = np.ascontiguousarray(array, dtype=target.dtype)
            if stored.shape != shape:
                raise InputError("wrong shape", file=self.path, field=field, got=stored.shape, expected=shape)
            check_finite(stored, self.path, field)
            self._guard(field, lambda target=target, stored=stored: target.__setitem__(int(view), stored))
        self._guard("coverage", lambda: self._coverage.__setitem__(int(view), 1))

    def read(self, *, views=None, lights=None, rows=None, columns=None, variance=True):
        """Read a part; only the chunks that hold it are touched.

        Parameters
        ----------
        views, lights, rows, columns : None, int, slice or sequence of int
            None for all. An int keeps its axis with length one.
        variance : bool
            Whether to read the variance, where the store has it.

        Returns
        -------
        values : ndarray, shape (views, lights, rows, columns, 3)
        variance : ndarray float32 or None

        Raises
        ------
        InputError
            The part is not there yet, an index is out of range, a file is missing or damaged, or a value is
            not finite.
        """
        lengths = self._values.shape[:4]
        wanted = zip(
            ("views", "lights", "rows", "columns"), (views, lights, rows, columns), lengths, strict=True
        )
        selection = [_selection(name, index, n) for name, index, n in wanted]
        indices = [np.arange(n)[chosen] for chosen, n in zip(selection, lengths, strict=True)]
        tiles = [np.unique(index // size) for index, size in zip(indices[2:], self.tile, strict=True)]
        covered = self.coverage[np.ix_(indices[0], indices[1], *tiles)]
        if not covered.all():
            raise InputError(
                "part that is not there yet (interrupted run?)",
                file=self.path,
                field="coverage",
                got=f"{covered.mean():.1%} of it",
                expected="all",
            )
        values = self._read("values", self._values, selection)
        return values, self._read(
            "variance", self._variance, selection
        ) if variance and self.has_variance else None

    def _read(self, field, array, selection):
        selection = (*selection, slice(None))
        if all(isinstance(part, slice) for part in selection):
            values = self._guard(field, lambda: array[selection])
        else:
            values = self._guard(field, lambda: array.oindex[selection])
        check_finite(values, self.path, field)
        if field == "variance" and values.size and values.min() < 0:
            raise InputError(
                "negative variance", file=self.path, field=field, got=values.min(), expected="≥ 0"
            )
        return values


def _selection(name, index, n):
    """An index as a slice where it is one (Zarr reads slices much faster), else as an array of int."""
    if index is None:
        return slice(None)
    chosen = (
        np.atleast_1d(np.arange(n)[index]) if isinstance(index, slice) else np.atleast_1d(np.asarray(index))
    )
    if chosen.ndim != 1 or chosen.size == 0 or not np.issubdtype(chosen.dtype, np.integer):
        raise InputError("selection", field=name, got=index, expected="indices")
    if chosen.min() < -n or chosen.max() >= n:
        raise InputError("index out of range", field=name, got=index, expected=f"0 … {n - 1}")
    chosen = np.where(chosen < 0, chosen + n, chosen)
    if (np.diff(chosen) == 1).all():
        return slice(int(chosen[0]), int(chosen[-1]) + 1)
    return chosen


def check_finite(values, path, field):
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
