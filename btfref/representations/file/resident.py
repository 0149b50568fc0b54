"""Representations of which only a part is kept: maps that a scene cannot ask for need no memory.

A method says which axis of which map runs over views and over lights
(:class:`~btfref.representations.protocol.KeepsDirections`). The directions stay what they are, and with them every
interpolation weight; a table of slots takes a direction to its place in the shortened maps.

Where texels name entries of codebooks (:class:`~btfref.representations.protocol.HasEntries`), the method says which map
holds the names, which axis of which map runs over the entries, and which map of numbers a lookup of a texel always
reads: of texels whose entry is not kept it becomes NaN. Where maps are those of levels of detail
(:class:`~btfref.representations.protocol.HasLevels`), it says how they are called.

A lookup that needs what is not there is an error in NumPy and not a number in the ports, never another value.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.interpolation import MISSING
from btfref.representations.protocol import HasEntries, HasLevels, Kind, direction_axes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from btfref.representations.protocol import Entries, Representation
    from btfref.types import Facts, PathLike


#: By map the axes along which it was read in part, and how many indices these have in the file.
Taken = Mapping[str, Mapping[int, int]]

#: Kinds of directions.
KINDS: tuple[Kind, ...] = ("view", "light")


def slots_name(kind: Kind) -> str:
    """Name of the table of slots, uint32 [n, 1]; ports find it beside the direction tables."""
    return f"{kind}_slots"


#: That of the views.
SLOTS = slots_name("view")


def with_views(representation: Representation, views: ArrayLike) -> Representation:
    """The representation with the maps of ``views`` only; see :func:`keeping`."""
    return keeping(representation, views=views)


def keeping(
    representation: Representation,
    *,
    views: ArrayLike | None = None,
    lights: ArrayLike | None = None,
    entries: ArrayLike | None = None,
    levels: ArrayLike | None = None,
) -> Representation:
    """The representation with the maps of some views, lights, entries and levels only.

    Parameters
    ----------
    representation : Representation
        It keeps its maps by the directions for ``views`` and ``lights``, has entries for ``entries``, and levels for
        ``levels``; see :mod:`btfref.representations.protocol`.
    views, lights, entries : array_like of int, optional
        Indices of those to keep, in any order, at least one; None for all.
    levels : array_like of int, optional
        Likewise; the coarsest one and those next to it, since a lookup needs all from its own on.

    Returns
    -------
    Representation
        Equal values wherever only these are read. ``meta["resident_views"]`` and so on list them.

    Raises
    ------
    InputError
        For a method whose maps do not depend on the direction, indices out of range, or a representation that lacks
        some.
    """
    made = type(representation)
    arrays, meta = select(
        representation.arrays(),
        representation.meta,
        made,
        views=views,
        lights=lights,
        entries=entries,
        levels=levels,
    )
    return made.from_arrays(arrays, meta)


def select(
    arrays: dict[str, np.ndarray],
    meta: Facts,
    made: object,
    *,
    views: ArrayLike | None = None,
    lights: ArrayLike | None = None,
    entries: ArrayLike | None = None,
    levels: ArrayLike | None = None,
    taken: Taken | None = None,
    file: PathLike | None = None,
) -> tuple[dict[str, np.ndarray], Facts]:
    """Arrays and meta of class ``made`` with what was chosen; see :func:`keeping`.

    Along the axes in ``taken`` a map was read in part: it has what was chosen and no more already.
    """
    taken = taken or {}
    if entries is not None:
        arrays, meta = _with_entries(arrays, meta, made, entries, taken, file)
    if levels is not None:
        arrays, meta = _with_levels(arrays, meta, made, levels, file)
    for kind, chosen in zip(KINDS, (views, lights), strict=True):
        if chosen is not None:
            if meta.get("constants", {}).get("nearest_directions"):
                # The heaviest neighbour would be chosen among those that are there, and not be missed.
                raise InputError(
                    "directions are not interpolated", file=file, field=f"{kind}s", got=meta["method"]
                )
            axes = axes_of(made, meta["method"], kind, file=file)
            arrays, meta = _selected(arrays, meta, axes, kind, chosen, taken, file)
    return arrays, meta


def axes_of(
    made: object, method: str, kind: Kind = "view", *, file: PathLike | None = None
) -> Mapping[str, int]:
    """Maps of a class of representations that have an axis over views or lights, and that axis.

    Raises
    ------
    InputError
        When it has none.
    """
    axes = direction_axes(made, kind)
    if not axes:
        raise InputError(f"the method keeps no maps by {kind}", file=file, field=f"{kind}s", got=method)
    return axes


def _with_entries(
    arrays: dict[str, np.ndarray],
    meta: Facts,
    made: object,
    entries: ArrayLike,
    taken: Taken,
    file: PathLike | None,
) -> tuple[dict[str, np.ndarray], Facts]:
    names = entries_of(made, meta["method"], file=file)
    if "resident_entries" in meta:
        raise InputError("entries are chosen already", file=file, field="entries", got=meta["method"])
    first, axis = next(iter(names.axes.items()))
    total = taken.get(first, {}).get(axis, arrays[first].shape[axis])
    kept = _checked("entries", entries, total, file)
    slots = slots_of(total, kept)
    place = slots[:, 0][arrays[names.index]]
    lost = place == MISSING
    mark = np.where(lost, np.array(np.nan, arrays[names.mark].dtype), arrays[names.mark])
    result = {**arrays, names.index: np.where(lost, np.uint32(0), place), names.mark: mark}
    for name, axis in names.axes.items():
        if axis not in taken.get(name, ()):
            result[name] = np.ascontiguousarray(np.take(arrays[name], kept, axis))
    return result, {**meta, "resident_entries": kept.tolist(), "partial": bool(lost.any())}


def _with_levels(
    arrays: dict[str, np.ndarray], meta: Facts, made: object, levels: ArrayLike, file: PathLike | None
) -> tuple[dict[str, np.ndarray], Facts]:
    patterns = levels_of(made, meta["method"], file=file)
    total = len(meta["levels"])
    kept = _checked("levels", levels, total, file)
    if kept[-1] != total - 1 or len(kept) != total - kept[0]:
        raise InputError(
            "levels of detail are needed from one on",
            file=file,
            field="levels",
            got=", ".join(map(str, kept)),
            expected=f"all up to {total - 1}",
        )
    first = int(kept[0])
    if first < meta["constants"].get("first_level", 0):
        raise InputError("a level is not there", file=file, field="levels", got=first)
    gone = {pattern.replace("*", str(k)) for pattern in patterns for k in range(first)}
    result = {name: array for name, array in arrays.items() if name not in gone}
    constants = meta["constants"] | {"first_level": first}
    return result, {**meta, "constants": constants, "resident_levels": kept.tolist()}


def entries_of(made: object, method: str, *, file: PathLike | None = None) -> Entries:
    """How texels name entries in a class of representations.

    Raises
    ------
    InputError
        When it has none.
    """
    if not isinstance(made, HasEntries):
        raise InputError("the method has no entries that texels name", file=file, field="entries", got=method)
    return made.ENTRIES


def levels_of(made: object, method: str, *, file: PathLike | None = None) -> Sequence[str]:
    """Names of the maps of a level of detail in a class of representations.

    Raises
    ------
    InputError
        When it has none.
    """
    if not isinstance(made, HasLevels):
        raise InputError("the method has no levels of detail", file=file, field="levels", got=method)
    return made.LEVELS


def needed_rows(
    made: object, manifest: Facts, choice: Mapping[str, ArrayLike | None]
) -> dict[str, dict[int, np.ndarray]]:
    """Which maps of a file a choice needs, and of which indices along the axes that are rows there.

    Parameters
    ----------
    made : type
        Class of the representation.
    manifest : dict
        Of the file: ``meta`` and ``arrays`` with the shapes.
    choice : dict
        As for :func:`keeping`.

    Returns
    -------
    dict of str to dict of int to array
        By map the indices of each axis that has some alone; a map that is not there is not needed.
    """
    meta: Facts = manifest["meta"]
    result = {}
    chosen = {kind: choice.get(f"{kind}s") for kind in KINDS}
    gone = set()
    wanted, entries = choice.get("levels"), choice.get("entries")
    if wanted is not None and np.size(wanted):
        levels = range(int(np.min(wanted)))
        gone = {p.replace("*", str(k)) for p in levels_of(made, meta["method"]) for k in levels}
    for name in manifest["arrays"]:
        if name in gone:
            continue
        axes = {}
        for kind, indices in chosen.items():
            # Of a file that holds some directions alone, indices are not places.
            if indices is None or slots_name(kind) in manifest["arrays"]:
                continue
            for pattern, axis in direction_axes(made, kind).items():
                if fnmatchcase(name, pattern):
                    axes[axis] = np.asarray(indices, np.int64)
        if entries is not None:
            own = entries_of(made, meta["method"]).axes.get(name)
            if own is not None:
                axes[own] = np.asarray(entries, np.int64)
        result[name] = axes
    return result


def slots_of(total: int, kept: np.ndarray) -> np.ndarray:
    """Table that takes each of ``total`` directions to its place among the sorted ``kept`` ones."""
    table = np.full((total, 1), MISSING, np.uint32)
    table[kept, 0] = np.arange(len(kept))
    return table


def _selected(
    arrays: dict[str, np.ndarray],
    meta: Facts,
    axes: Mapping[str, int],
    kind: Kind,
    chosen: ArrayLike,
    taken: Taken,
    file: PathLike | None,
) -> tuple[dict[str, np.ndarray], Facts]:
    field, total = f"{kind}s", meta[f"{kind}s"]["count"]
    chosen = _checked(field, chosen, total, file)
    slots = np.arange(total)
    if slots_name(kind) in arrays:
        slots = arrays[slots_name(kind)][:, 0].astype(np.int64)
        absent = chosen[slots[chosen] == MISSING]
        if len(absent):
            raise InputError(f"a {kind} is not there", file=file, field=field, got=absent[0])
    kept = slots[chosen]
    if kind == "view":
        # Those of the lights stay: ports look up the outermost one there.
        axes = {**axes, "view_directions": 0}
    result = {}
    for name, array in arrays.items():
        axis = next((a for pattern, a in axes.items() if fnmatchcase(name, pattern)), None)
        there = axis is None or axis in taken.get(name, ())
        result[name] = array if there else np.ascontiguousarray(np.take(array, kept, axis))
    result[slots_name(kind)] = slots_of(total, chosen)
    return result, {**meta, f"resident_{field}": chosen.tolist()}


def _checked(field: str, chosen: ArrayLike, total: int, file: PathLike | None) -> np.ndarray:
    """Sorted indices, at least one, all below ``total``."""
    chosen = np.unique(np.asarray(chosen, np.int64))
    if not len(chosen) or chosen[0] < 0 or chosen[-1] >= total:
        got = f"{chosen.min(initial=0)} … {chosen.max(initial=0)}" if len(chosen) else "none"
        raise InputError(f"no such {field}", file=file, field=field, got=got, expected=f"0 … {total - 1}")
    return chosen


def refuse_absent(values: np.ndarray, weight: np.ndarray, field: str) -> np.ndarray:
    """``values`` with 0 where the weight is 0; NaN elsewhere marks texels whose entry is not kept.

    Parameters
    ----------
    values : ndarray, shape (..., k)
    weight : ndarray, shape (...)
    field : str
        For the message.

    Raises
    ------
    InputError
        When a lookup needs one of them.
    """
    values = np.where((weight > 0)[..., None], values, 0)
    if np.isnan(values).any():
        raise InputError(f"a lookup needs {field} that are not resident", field=field)
    return values
