"""The one check that a file passes before any evaluator sees it: shapes first, values when they are there.

Evaluators index tables with what other tables hold, two of them without any bounds of their own. What is checked here
once need not be checked by each of them: every number that is an index is below what it indexes, the maps fit each
other, the tables of directions are those of the directions, constants are those of the maps.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.directions import spherical
from btfref.numerics.sphere.interpolation import MISSING, TRIANGLE_FLOATS, barycentric
from btfref.numerics.sphere.parabolic import square_to_hemisphere
from btfref.representations.file.schema import (
    FLOATS,
    INDICES,
    LARGEST,
    Edge,
    MapSchema,
    Number,
    OneOf,
    Range,
    Schema,
    bound,
)
from btfref.representations.protocol import HasSchema

if TYPE_CHECKING:
    from collections.abc import Mapping

    from btfref.types import Facts, PathLike

#: Radians, or lengths, by which a table of directions may differ from the directions: both are float32, whose rounding
#: at an azimuth of 2π moves a direction by 5e-7; the nearest directions of any measured set are 10⁴ times as far apart.
DIRECTION_TOLERANCE = 1e-5

#: By which products of a triangle's dual normals with its corners may differ from 0 and 1, relative to the normals'
#: lengths: float32 rounds each of three products.
DUAL_TOLERANCE = 1e-5

#: Texels, entries of tables: what ports count in 32 bits.
MOST_ENTRIES = 2**32 - 1

_KINDS = ("view", "light")

#: Constants that are an array of numbers in GLSL.
_NUMBERS = re.compile(r"(int|float)\[\d+\]\([-+.,\de ]*\)")


class _Check:
    """What is wrong, said of one file."""

    def __init__(self, path: PathLike) -> None:
        self.path = path

    def refuse(
        self, field: str, got: object, expected: object, message: str = "a map is damaged"
    ) -> NoReturn:
        raise InputError(message, file=self.path, field=field, got=got, expected=expected)


def check_layout(manifest: Facts, kind: object, path: PathLike) -> None:
    """Shapes and types of all maps against each other, and constants: what needs no pixels.

    Parameters
    ----------
    manifest : dict
        As :func:`btfref.representations.file.manifest.parsed` gives it.
    kind : type
        Class of the method's representations.
    path : path-like

    Raises
    ------
    InputError
        With the map or constant, what it is and what was expected.
    """
    check, meta = _Check(path), manifest["meta"]
    shapes = {name: tuple(entry["shape"]) for name, entry in manifest["arrays"].items()}
    types = {name: entry["dtype"] for name, entry in manifest["arrays"].items()}
    rows, columns = meta["texels"]
    numbers = {"rows": rows, "columns": columns}
    direction_maps: set[str] = set()
    for one in _KINDS:
        numbers[f"{one}s"] = _directions(check, one, meta, shapes, types, direction_maps)
    for name, shape in shapes.items():
        if math.prod(shape[:-1]) * -(-shape[-1] // 4) > MOST_ENTRIES:
            check.refuse(name, shape, f"at most {MOST_ENTRIES} entries", "a map is too large")
    own = {name: shape for name, shape in shapes.items() if name not in direction_maps}
    if not isinstance(kind, HasSchema):
        if not any(shape[:2] == (rows, columns) for shape in own.values()):
            check.refuse(
                "meta.texels", [rows, columns], "rows and columns of a map", "no map has these texels"
            )
        for name, value in meta["constants"].items():
            listed = isinstance(value, str) and _NUMBERS.fullmatch(value) is not None
            if not (isinstance(value, bool | int | float) or listed):
                expected = "a number, or numbers such as int[2](3, 4)"
                check.refuse(f"meta.constants.{name}", repr(value)[:60], expected, "damaged manifest")
        return
    try:
        schema = kind.schema(meta, own.keys())
    except (KeyError, TypeError, ValueError, IndexError) as error:
        if isinstance(error, InputError):
            check.refuse(f"meta.{error.field}", error.got, error.expected, error.message)
        check.refuse("meta", repr(error), f"what {meta['method']} keeps", "damaged manifest")
    numbers |= schema.numbers
    for name in own:
        if name not in schema.maps:
            check.refuse(name, own[name], f"one of {', '.join(schema.maps)}", "a map that the method has not")
    for name, wanted in schema.maps.items():
        if name not in own:
            if wanted.optional:
                continue
            check.refuse(name, "nothing", wanted.axes, "a map is missing")
        if types[name] not in wanted.kinds:
            check.refuse(name, types[name], " or ".join(wanted.kinds), "type of a map")
        if not bound(wanted.axes, own[name], numbers):
            known = ", ".join(f"{key} {n}" for key, n in numbers.items())
            check.refuse(name, own[name], f"({wanted.axes}) with {known}", "shape of a map")
    _constants(check, schema, meta, numbers)


def _directions(
    check: _Check,
    kind: str,
    meta: Facts,
    shapes: Mapping[str, Any],
    types: Mapping[str, str],
    found: set[str],
) -> int:
    """Number of directions that maps hold of one kind; adds the names of its tables to `found`."""
    total = meta[f"{kind}s"]["count"]
    names = {part: f"{kind}_{part}" for part in ("directions", "rings", "triangles", "cells", "slots")}
    found |= set(names.values())
    for part in ("directions", "rings", "triangles", "cells"):
        if names[part] in types and types[names[part]] != "float32":
            check.refuse(names[part], types[names[part]], "float32", "type of a map")
    kept = total
    if names["slots"] in shapes:
        if shapes[names["slots"]] != (total, 1) or types[names["slots"]] != "uint32":
            check.refuse(names["slots"], shapes[names["slots"]], f"uint32 ({total}, 1)", "shape of a map")
        if f"resident_{kind}s" not in meta:
            check.refuse(
                f"meta.resident_{kind}s", "nothing", "the directions that are kept", "damaged manifest"
            )
        kept = len(meta[f"resident_{kind}s"])
        if kept > total:
            check.refuse(f"meta.resident_{kind}s", f"{kept} of them", f"at most {total}", "damaged manifest")
    elif f"resident_{kind}s" in meta:
        check.refuse(names["slots"], "nothing", f"uint32 ({total}, 1)", "a map is missing")
    wanted = kept if kind == "view" else total
    if shapes.get(names["directions"]) != (wanted, 3):
        got = shapes.get(names["directions"], "nothing")
        check.refuse(names["directions"], got, (wanted, 3), "shape of a map")
    rings, triangles = names["rings"] in shapes, names["triangles"] in shapes
    if rings == triangles or (names["cells"] in shapes) != triangles:
        there = ", ".join(name for name in names.values() if name in shapes)
        check.refuse(names["rings"], there, "rings, or triangles and cells", "interpolation of directions")
    if rings:
        shape = shapes[names["rings"]]
        if len(shape) != 2 or shape[1] != 4 or shape[0] > total:
            check.refuse(names["rings"], shape, f"(rings, 4), at most {total} rings", "shape of a map")
        return kept
    shape, cells = shapes[names["triangles"]], shapes[names["cells"]]
    # Euler's formula: a triangulated sphere of n + 1 corners, the nadir among them, has 2 n − 2 triangles.
    if shape != (2 * total - 2, TRIANGLE_FLOATS):
        check.refuse(names["triangles"], shape, (2 * total - 2, TRIANGLE_FLOATS), "shape of a map")
    if len(cells) != 2 or cells[0] != cells[1]:
        check.refuse(names["cells"], cells, "(n, n)", "shape of a map")
    return kept


def _constants(check: _Check, schema: Schema, meta: Facts, numbers: Mapping[str, int]) -> None:
    constants = meta["constants"]
    for name, value in constants.items():
        field = f"meta.constants.{name}"
        if name not in schema.constants:
            check.refuse(
                field,
                value,
                f"one of {', '.join(schema.constants) or 'none'}",
                "a constant that the method has not",
            )
        wanted = schema.constants[name]
        if isinstance(wanted, OneOf):
            # True is 1, and 1.0 is 1: the type counts, since a shader is compiled with it.
            good = any(value == one and type(value) is type(one) for one in wanted.values)
        elif isinstance(wanted, Number):
            good = type(value) is int and value == numbers.get(wanted.name)
        else:
            whole = isinstance(wanted, Range) and wanted.whole
            good = type(value) is int or (type(value) is float and not whole)
            if good and isinstance(wanted, Range):
                good = wanted.least <= value <= wanted.most
        if not good:
            got = value if not isinstance(value, str | list | dict) else repr(value)[:60]
            check.refuse(field, got, wanted, "a constant is out of range")
    for name, wanted in schema.constants.items():
        if name not in constants and name not in schema.optional:
            check.refuse(f"meta.constants.{name}", "nothing", wanted, "a constant is missing")


def check_values(arrays: Mapping[str, np.ndarray], manifest: Facts, kind: object, path: PathLike) -> None:
    """Values of the maps that were read: ranges, indices, tables of directions.

    Parameters
    ----------
    arrays : dict of str to ndarray
        Whole maps or, of those that are read in parts, with zeros in between.
    manifest : dict
        It passed :func:`check_layout`.
    kind : type
        Class of the method's representations.
    path : path-like

    Raises
    ------
    InputError
        With the map, what it holds and what was expected.
    """
    check, meta = _Check(path), manifest["meta"]
    for one in _KINDS:
        if f"{one}_directions" in arrays:
            _check_directions(check, one, arrays, meta)
    schema = kind.schema(meta, manifest["arrays"].keys()) if isinstance(kind, HasSchema) else Schema({})
    for name, array in arrays.items():
        if name.startswith(("view_", "light_")):
            continue
        wanted = schema.maps.get(name, MapSchema("", (*FLOATS, *INDICES), absent=True))
        if wanted.below:
            _check_indices(check, name, array, wanted, manifest["arrays"])
        elif array.dtype.kind == "f":
            if not wanted.absent and meta.get("partial", False) and np.isnan(array).any():
                check.refuse(name, "NaN", "finite values", "a map holds a value that is not finite")
            _check_range(check, name, array, wanted)
    for name, expected in schema.constants.items():
        if isinstance(expected, Edge) and name in meta["constants"]:
            table = arrays.get(f"{expected.kind}_directions")
            if table is None or (f"{expected.kind}_slots" in arrays and expected.kind == "view"):
                continue
            edge = float(table[:, 2].min())
            edge = edge if edge > expected.floor else 0.0
            if meta["constants"][name] != edge:
                got = meta["constants"][name]
                check.refuse(f"meta.constants.{name}", got, f"{edge!r}, {expected}", "a constant is damaged")


def _check_range(check: _Check, name: str, array: np.ndarray, wanted: MapSchema) -> None:
    if array.dtype == np.float16 and wanted.least <= -LARGEST and wanted.most >= LARGEST and not wanted.parts:
        return
    parts = [(slice(first, None, step), allowed) for (first, step), allowed in wanted.parts.items()]
    for part, allowed in parts or [(slice(None), Range(wanted.least, wanted.most))]:
        chosen = array[..., part]
        # As numbers of the map's own type: a half float has no 10¹².
        end = float(np.finfo(array.dtype).max)
        low, high = max(allowed.least, -end), min(allowed.most, end)
        # NaN, where a partial table has it, is neither.
        if (chosen < low).any() or (chosen > high).any():
            got = f"{np.nanmin(chosen):.4g} … {np.nanmax(chosen):.4g}"
            check.refuse(
                name, got, f"{allowed.least:g} … {allowed.most:g}", "a map holds a value out of range"
            )


def _check_indices(
    check: _Check,
    name: str,
    array: np.ndarray,
    wanted: MapSchema,
    entries: Mapping[str, Facts],
) -> None:
    below = wanted.below * array.shape[-1] if len(wanted.below) == 1 else wanted.below
    for channel, book in enumerate(below):
        limit, largest = entries[book]["shape"][0], int(array[..., channel].max())
        if largest >= limit:
            got = f"{largest} in channel {channel}"
            check.refuse(name, got, f"below {limit}, the entries of {book}", "an index is out of range")


def _check_directions(check: _Check, kind: str, arrays: Mapping[str, np.ndarray], meta: Facts) -> None:
    vectors = arrays[f"{kind}_directions"].astype(float)
    total, name = meta[f"{kind}s"]["count"], f"{kind}_directions"
    length = np.sqrt((vectors**2).sum(1))
    bad = (np.abs(length - 1) > DIRECTION_TOLERANCE) | (vectors[:, 2] < -DIRECTION_TOLERANCE)
    if bad.any():
        got = vectors[bad][0].tolist()
        check.refuse(name, got, "unit vectors above the horizon", "a table of directions is damaged")
    places = np.arange(total)
    if f"{kind}_slots" in arrays:
        slots = arrays[f"{kind}_slots"][:, 0].astype(np.int64)
        kept = np.flatnonzero(slots != MISSING)
        if kept.tolist() != meta[f"resident_{kind}s"] or (slots[kept] != np.arange(len(kept))).any():
            got = f"{len(kept)} of {total}"
            check.refuse(
                f"{kind}_slots", got, f"meta.resident_{kind}s in order", "a table of slots is damaged"
            )
        if kind == "view":
            places = kept
    whole = np.full((total, 3), np.nan)
    whole[places] = vectors
    if f"{kind}_rings" in arrays:
        _check_rings(check, f"{kind}_rings", arrays[f"{kind}_rings"].astype(float), whole)
    else:
        _check_triangles(check, f"{kind}_triangles", arrays[f"{kind}_triangles"].astype(float), whole)
        cells = arrays[f"{kind}_cells"].astype(float)
        n = len(arrays[f"{kind}_triangles"])
        if (cells != np.floor(cells)).any() or cells.min() < 0 or cells.max() >= n:
            got = f"{cells.min():g} … {cells.max():g}"
            check.refuse(f"{kind}_cells", got, f"0 … {n - 1}", "a table of directions is damaged")
        _check_cells(check, f"{kind}_cells", cells.astype(int), arrays[f"{kind}_triangles"].astype(float))


def _check_rings(check: _Check, name: str, rings: np.ndarray, vectors: np.ndarray) -> None:
    damaged = "a table of directions is damaged"
    theta, phi, counts, starts = rings.T
    if (counts < 1).any() or (counts != np.floor(counts)).any() or counts.sum() != len(vectors):
        check.refuse(name, counts.tolist(), f"counts of {len(vectors)} directions", damaged)
    if (starts != np.cumsum([0, *counts[:-1]])).any():
        check.refuse(name, starts.tolist(), "ring after ring", damaged)
    # A first ring of one sample is the pole; one of more leaves a cap inside, whose polygon holds the pole.
    pole = counts[0] == 1
    if (theta[0] != 0 or phi[0] != 0) if pole else (theta[0] <= 0 or counts[0] < 3):
        check.refuse(name, [theta[0], counts[0]], "the pole, or a ring of three samples or more", damaged)
    if (np.diff(theta) <= 0).any() or (np.abs(phi) > 7).any():
        check.refuse(name, theta.tolist(), "polar angles that rise", damaged)
    ring = np.repeat(np.arange(len(rings)), counts.astype(int))
    turn = (np.arange(len(vectors)) - starts[ring]) / counts[ring]
    off = np.abs(spherical(theta[ring], phi[ring] + 2 * np.pi * turn) - vectors)
    if np.nanmax(off, initial=0) > DIRECTION_TOLERANCE:
        at = int(np.nanargmax(off.max(1)))
        check.refuse(name, f"direction {at} elsewhere", "rings of the directions", damaged)


def _check_cells(check: _Check, name: str, cells: np.ndarray, table: np.ndarray) -> None:
    """Each cell names the triangle that holds its centre."""
    centre = (np.arange(len(cells)) + 0.5) / len(cells) * 2 - 1
    w = square_to_hemisphere(np.stack(np.meshgrid(centre, centre), -1))
    row = table[cells]
    size = np.abs(row[..., 6:15]).max(-1)
    outside = barycentric(row, w).min(-1) < -DUAL_TOLERANCE * np.maximum(size, 1)
    if outside.any():
        at = np.argwhere(outside)[0].tolist()
        check.refuse(
            name, f"cell {at} elsewhere", "the triangle of its centre", "a table of directions is damaged"
        )


def _check_triangles(check: _Check, name: str, table: np.ndarray, vectors: np.ndarray) -> None:
    damaged = "a table of directions is damaged"
    n, total = len(table), len(vectors)
    corners, across = table[:, 15:18], table[:, 18:21]
    if (table[:, 21:] != 0).any():
        check.refuse(name, "numbers in its padding", 0, damaged)
    for what, found, least, most in (
        ("corners", corners[:, :2], 0, total - 1),
        ("corners", corners[:, 2:], -1, total - 1),
        ("neighbours", across, 0, n - 1),
    ):
        if (found != np.floor(found)).any() or found.min() < least or found.max() > most:
            got = f"{what} {found.min():g} … {found.max():g}"
            check.refuse(name, got, f"whole numbers {least} … {most}", damaged)
    corner, neighbour = corners.astype(int), across.astype(int)
    # The nadir, which has no data, is the corner after the last one.
    named = np.where(corner < 0, total, corner)
    for opposite, (first, second) in enumerate(((1, 2), (0, 2), (0, 1))):
        other = named[neighbour[:, opposite]]
        shared = (other == named[:, first, None]).any(1) & (other == named[:, second, None]).any(1)
        if not shared.all() or (neighbour[:, opposite] == np.arange(n)).any():
            at = int(np.flatnonzero(~shared)[0]) if not shared.all() else 0
            check.refuse(name, f"triangle {at}", "neighbours that share an edge", damaged)
    whole = np.vstack([vectors, [[0, 0, -1.0]]])
    points = [whole[named[:, k]] for k in range(3)]
    for k in range(2):
        off = np.abs(table[:, 3 * k : 3 * k + 3] - points[k])
        if np.nanmax(off, initial=0) > DIRECTION_TOLERANCE:
            check.refuse(name, f"corner {k} elsewhere", "the directions", damaged)
    duals = table[:, 6:15].reshape(n, 3, 3)
    size = np.abs(duals).max((1, 2))
    for i in range(3):
        for k in range(3):
            product = np.einsum("nj,nj->n", duals[:, i], points[k])
            off = np.abs(product - (i == k)) > DUAL_TOLERANCE * np.maximum(size, 1)
            if off.any():
                check.refuse(name, f"triangle {int(np.flatnonzero(off)[0])}", "its dual normals", damaged)
