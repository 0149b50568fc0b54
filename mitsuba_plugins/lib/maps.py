"""The maps of a representation on the device: as they are stored, and as they are optimised."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_plugins.lib.lookup import direction_table
from mitsuba_plugins.lib.tables import tensor

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray


class Maps:
    """The maps of a representation on the device, and the shared tables of an evaluator.

    Attributes
    ----------
    tensors : dict of str to TensorXf, TensorXf16 or TensorXu
        What evaluators read, in port layout (last axis a multiple of 4). A map of halves is one of floats once it has
        been changed.
    changed : set of str
        Maps that are no longer those of the representation.
    views, lights : RingTable or TriangleTable
    shape : tuple of int
        Rows and columns of texels.
    filter_type : str
    meta : dict
    """

    def __init__(self, representation: Representation, filter_type: str) -> None:
        arrays = representation.port_arrays()
        self.meta = representation.meta
        self.shape = tuple(self.meta["texels"])
        self.filter_type = filter_type
        self.views, self.lights = direction_table(arrays, "view"), direction_table(arrays, "light")
        self.tensors = {
            name: tensor(array) for name, array in arrays.items() if not name.startswith(("view_", "light_"))
        }
        self.changed: set[str] = set()
        self._masters: dict[str, JitArray] = {}
        self._pristine: dict[str, int] = {}

    def masters(self, fixed: Collection[str] = ()) -> dict[str, JitArray]:
        """The maps that can be optimised, as float32: halves would lose small steps, and gradients.

        The copies are not made before somebody computes with them.

        Parameters
        ----------
        fixed : collection of str
            Maps whose values the evaluator does not differentiate by.

        Returns
        -------
        dict of str to TensorXf
            The same objects at each call: whoever changes one changes the map, by :meth:`take_over`.
        """
        for name, values in self.tensors.items():
            if name not in self._masters and name not in fixed and dr.is_float_v(values.array):
                half = dr.type_v(values.array) == dr.VarType.Float16
                master = mi.TensorXf(mi.Float(values.array), values.shape) if half else values
                self._masters[name], self._pristine[name] = master, master.array.index
        return self._masters

    def take_over(self, keys: Collection[str] = ()) -> bool:
        """Read changed masters from now on.

        Parameters
        ----------
        keys : collection of str
            Names of what was changed; empty: anything may have been.

        Returns
        -------
        bool
            Whether a map was changed.
        """
        found = False
        for name, master in self._masters.items():
            moved = master.array.index != self._pristine[name] or dr.grad_enabled(master)
            if name in keys or (not keys and moved):
                self.tensors[name], found = master, True
                self.changed.add(name)
        return found

    def put_into(self, representation: Representation) -> Representation:
        """A representation, which must be that of these maps, with the changed ones, rounded to its types.

        Raises
        ------
        InputError
            For a changed map that is computed from others, or a value that its type does not hold.
        """
        from btfref.representations.ported import restored

        changed = {name: dr.detach(self._masters[name]).numpy() for name in sorted(self.changed)}
        return restored(representation, changed)
