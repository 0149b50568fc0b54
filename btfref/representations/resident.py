"""Representations of which only some views or lights are kept: maps that a scene cannot ask for need no memory.

A method says which axis of which map runs over views and over lights (``VIEW_AXES`` and ``LIGHT_AXES`` of its class;
``*`` stands for any text). The directions stay what they are, and with them every interpolation weight; a table of
slots takes a direction to its place in the shortened maps. A lookup that needs one which is not there is an error in
NumPy and not a number in the ports, never another direction's value.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

import numpy as np

from btfref.errors import InputError
from btfref.numerics.interpolation import MISSING

#: Kinds of directions: what their maps' axes are called in a class, and in the meta of a selection.
KINDS = {"view": "VIEW_AXES", "light": "LIGHT_AXES"}


def slots_name(kind):
    """Name of the table of slots, uint32 [n, 1]; ports find it beside the direction tables."""
    return f"{kind}_slots"


#: That of the views.
SLOTS = slots_name("view")


def with_views(representation, views):
    """The representation with the maps of ``views`` only; see :func:`keeping`."""
    return keeping(representation, views=views)


def keeping(representation, *, views=None, lights=None):
    """The representation with the maps of some views and lights only.

    Parameters
    ----------
    representation : Representation
        Its class has ``VIEW_AXES`` (for ``views``) and ``LIGHT_AXES`` (for ``lights``): names of maps and the axis that
        runs over these directions.
    views, lights : array_like of int, optional
        Indices of those to keep, in any order, at least one; None for all.

    Returns
    -------
    Representation
        Equal values wherever only these are interpolated. ``meta["resident_views"]`` and ``meta["resident_lights"]``
        list them.

    Raises
    ------
    InputError
        For a method whose maps do not depend on the direction, indices out of range, or a representation that lacks
        some.
    """
    made = type(representation)
    arrays, meta = select(representation.arrays(), representation.meta, made, views=views, lights=lights)
    return made.from_arrays(arrays, meta)


def select(arrays, meta, made, *, views=None, lights=None, file=None):
    """Arrays and meta of class ``made`` with the chosen directions; see :func:`keeping`."""
    for kind, chosen in (("view", views), ("light", lights)):
        if chosen is not None:
            if meta.get("constants", {}).get("nearest_directions"):
                # The heaviest neighbour would be chosen among those that are there, and not be missed.
                raise InputError(
                    "directions are not interpolated", file=file, field=f"{kind}s", got=meta["method"]
                )
            axes = axes_of(made, meta["method"], kind, file=file)
            arrays, meta = _selected(arrays, meta, axes, kind, chosen, file)
    return arrays, meta


def axes_of(made, method, kind="view", *, file=None):
    """``VIEW_AXES`` or ``LIGHT_AXES`` of a class of representations.

    Raises
    ------
    InputError
        When it has none.
    """
    axes = getattr(made, KINDS[kind], {})
    if not axes:
        raise InputError(f"the method keeps no maps by {kind}", file=file, field=f"{kind}s", got=method)
    return axes


def slots_of(total, kept):
    """Table that takes each of ``total`` directions to its place among the sorted ``kept`` ones."""
    table = np.full((total, 1), MISSING, np.uint32)
    table[kept, 0] = np.arange(len(kept))
    return table


def _selected(arrays, meta, axes, kind, chosen, file):
    chosen = np.unique(np.asarray(chosen, np.int64))
    field, total = f"{kind}s", meta[f"{kind}s"]["count"]
    if not len(chosen) or chosen[0] < 0 or chosen[-1] >= total:
        got = f"{chosen.min(initial=0)} … {chosen.max(initial=0)}" if len(chosen) else "none"
        raise InputError(f"no such {field}", file=file, field=field, got=got, expected=f"0 … {total - 1}")
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
        result[name] = array if axis is None else np.ascontiguousarray(np.take(array, kept, axis))
    result[slots_name(kind)] = slots_of(total, chosen)
    return result, {**meta, f"resident_{field}": chosen.tolist()}
