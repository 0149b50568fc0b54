"""What every tabulated method shares: stencils of directions and texels, validity, chunking, packing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.numerics.sphere import interpolation
from btfref.precision import real

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Self

    from numpy.typing import ArrayLike

    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.protocol import Representation
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts


#: Points evaluated at a time: bounds the memory of the gathered neighbourhoods.
CHUNK = 1 << 14

#: Pairs of directions in the stencils of a lookup, at most.
PAIRS = 16

#: Values that lookups gather at a time from tables with many entries: 8 MiB in float64. Larger ones are no faster, but
#: slower: their memory is new each time, and out of the cache.
GATHERED = 1 << 20


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
    def pair_weight(self) -> np.ndarray:
        """Weights of the (view, light) pairs, shape (N, V, L)."""
        return self.view_weight[:, :, None] * self.light_weight[:, None, :]


@dataclass(frozen=True)
class StoredMaps:
    """The part of a representation that does not depend on the method: its maps, its meta, and their way to files.

    A convenience: :class:`btfref.representations.protocol.Representation` asks for the methods, not for this class.
    """

    maps: dict[str, np.ndarray]
    meta: Facts

    def __repr__(self) -> str:
        from btfref.representations.file.container import payload_bytes

        meta = self.meta
        size = payload_bytes({name: (a.shape, str(a.dtype)) for name, a in self.maps.items()}, meta)
        kind = f"Representation {meta['method']}"
        return conventions.in_one_line(kind, meta["texels"], meta["views"], meta["lights"], size)

    def arrays(self) -> dict[str, np.ndarray]:
        """All maps and the direction tables, as they are stored."""
        return self.maps

    def port_arrays(self) -> dict[str, np.ndarray]:
        """The same with channels padded to four."""
        return packed_arrays(self.maps)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], meta: Facts) -> Self:
        """The representation whose :meth:`arrays` and ``meta`` these are."""
        return cls(arrays, meta)


def evaluate_tabulated(
    representation: Representation,
    kernel: Callable[[Stencils], np.ndarray],
    uv: ArrayLike,
    w_light: ArrayLike,
    w_view: ArrayLike,
    *,
    draw: ArrayLike | None = None,
    gathered: int = 1,
) -> np.ndarray:
    """Evaluate a method that interpolates tables over measured directions and texels.

    Parameters
    ----------
    representation : Representation
        Its arrays hold the direction tables, its meta ``texels`` and ``filter_type``.
    kernel : callable
        ``Stencils -> (N, 3)`` float64.
    uv, w_light, w_view : array_like, shape (..., 2), (..., 3), (..., 3)
    draw : array_like, shape (...), optional
        See :meth:`btfref.representations.protocol.DrawsViews.evaluate`.
    gathered : int
        Values that the kernel gathers for a lookup: with many, fewer are done at a time.

    Returns
    -------
    ndarray of float64, shape (..., 3)
    """
    arrays, meta = representation.arrays(), representation.meta
    views, lights = interpolation.from_arrays(arrays, "view"), interpolation.from_arrays(arrays, "light")

    def lookup(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *draws: np.ndarray) -> np.ndarray:
        texel, texel_weight = conventions.texel_stencil(uv, meta["texels"], meta["filter_type"])
        view, view_weight = views.stencil(w_view, draw=draws[0] if draws else None)
        light, light_weight = lights.stencil(w_light, hold=False)
        return kernel(Stencils(texel, texel_weight, view, view_weight, light, light_weight))

    return evaluate_points(lookup, uv, w_light, w_view, *given(draw), gathered=gathered)


def given(draw: ArrayLike | None) -> tuple[ArrayLike, ...]:
    """A draw as a further argument of each lookup of :func:`evaluate_points`; nothing where there is none."""
    return () if draw is None else (draw,)


def evaluate_points(
    lookup: Callable[..., np.ndarray],
    uv: ArrayLike,
    w_light: ArrayLike,
    w_view: ArrayLike,
    *scalars: ArrayLike,
    gathered: int = 1,
) -> np.ndarray:
    """Evaluate point by point: broadcast, leave out what is not valid, bound the memory.

    Parameters
    ----------
    lookup : callable
        ``uv (N, 2), w_light (N, 3), w_view (N, 3), *scalars (N,) -> (N, 3)`` float64, for valid directions.
    uv, w_light, w_view : array_like, shape (..., 2), (..., 3), (..., 3)
    *scalars : array_like, shape (...)
        Further arguments of each lookup, such as a level of detail.
    gathered : int
        Values that ``lookup`` gathers for a point: with many, fewer points are done at a time.

    Returns
    -------
    ndarray of float64, shape (..., 3)
    """
    vectors, numbers = [real(a) for a in (uv, w_light, w_view)], [real(a) for a in scalars]
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in vectors), *(a.shape for a in numbers))
    points: list[np.ndarray] = []
    points += [np.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]) for a in vectors]
    points += [np.broadcast_to(a, shape).reshape(-1) for a in numbers]
    n, result = len(points[0]), None
    step = min(CHUNK, max(1, GATHERED // gathered))
    for start in range(0, n, step):
        part = [a[start : start + step] for a in points]
        valid = conventions.valid_directions(part[1]) & conventions.valid_directions(part[2])
        if not valid.any():
            continue
        value = lookup(*(a[valid] for a in part))
        if result is None:
            # In the precision that the lookup kept: single, where :func:`computing_in` asks for it.
            result = np.zeros((n, 3), value.dtype)
        result[start : start + step][valid] = value
    if result is None:
        result = np.zeros((n, 3), points[0].dtype)
    return result.reshape(*shape, 3)


def direction_arrays(views: DirectionSet, lights: DirectionSet) -> dict[str, np.ndarray]:
    """The direction tables of two sets, as every representation stores them."""
    result = {}
    for prefix, directions in (("view", views), ("light", lights)):
        result[f"{prefix}_directions"] = directions.vectors.astype(np.float32)
        result |= directions.interpolation.arrays(prefix)
    return result


def packed(array: np.ndarray) -> np.ndarray:
    """``array`` with its last axis padded by zeros to a multiple of 4."""
    missing = -array.shape[-1] % 4
    if not missing:
        return np.ascontiguousarray(array)
    return np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, missing)])


def packed_arrays(arrays: Mapping[str, np.ndarray], **tables: np.ndarray) -> dict[str, np.ndarray]:
    """Port layout of ``arrays`` with the ``tables`` that are laid out anew in place of their namesakes."""
    return {name: packed(tables.get(name, array)) for name, array in arrays.items()}


def base_meta(method: str, btf: BTFBlocks, parameters: Facts, *, filter_type: str = "bilinear") -> Facts:
    """The meta that every fit starts from."""
    return meta_for(
        method,
        btf.texels,
        btf.views,
        btf.lights,
        parameters,
        filter_type=filter_type,
        parent=btf.attributes,
    )


def meta_for(
    method: str,
    texels: Sequence[int],
    views: DirectionSet,
    lights: DirectionSet,
    parameters: Facts,
    *,
    filter_type: str = "bilinear",
    parent: Facts | None = None,
) -> Facts:
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
STORAGE: dict[str, type[np.floating]] = {"half": np.float16, "float": np.float32}


def stored(name: str, array: np.ndarray, storage: str) -> np.ndarray:
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


def unit_peaks(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes scaled to a peak of 1: half floats then spend their range on the shape, weights on the amount.

    Parameters
    ----------
    axes : ndarray, shape (..., d)

    Returns
    -------
    axes : ndarray, shape (..., d)
    peak : ndarray, shape (...)
        What the weights are to be multiplied by.
    """
    peak = np.maximum(np.abs(axes).max(-1, initial=0), np.finfo(np.float32).tiny)
    return axes / peak[..., None], peak


def refuse_not_finite(values: np.ndarray, btf: BTFBlocks) -> None:
    """InputError for samples of a BTF that are not finite."""
    if not np.isfinite(values).all():
        raise InputError("the BTF holds a value that is not finite", file=btf.path)


def positive_integer(name: str, value: object) -> int:
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
