"""Whether a store that is there already belongs to the settings at hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError
from btfref.sampling.store.layout import remove_store
from btfref.sampling.store.store import open_store

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts


def resumable(
    out: Path, views: DirectionSet, lights: DirectionSet, attributes: Facts, overwrite: bool
) -> BTFStore | None:
    """The store at ``out`` when it has these directions and attributes.

    Parameters
    ----------
    out : Path
        Exists.
    views, lights : DirectionSet
    attributes : dict
        What the store must have been made with; "versions" counts only while it is incomplete, and of it only
        what the store says: earlier versions recorded less.
    overwrite : bool
        Remove a store of other settings, or a damaged one.

    Returns
    -------
    BTFStore or None
        None when it was removed.

    Raises
    ------
    InputError
        Another store, or none, and `overwrite` is False.
    """
    try:
        store = open_store(out)
        found = {
            "views": store.views.vectors.tolist(),
            "lights": store.lights.vectors.tolist(),
            **store.attributes,
        }
    except InputError:
        if not overwrite:
            raise
        remove_store(out)
        return None
    wanted = {"views": views.vectors.tolist(), "lights": lights.vectors.tolist(), **attributes}
    if store.complete:
        # A finished result stays what it is when a library is updated; a half-done one must not be mixed.
        wanted.pop("versions")
    else:
        said = found.get("versions", {})
        wanted["versions"] = {name: wanted["versions"].get(name) for name in said}
    for key, value in wanted.items():
        if found.get(key) == value:
            continue
        if overwrite:
            remove_store(out)
            return None
        field, got, expected = _difference(key, found.get(key), value)
        raise InputError(
            "store of other settings; choose another name or overwrite it",
            file=out,
            field=field,
            got=got,
            expected=expected,
        )
    return store


def _difference(key: str, found: Any, wanted: Any) -> tuple[str, Any, Any]:
    """The first entry in which two settings differ."""
    while isinstance(found, dict) and isinstance(wanted, dict):
        inner = next(name for name in {**wanted, **found} if found.get(name) != wanted.get(name))
        key, found, wanted = f"{key}.{inner}", found.get(inner), wanted.get(inner)
    if isinstance(wanted, list) and len(wanted) > 8:
        return key, "other directions", f"{len(wanted)} directions as asked for"
    return key, found, wanted
