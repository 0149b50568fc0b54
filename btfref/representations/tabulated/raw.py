"""The tabulated BTF itself, interpolated over directions and texels: what every method approximates."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.precision import real
from btfref.representations.file.resident import KINDS, slots_name, slots_of
from btfref.representations.file.schema import MapSchema, Schema
from btfref.representations.guide import feature_views, group_means, texel_groups
from btfref.representations.lookup import (
    StoredMaps,
    base_meta,
    direction_arrays,
    evaluate_tabulated,
    meta_for,
    refuse_not_finite,
)
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike

    from btfref.representations.lookup import Stencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts, Progress


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(4.6, rows=3, texels=1)

PRESETS: dict[str, Facts] = {"paper": {}}


class Representation(StoredMaps):
    """Table ``values`` [row, column, view, light, 3] and the directions it is sampled at."""

    DIRECTION_AXES: ClassVar = {"view": {"values": 2}, "light": {"values": 3}}
    ROWS_BY: ClassVar = {"values": (2, 3)}
    DRAWS_VIEWS: ClassVar = True

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        return Schema({"values": MapSchema("rows columns views lights 3", absent=True)})

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`; ``lod`` is ignored."""
        values = self.maps["values"]
        table = values.reshape(-1, *values.shape[2:])
        partial = self.meta.get("partial", False)

        def kernel(s: Stencils) -> np.ndarray:
            index = (s.texel[:, :, None, None], s.view[:, None, :, None], s.light[:, None, None, :])
            found = real(table[index])
            if partial:
                # Neighbours without weight may not be there.
                weight = s.texel_weight[:, :, None, None] * s.view_weight[:, None, :, None]
                found = np.where((weight * s.light_weight[:, None, None, :])[..., None] > 0, found, 0)
            result = np.einsum("nt,nv,nl,ntvlc->nc", s.texel_weight, s.view_weight, s.light_weight, found)
            if partial and np.isnan(result).any():
                raise InputError("a lookup needs texels or pairs that are not resident", field="texels")
            return result

        return evaluate_tabulated(self, kernel, uv, w_light, w_view, draw=draw)

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and their means."""
        values = self.maps["values"]
        table = values.reshape(-1, *values.shape[2:])
        if self.meta.get("partial", False):
            # What is not there is not sampled by the data either.
            table = np.nan_to_num(table)
        some = conventions.luminance(table[:, feature_views(table.shape[1])].astype(np.float32))
        labels = texel_groups(some.reshape(len(table), -1))
        return labels.reshape(values.shape[:2]), conventions.luminance(group_means(labels, table))


def fit(
    btf: BTFBlocks, *, seed: int = 0, progress: Progress | None = None, filter_type: str = "bilinear"
) -> Representation:
    """The table of ``btf`` in the layout of lookups.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        Unused: the copy takes no noticeable time.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Raises
    ------
    InputError
        For values that are not finite.
    """
    values = np.zeros((*btf.texels, len(btf.views), len(btf.lights), 3), btf.dtype)
    for row, place in enumerate(values):
        found = btf.rows(row, row + 1)[:, :, 0]
        refuse_not_finite(found, btf)
        place[:] = np.moveaxis(found, 2, 0)
    meta = base_meta("raw", btf, {}, filter_type=filter_type)
    return Representation({"values": values, **direction_arrays(btf.views, btf.lights)}, meta)


def fit_partial(store: BTFStore, *, filter_type: str = "bilinear") -> Representation:
    """The table of what is there of a store, with the directions of all of it: lookups in that part are the whole's.

    Parameters
    ----------
    store : btfref.sampling.store.store.BTFStore
        Filled in part, as by ``btfref synth --for``; views or lights without any sample are left out of the table,
        samples that are missing between others are NaN.
    filter_type : {"bilinear", "nearest"}

    Returns
    -------
    Representation
        A lookup that needs more is an error in NumPy and no number in the ports.

    Raises
    ------
    InputError
        For a store without any sample, or values that are not finite.
    """
    coverage = store.coverage
    views, lights = np.flatnonzero(coverage.any((1, 2, 3))), np.flatnonzero(coverage.any((0, 2, 3)))
    if not len(views):
        raise InputError("nothing of it is there yet", file=store.path, field="coverage")
    values = np.full((*store.texels, len(views), len(lights), 3), np.nan, store.dtype)
    for tile in np.ndindex(coverage.shape[2:]):
        rows, columns = (
            slice(k * t, min((k + 1) * t, n)) for k, t, n in zip(tile, store.tile, store.texels, strict=True)
        )
        for first in range(len(views)):
            there = np.flatnonzero(coverage[views[first], lights, *tile])
            if len(there):
                part, _ = store.read(
                    views=[views[first]], lights=lights[there], rows=rows, columns=columns, variance=False
                )
                values[rows, columns, first, there] = np.moveaxis(part[0], 0, 2)
    arrays = {"values": values, **direction_arrays(store.views, store.lights)}
    arrays["view_directions"] = np.ascontiguousarray(arrays["view_directions"][views])
    meta = meta_for(
        "raw", store.texels, store.views, store.lights, {}, filter_type=filter_type, parent=store.attributes
    )
    for kind, directions, kept in zip(KINDS, (store.views, store.lights), (views, lights), strict=True):
        if len(kept) < len(directions):
            arrays[slots_name(kind)] = slots_of(len(directions), kept)
            meta[f"resident_{kind}s"] = kept.tolist()
    if np.isnan(values).any():
        meta["partial"] = True
    return Representation(arrays, meta)
