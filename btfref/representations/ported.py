"""Where the numbers of the ports' arrays stand in the maps of a representation: the way back of changed ones.

Ports read other layouts than files hold. A layout is found by asking the method itself: its maps are numbered, and
`port_arrays` says where each number went. Arrays that are computed from maps, and not only laid out anew, have no way
back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.representations.lookup import STORAGE

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation

#: Names of tables of directions begin with these.
DIRECTIONS = ("view_", "light_")

#: A number that went through arithmetic is none any more: this far from a whole one.
_WHOLE = 1e-3


@dataclass(frozen=True)
class Layout:
    """Places of the maps in the ports' arrays.

    Attributes
    ----------
    names : tuple of str
        Maps of floats, in the order of their numbers.
    first : dict of str to int
        Number of each map's first value.
    numbers : dict of str to ndarray of int64
        For each array of the ports that is laid out anew: the number of the value at each place, −1 for padding.
    """

    names: tuple[str, ...]
    first: dict[str, int]
    numbers: dict[str, np.ndarray]

    def ported(self, values: Mapping[str, np.ndarray], name: str, fill: float = 0.0) -> np.ndarray:
        """Values of the maps (of the maps' shapes) as they stand in the array ``name``, float64."""
        flat = np.concatenate([np.asarray(values[m], float).ravel() for m in self.names])
        number = self.numbers[name]
        return np.where(number < 0, fill, flat[np.maximum(number, 0)])


def layout(representation: Representation) -> Layout:
    """The layout of a representation's port arrays."""
    arrays, ports = representation.arrays(), representation.port_arrays()
    names = tuple(
        name for name, a in arrays.items() if a.dtype.kind == "f" and not name.startswith(DIRECTIONS)
    )
    first = dict(zip(names, np.cumsum([0, *(arrays[name].size for name in names)]).tolist(), strict=False))
    total = sum(arrays[name].size for name in names)
    # In (0, 1), which is in the range of all maps.
    numbered = {
        name: ((first[name] + 1.0 + np.arange(arrays[name].size)) / (total + 1)).reshape(arrays[name].shape)
        for name in names
    }
    made = type(representation).from_arrays({**arrays, **numbered}, representation.meta).port_arrays()
    flat = np.concatenate([arrays[name].ravel().astype(float) for name in names] or [np.zeros(0)])
    numbers = {}
    for name, array in ports.items():
        if array.dtype.kind != "f" or name.startswith(DIRECTIONS):
            continue
        place = np.asarray(made[name], float) * (total + 1)
        number = np.rint(place).astype(np.int64) - 1
        whole = (np.abs(place - np.rint(place)) < _WHOLE) & (number < total)
        found = np.where(number < 0, 0, flat[np.clip(number, 0, max(total - 1, 0))]) if total else place
        if whole.all() and np.array_equal(found, array.astype(float), equal_nan=True):
            numbers[name] = number
    return Layout(names, first, numbers)


def restored(representation: Representation, changed: Mapping[str, np.ndarray]) -> Representation:
    """A representation with changed port arrays, rounded to the types of its maps.

    Parameters
    ----------
    representation : Representation
    changed : dict of str to ndarray
        Arrays of the ports.

    Returns
    -------
    Representation

    Raises
    ------
    InputError
        For an array that the method computes from its maps, or a value beyond the range of a map's type.
    """
    if not changed:
        return representation
    found = layout(representation)
    arrays = dict(representation.arrays())
    flat = {name: arrays[name].astype(np.float64).ravel() for name in found.names}
    touched = set()
    for name, values in changed.items():
        if name not in found.numbers:
            raise InputError(
                "a map that is computed from others, and cannot be stored",
                field=name,
                expected=f"one of {', '.join(found.numbers)}",
            )
        number, values = found.numbers[name].ravel(), np.asarray(values, np.float64).ravel()
        for own, start in found.first.items():
            here = (number >= start) & (number < start + flat[own].size)
            if here.any():
                flat[own][number[here] - start] = values[here]
                touched.add(own)
    for name in touched:
        arrays[name] = _rounded(name, flat[name].reshape(arrays[name].shape), arrays[name].dtype)
    return type(representation).from_arrays(arrays, representation.meta)


def _rounded(name: str, values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    from btfref.representations.lookup import stored

    if not np.isfinite(values).all():
        raise InputError("a map holds a value that is not finite", field=name)
    return stored(name, values, next(key for key, kind in STORAGE.items() if kind == dtype))
