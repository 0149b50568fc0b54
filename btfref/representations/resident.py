"""Representations of which only some views are kept: the maps of views that a scene cannot see need no memory.

A method says which axis of which map runs over views (``VIEW_AXES`` of its class). The directions stay what they are,
and with them every interpolation weight; a table of slots takes a view to its place in the shortened maps. A lookup
that needs a view which is not there is an error in NumPy and not a number in the ports, never another view's value.
"""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.numerics.interpolation import MISSING

#: Name of the table of slots, uint32 [n_views, 1]; ports find it beside the direction tables.
SLOTS = "view_slots"


def with_views(representation, views):
    """The representation with the maps of ``views`` only.

    Parameters
    ----------
    representation : Representation
        Its class has ``VIEW_AXES``: names of maps and the axis that runs over views.
    views : array_like of int
        Indices of the views to keep, in any order, at least one.

    Returns
    -------
    Representation
        Equal values wherever only these views are interpolated. ``meta["resident_views"]`` lists them.

    Raises
    ------
    InputError
        For a method whose maps do not depend on the view, indices out of range, or a representation that lacks some.
    """
    arrays, meta = representation.arrays(), representation.meta
    arrays, meta = select_views(arrays, meta, axes_of(type(representation), meta["method"]), views)
    return type(representation).from_arrays(arrays, meta)


def axes_of(kind, method, *, file=None):
    """``VIEW_AXES`` of a class of representations.

    Raises
    ------
    InputError
        When it has none.
    """
    axes = getattr(kind, "VIEW_AXES", {})
    if not axes:
        raise InputError("the method keeps no maps by view", file=file, field="views", got=method)
    return axes


def select_views(arrays, meta, axes, views, *, file=None):
    """Arrays and meta with the chosen views; see :func:`with_views`."""
    views = np.unique(np.asarray(views, np.int64))
    total = meta["views"]["count"]
    if not len(views) or views[0] < 0 or views[-1] >= total:
        got = f"{views.min(initial=0)} … {views.max(initial=0)}" if len(views) else "none"
        raise InputError("no such views", file=file, field="views", got=got, expected=f"0 … {total - 1}")
    slots = np.arange(total)
    if SLOTS in arrays:
        slots = arrays[SLOTS][:, 0].astype(np.int64)
        absent = views[slots[views] == MISSING]
        if len(absent):
            raise InputError("a view is not there", file=file, field="views", got=absent[0])
    kept = slots[views]
    table = np.full((total, 1), MISSING, np.uint32)
    table[views, 0] = np.arange(len(views))
    axes = {**axes, "view_directions": 0}
    result = {
        name: np.ascontiguousarray(np.take(array, kept, axes[name])) if name in axes else array
        for name, array in arrays.items()
    }
    return {**result, SLOTS: table}, {**meta, "resident_views": views.tolist()}
