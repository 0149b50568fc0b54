"""The maps of a representation as variables: steps relative to their size, and the ranges that they keep.

Ranges are those that files are checked by (`btfref.representations.file.schema`), narrowed by what the start shows: a
group of values without a negative one keeps none (diffuse albedos, peaks, chroma), and exponents stay between 1 and the
largest of the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.registry import method
from btfref.representations.file.schema import MapSchema
from btfref.representations.ported import Layout, layout, restored
from btfref.representations.protocol import HasExponents, HasSchema

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray

#: Axes of maps over which the size of values is the same: the others tell groups apart.
_WITHIN = ("rows", "columns", "views", "lights", "side")

#: Least exponent of a lobe: below, its slope is infinite where it ends.
LEAST_EXPONENT = 1.0


class Variables:
    """Port arrays of a representation, each ``start + size · z`` with a variable z that begins at 0.

    Parameters
    ----------
    representation : Representation
    maps : sequence of str, optional
        Port arrays to move; default: all that the method differentiates by and that can be stored.
    material : mitsuba.BSDF, optional
        Of the plugin ``btf``, whose maps are moved; default: an evaluator of its own.

    Attributes
    ----------
    names : tuple of str
    start : Representation
    evaluator : mitsuba_plugins.protocol.Evaluator
        Reads the maps that `put` has set.

    Raises
    ------
    InputError
        For a map that cannot be moved, or a method without any.
    """

    def __init__(
        self, representation: Representation, maps: list[str] | None = None, material: JitArray = None
    ) -> None:
        import mitsuba_plugins

        mi = mitsuba_plugins.ready()
        from mitsuba_plugins.lib.maps import Maps
        from mitsuba_plugins.protocol import HoldsFixed

        self.start = representation
        if material is None:
            self._maps = Maps(representation, representation.meta["filter_type"])
            self.evaluator = method(representation.meta["method"]).evaluator(self._maps)
        else:
            self._maps, self.evaluator = material.maps, material.evaluator
        fixed = self.evaluator.fixed if isinstance(self.evaluator, HoldsFixed) else ()
        found = layout(representation)
        known = [name for name in self._maps.masters(fixed) if name in found.numbers]
        if unknown := [name for name in maps or known if name not in known]:
            raise InputError(
                "a map that cannot be refined", field="maps", got=unknown[0], expected=", ".join(known)
            )
        if not known:
            raise InputError(
                "the method has no map that can be refined", field="method", got=representation.meta["method"]
            )
        self.names = tuple(maps or known)
        # Computed from the others, and read beside them.
        ports = representation.port_arrays()
        self._derived = tuple(
            n for n in self._maps.masters(fixed) if ports[n].dtype.kind == "f" and n not in known
        )
        sizes, low, high = _ranges(representation, found)
        self._start: dict[str, JitArray] = {}
        self._size: dict[str, JitArray] = {}
        self._bounds: dict[str, tuple[JitArray, JitArray]] = {}
        for name in self.names:
            start = ports[name].astype(np.float64).ravel()
            size = found.ported(sizes, name, 1.0).ravel()
            self._start[name], self._size[name] = (to_device(mi.Float, a) for a in (start, size))
            ends = ((found.ported(a, name).ravel() - start) / size for a in (low, high))
            first, last = (np.clip(a, -1e30, 1e30) for a in ends)
            # Rounding must not push the start out.
            bounds = np.minimum(first, 0), np.maximum(last, 0)
            self._bounds[name] = to_device(mi.Float, bounds[0]), to_device(mi.Float, bounds[1])

    def zeros(self) -> dict[str, JitArray]:
        """Variables of the start."""
        import drjit as dr

        return {name: dr.zeros(type(start), len(start)) for name, start in self._start.items()}

    def held(self, variables: Mapping[str, JitArray]) -> dict[str, JitArray]:
        """Variables within their ranges."""
        import drjit as dr

        return {name: dr.clip(dr.detach(z), *self._bounds[name]) for name, z in variables.items()}

    def put(self, variables: Mapping[str, JitArray]) -> None:
        """Let the evaluator read the maps of some variables; gradients pass."""
        import drjit as dr

        self._put({n: dr.fma(z, self._size[n], self._start[n]) for n, z in variables.items()})

    def put_maps(self, representation: Representation) -> None:
        """Let the evaluator read those of a representation that was made of these."""
        import mitsuba as mi

        ports = representation.port_arrays()
        names = (*self.names, *self._derived)
        self._put({name: to_device(mi.Float, ports[name].astype(np.float32)) for name in names})

    def _put(self, values: Mapping[str, JitArray]) -> None:
        import mitsuba as mi

        for name, array in values.items():
            self._maps.tensors[name] = mi.TensorXf(array, self._maps.tensors[name].shape)
        self.evaluator.update(self._maps)

    @property
    def tensors(self) -> dict[str, JitArray]:
        """The maps as they were put."""
        return {name: self._maps.tensors[name] for name in self.names}

    def representation(self, variables: Mapping[str, JitArray], share: float = 1.0) -> Representation:
        """The representation of some variables, or of a share of the way to them, rounded to its types."""
        changed = {
            name: self._start[name].numpy().astype(float)
            + share * self._size[name].numpy().astype(float) * z.numpy()
            for name, z in variables.items()
        }
        return restored(self.start, changed)


def _ranges(
    representation: Representation, found: Layout
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Size, lower and upper ends of each value of each map."""
    sizes, low, high = {}, {}, {}
    arrays = representation.arrays()
    schemas = dict(_schemas(representation))
    exponents = representation.EXPONENTS if isinstance(representation, HasExponents) else {}
    for name in found.names:
        values, schema = arrays[name].astype(np.float64), schemas.get(name, MapSchema(""))
        axes = _within(schema, values.ndim)
        rms = np.sqrt((values**2).mean(axes, keepdims=True))
        sizes[name] = np.broadcast_to(np.maximum(rms, 1e-3 * max(rms.max(), 1e-30)), values.shape).copy()
        positive = values.min(axes, keepdims=True) >= 0
        limit = 65504.0 if arrays[name].dtype == np.float16 else 1e12
        low[name] = np.where(np.broadcast_to(positive, values.shape), 0, -limit)
        low[name] = np.maximum(low[name], schema.least)
        high[name] = np.full(values.shape, min(schema.most, limit))
        for (first, step), part in schema.parts.items():
            some = (..., slice(first, None, step))
            low[name][some] = np.maximum(low[name][some], part.least)
            high[name][some] = np.minimum(high[name][some], part.most)
        if name in exponents:
            first, step = exponents[name]
            some = (..., slice(first, None, step))
            sizes[name][some] = np.maximum(values[some], LEAST_EXPONENT)
            low[name][some] = np.minimum(LEAST_EXPONENT, values[some])
            high[name][some] = values[some].max(initial=LEAST_EXPONENT)
    return sizes, low, high


def _within(schema: MapSchema, n: int) -> tuple[int, ...]:
    """Axes over which values are alike; without a description all but the last."""
    axes = schema.axes.split()
    if len(axes) != n:
        return tuple(range(n - 1))
    return tuple(i for i, axis in enumerate(axes) if axis in _WITHIN)


def _schemas(representation: Representation) -> Iterator[tuple[str, MapSchema]]:
    if isinstance(representation, HasSchema):
        yield from representation.schema(representation.meta, list(representation.arrays())).maps.items()
