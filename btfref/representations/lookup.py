"""What every tabulated method shares: stencils of directions and texels, validity, chunking, packing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.numerics.sphere import interpolation
from btfref.precision import real

#: Points evaluated at a time: bounds the memory of the gathered neighbourhoods.
CHUNK = 1 << 14


@dataclass(frozen=True)
class Stencils:
    """Neighbours of N lookups: indices and weights of texels (N, T), views (N, V) and lights (N, L)."""

    texel: np.ndarray
    texel_weight: np.ndarray
    view: np.ndarray
    view_weight: np.ndarray
    light: np.ndarray
    light_weight: np.ndarray

    @property
    def pair_weight(self):
        """Weights of the (view, light) pairs, shape (N, V, L)."""
        return self.view_weight[:, :, None] * self.light_weight[:, None, :]


@dataclass(frozen=True)
class StoredMaps:
    """The part of a representation that does not depend on the method: its maps, its meta, and their way to files.

    A convenience: :class:`btfref.representations.protocol.Representation` asks for the methods, not for this class.
    """

    maps: dict
    meta: dict

    def __repr__(self) -> str:
        from btfref.representations.file.container import payload_bytes

        meta = self.meta
        size = payload_bytes({name: (a.shape, str(a.dtype)) for name, a in self.maps.items()}, meta)
        kind = f"Representation {meta['method']}"
        return conventions.in_one_line(kind, meta["texels"], meta["views"], meta["lights"], size)

    def arrays(self):
        """All maps and the direction tables, as they are stored."""
        return self.maps

    def port_arrays(self):
        """The same with channels padded to four."""
        return packed_arrays(self.maps)

    @classmethod
    def from_arrays(cls, arrays, meta):
        """The representation whose :meth:`arrays` and ``meta`` these are."""
        return cls(arrays, meta)


def evaluate_tabulated(representation, kernel, uv, w_light, w_view):
    """Evaluate a method that interpolates tables over measured directions and texels.

    Parameters
    ----------
    representation : Representation
        Its arrays hold the direction tables, its meta ``texels`` and ``filter_type``.
    kernel : callable
        ``Stencils -> (N, 3)`` float64.
    uv, w_light, w_view : array_like, shape (..., 2), (..., 3), (..., 3)

    Returns
    -------
    ndarray of float64, shape (..., 3)
    """
    arrays, meta = representation.arrays(), representation.meta
    views, lights = interpolation.from_arrays(arrays, "view"), interpolation.from_arrays(arrays, "light")

    def lookup(uv, w_light, w_view):
        texel, texel_weight = conventions.texel_stencil(uv, meta["texels"], meta["filter_type"])
        view, view_weight = views.stencil(w_view)
        light, light_weight = lights.stencil(w_light, hold=False)
        return kernel(Stencils(texel, texel_weight, view, view_weight, light, light_weight))

    return evaluate_points(lookup, uv, w_light, w_view)


def evaluate_points(lookup, uv, w_light, w_view, *scalars):
    """Evaluate point by point: broadcast, leave out what is not valid, bound the memory.

    Parameters
    ----------
    lookup : callable
        ``uv (N, 2), w_light (N, 3), w_view (N, 3), *scalars (N,) -> (N, 3)`` float64, for valid directions.
    uv, w_light, w_view : array_like, shape (..., 2), (..., 3), (..., 3)
    *scalars : array_like, shape (...)
        Further arguments of each lookup, such as a level of detail.

    Returns
    -------
    ndarray of float64, shape (..., 3)
    """
    uv, w_light, w_view = (real(a) for a in (uv, w_light, w_view))
    scalars = [real(a) for a in scalars]
    shape = np.broadcast_shapes(
        uv.shape[:-1], w_light.shape[:-1], w_view.shape[:-1], *(a.shape for a in scalars)
    )
    uv, w_light, w_view = (
        np.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]) for a in (uv, w_light, w_view)
    )
    scalars = [np.broadcast_to(a, shape).reshape(-1) for a in scalars]
    result = None
    for start in range(0, len(uv), CHUNK):
        part = slice(start, start + CHUNK)
        valid = conventions.valid_directions(w_light[part]) & conventions.valid_directions(w_view[part])
        if not valid.any():
            continue
        points = (a[part][valid] for a in (uv, w_light, w_view, *scalars))
        value = lookup(*points)
        if result is None:
            # In the precision that the lookup kept: single, where :func:`computing_in` asks for it.
            result = np.zeros((len(uv), 3), value.dtype)
        result[part][valid] = value
    if result is None:
        result = np.zeros((len(uv), 3), uv.dtype)
    return result.reshape(*shape, 3)


def direction_arrays(views, lights):
    """The direction tables of two sets, as every representation stores them."""
    result = {}
    for prefix, directions in (("view", views), ("light", lights)):
        result[f"{prefix}_directions"] = directions.vectors.astype(np.float32)
        result |= directions.interpolation.arrays(prefix)
    return result


def packed(array):
    """``array`` with its last axis padded by zeros to a multiple of 4."""
    missing = -array.shape[-1] % 4
    if not missing:
        return np.ascontiguousarray(array)
    return np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, missing)])


def packed_arrays(arrays, **tables):
    """Port layout of ``arrays`` with the ``tables`` that are laid out anew in place of their namesakes."""
    return {name: packed(tables.get(name, array)) for name, array in arrays.items()}


def base_meta(method, btf, parameters, *, filter_type="bilinear"):
    """The meta that every fit starts from."""
    return meta_for(
        method,
        btf.values.shape[2:4],
        btf.views,
        btf.lights,
        parameters,
        filter_type=filter_type,
        parent=btf.attributes,
    )


def meta_for(method, texels, views, lights, parameters, *, filter_type="bilinear", parent=None):
    """The same for maps that were not fitted to a sampled BTF: its directions, texels and attributes one by one."""
    from btfref.provenance import versions

    return {
        "method": method,
        "texels": [int(n) for n in texels],
        "views": views.facts,
        "lights": lights.facts,
        "filter_type": filter_type,
        "parameters": parameters,
        "parent": dict(parent or {}),
        "versions": versions(),
        "constants": {},
    }


#: Storage types of float maps by name.
STORAGE = {"half": np.float16, "float": np.float32}


def stored(name, array, storage):
    """``array`` in the type that ``storage`` ("half" or "float") names.

    Raises
    ------
    InputError
        For an unknown name, or a value beyond the type's range: never a silent infinity.
    """
    if storage not in STORAGE:
        raise InputError("unknown storage", field="storage", got=repr(storage), expected=" or ".join(STORAGE))
    limit = float(np.finfo(STORAGE[storage]).max)
    peak = float(np.abs(array).max(initial=0))
    if not peak <= limit:
        raise InputError(
            f"values do not fit {storage} floats",
            field=name,
            got=f"{peak:.4g}",
            expected=f"at most {limit:.4g}",
        )
    return array.astype(STORAGE[storage])


def positive_integer(name, value):
    """``value`` as an int of at least 1.

    Raises
    ------
    InputError
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(
            "a parameter is out of range", field=name, got=repr(value), expected="an integer of at least 1"
        )
    return int(value)
