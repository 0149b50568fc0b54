"""The maps of a Laplacian pyramid and their definition."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref.conventions import texel_stencil
from btfref.errors import InputError
from btfref.numerics.phong import phong
from btfref.numerics.pyramid import clamped_lod, expand_image, level_shapes, level_weights
from btfref.numerics.sphere import interpolation
from btfref.numerics.ycbcr import TO_RGB
from btfref.precision import real
from btfref.representations.analytic.light_functions import EDGES, held
from btfref.representations.file.schema import FLOATS, Constant, MapSchema, OneOf, Range, Schema
from btfref.representations.guide import N_GROUPS, feature_views, group_means, texel_groups
from btfref.representations.lookup import PAIRS, StoredMaps, evaluate_points, given, packed_arrays

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import ArrayLike

    from btfref.types import Facts


#: Exponent of a Phong mean that a file may hold: fits stay within 512.
LARGEST_EXPONENT = 65504.0

#: Components of a channel that a level may have.
MOST_COMPONENTS = 4096


class Representation(StoredMaps):
    """Maps of a Laplacian pyramid.

    ``basis_K`` [view, light, component] and ``weights_K`` [row, column, component] of each level K, components of Y
    before those of Cb and Cr; ``mean`` [view, light, 3] or ``phong`` [1, 6] = (k_a, k_d, k_s, α, Cb, Cr); the
    direction tables. ``meta["levels"]`` lists rows, columns and numbers of components of each level.
    """

    DIRECTION_AXES: ClassVar = {"view": {"basis_*": 0, "mean": 0}, "light": {"basis_*": 1, "mean": 1}}
    DRAWS_VIEWS: ClassVar = True
    LEVELS: ClassVar = ("basis_*", "weights_*")
    ROWS_BY: ClassVar = {"basis_*": (0,), "mean": (0,)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        levels = checked_levels(meta)
        first = meta["constants"].get("first_level", 0)
        if type(first) is not int or not 0 <= first < len(levels):
            expected = Range(0, len(levels) - 1, whole=True)
            raise InputError(
                "a level is not there", field="constants.first_level", got=first, expected=expected
            )
        maps = {}
        for k, level in enumerate(levels):
            n = sum(level["components"])
            if n and k >= first:
                maps[f"weights_{k}"] = MapSchema(f"{level['rows']} {level['columns']} {n}")
                maps[f"basis_{k}"] = MapSchema(f"views lights {n}")
        if "phong" in names:
            exponent = {(3, 6): Range(0, LARGEST_EXPONENT)}
            maps["phong"] = MapSchema("1 6", FLOATS, parts=exponent)
        else:
            maps["mean"] = MapSchema("views lights 3")
        constants: dict[str, Constant] = {k: OneOf((v,)) for k, v in level_constants(levels).items()}
        constants |= {"nearest_directions": OneOf((False, True)), "first_level": OneOf((first,)), **EDGES}
        return Schema(maps, constants, optional=("first_level",))

    @property
    def first_level(self) -> int:
        """Finest level that is kept."""
        return self.meta["constants"].get("first_level", 0)

    @property
    def max_lod(self) -> float:
        """λ of the coarsest level."""
        return len(self.meta["levels"]) - 1.0

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`.

        ``lod`` has the shape of one value a lookup or broadcasts to it; it is clamped to [0, λ_max]. Between whole
        numbers the levels' images are blended, so that the value is continuous in λ. May be slightly negative where
        the truncated expansion undershoots.
        """
        views, lights = (interpolation.from_arrays(self.maps, kind) for kind in ("view", "light"))
        nearest = self.meta["constants"]["nearest_directions"]
        levels = self.meta["levels"]

        def lookup(
            uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, lod: np.ndarray, *draws: np.ndarray
        ) -> np.ndarray:
            view = views.stencil(w_view, draw=draws[0] if draws and not nearest else None)
            light = lights.stencil(w_light, hold=False)
            if nearest:
                view, light = (_heaviest(*stencil) for stencil in (view, light))
            pairs = view[0][:, :, None], light[0][:, None, :]
            pair_weight = view[1][:, :, None] * light[1][:, None, :]
            total = self._mean(w_light, w_view, pairs, pair_weight)
            lod = clamped_lod(lod, len(levels))
            for k, share in enumerate(level_weights(lod, len(levels))):
                used = np.flatnonzero(lod < k + 1)
                if len(used) and k < self.first_level:
                    raise InputError("a lookup needs levels that are not resident", field="levels", got=k)
                if f"basis_{k}" not in self.maps or not len(used):
                    continue
                total[used] += share[used, None] * self._level(
                    k, uv[used], [p[used] for p in pairs], pair_weight[used]
                )
            return total @ real(TO_RGB.T)

        gathered = PAIRS * max([1, *(sum(level["components"]) for level in levels)])
        return evaluate_points(lookup, uv, w_light, w_view, lod, *given(draw), gathered=gathered)

    def _mean(
        self,
        w_light: np.ndarray,
        w_view: np.ndarray,
        pairs: tuple[np.ndarray, np.ndarray],
        pair_weight: np.ndarray,
    ) -> np.ndarray:
        """μ' in Y, Cb, Cr, shape (N, 3)."""
        if "mean" in self.maps:
            return np.einsum("nvl,nvlc->nc", pair_weight, real(self.maps["mean"][pairs]))
        parameters, constants = real(self.maps["phong"][0]), self.meta["constants"]
        light, fade = held(w_light, constants["light_edge"])
        view, _ = held(w_view, constants["view_edge"])
        result = np.broadcast_to(parameters[[0, 4, 5]], (len(w_light), 3)).copy()
        result[:, 0] = phong(parameters[:4], light, view)
        return fade[:, None] * result

    def _level(self, k: int, uv: np.ndarray, pairs: list[np.ndarray], pair_weight: np.ndarray) -> np.ndarray:
        """D_kᵀ E_k in Y, Cb, Cr, shape (N, 3)."""
        level = self.meta["levels"][k]
        shape = level["rows"], level["columns"]
        texel, texel_weight = texel_stencil(uv, shape, self.meta["filter_type"])
        weights = real(self.maps[f"weights_{k}"])
        weights = weights.reshape(-1, weights.shape[-1])
        coefficient = np.einsum("nt,ntk->nk", texel_weight, weights[texel])
        table = real(self.maps[f"basis_{k}"][tuple(pairs)])
        product = coefficient * np.einsum("nvl,nvlk->nk", pair_weight, table)
        ends = np.cumsum([0, *level["components"]])
        return np.stack([product[:, a:b].sum(1) for a, b in pairwise(ends)], -1)

    def tables(self, channel: int) -> np.ndarray:
        """What the stored maps say of one of Y, Cb and Cr at the finest texel centres and the measured pairs.

        Parameters
        ----------
        channel : {0, 1, 2}

        Returns
        -------
        ndarray of float32, shape (texels, n_views · n_lights)
        """
        shape = tuple(self.meta["texels"])
        average = self._luminance_mean() if channel == 0 else self._colour_mean(channel)
        total = np.tile(average.reshape(1, -1), (shape[0] * shape[1], 1))
        for k, level in enumerate(self.meta["levels"]):
            start, end = np.cumsum([0, *level["components"]])[channel : channel + 2]
            if end > start:
                weights = self.maps[f"weights_{k}"][..., start:end].astype(np.float32)
                weights = expand_image(weights, shape, self.meta["filter_type"]).reshape(len(total), -1)
                basis = self.maps[f"basis_{k}"][..., start:end].astype(np.float32)
                total += weights @ basis.reshape(-1, end - start).T
        return total

    def port_arrays(self) -> dict[str, np.ndarray]:
        """Two tables of entries of one length, so that ports can loop over levels.

        ``basis`` [level, view, light, component] and ``weights`` [texels of all levels, component], of the kept levels
        that have components; each channel padded with zeros to its largest number of components.
        """
        constants = self.meta["constants"]
        most = [constants[f"n_{name}"] for name in ("y", "cb", "cr")]
        first = np.cumsum([0, *most])
        n_views, n_lights = (len(self.maps[f"{kind}_directions"]) for kind in ("view", "light"))
        kind = np.dtype(np.float32)
        for name, table in self.maps.items():
            if name.startswith("basis_"):
                # Of fewer directions where some are not kept.
                n_views, n_lights, kind = *table.shape[:2], table.dtype
        first_level = min(self.first_level, constants["n_levels"] - 1)
        levels = self.meta["levels"][first_level : constants["n_levels"]]
        basis = np.zeros((len(levels), n_views, n_lights, first[-1]), kind)
        weights = []
        for k, level in enumerate(levels):
            number = first_level + k
            ends = np.cumsum([0, *level["components"]])
            weights.append(np.zeros((level["rows"] * level["columns"], first[-1]), kind))
            for start, a, b in zip(first, ends, ends[1:], strict=False):
                # Of levels that are not kept, one stands there with zeros where no coarser one has components.
                if b > a and f"basis_{number}" in self.maps:
                    basis[k, ..., start : start + b - a] = self.maps[f"basis_{number}"][..., a:b]
                    own = self.maps[f"weights_{number}"][..., a:b]
                    weights[k][:, start : start + b - a] = own.reshape(-1, b - a)
        others = {name: a for name, a in self.maps.items() if not name.startswith(("basis_", "weights_"))}
        return packed_arrays({**others, "basis": basis, "weights": np.concatenate(weights)})

    @property
    def sampling_levels(self) -> int:
        """Number of levels that :meth:`sampling_tables` has guides for."""
        return len(self.meta["levels"])

    def sampling_tables(self, level: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels of a level alike, and their means; half as many groups a level."""
        own = self.meta["levels"][level]
        shape = own["rows"], own["columns"]
        n_views = len(self.maps["view_directions"])
        coefficient = [np.ones((shape[0] * shape[1], 1), np.float32)]
        tables = [self._luminance_mean()[None]]
        for k in range(level, len(self.meta["levels"])):
            n = self.meta["levels"][k]["components"][0]
            if not n or k < self.first_level:
                continue
            weights = self.maps[f"weights_{k}"][..., :n].astype(np.float32)
            weights = expand_image(weights, shape, self.meta["filter_type"])
            coefficient.append(weights.reshape(-1, n))
            tables.append(np.moveaxis(self.maps[f"basis_{k}"][..., :n], -1, 0).astype(np.float32))
        amounts, table = np.concatenate(coefficient, 1), np.concatenate(tables)
        some = table[:, feature_views(n_views)].reshape(len(table), -1)
        labels = texel_groups(amounts @ some, max(1, N_GROUPS >> level))
        return labels.reshape(shape), np.tensordot(group_means(labels, amounts), table, 1)

    def _luminance_mean(self) -> np.ndarray:
        """μ' of Y at the measured pairs, shape (n_views, n_lights)."""
        if "mean" in self.maps:
            return self.maps["mean"][..., 0].astype(np.float32)
        views, lights = (self.maps[f"{kind}_directions"].astype(float) for kind in ("view", "light"))
        w_view, w_light = np.broadcast_arrays(views[:, None], lights[None])
        return phong(self.maps["phong"][0, :4], w_light, w_view).astype(np.float32)

    def _colour_mean(self, channel: int) -> np.ndarray:
        """μ' of Cb (1) or Cr (2) at the measured pairs."""
        if "mean" in self.maps:
            return self.maps["mean"][..., channel].astype(np.float32)
        shape = [len(self.maps[f"{kind}_directions"]) for kind in ("view", "light")]
        return np.full(shape, self.maps["phong"][0, 3 + channel], np.float32)


def checked_levels(meta: Facts) -> list[Facts]:
    """``meta["levels"]`` of a file: sizes that are those of a pyramid, and numbers of components.

    Raises
    ------
    InputError
    """
    levels = meta["levels"]
    expected = "a list of rows, columns and three numbers of components"
    if not isinstance(levels, list) or not levels:
        raise InputError("damaged manifest", field="levels", got=repr(levels)[:60], expected=expected)
    shapes = level_shapes(meta["texels"], len(levels))
    for k, (level, shape) in enumerate(zip(levels, shapes, strict=True)):
        counts = level["components"]
        sizes = [level["rows"], level["columns"]]
        whole = all(type(n) is int and 0 <= n <= MOST_COMPONENTS for n in (*counts, *sizes))
        if not whole or len(counts) != 3 or tuple(sizes) != shape:
            got = repr([*sizes, counts])[:60]
            wanted = f"{shape[0]}, {shape[1]} and three numbers of components"
            raise InputError("damaged manifest", field=f"levels[{k}]", got=got, expected=wanted)
    return levels


def level_constants(levels: Sequence[Facts]) -> Facts:
    """What ports need of the levels: those with components, their sizes and first texels, numbers of components."""
    used = [k for k, level in enumerate(levels) if any(level["components"])]
    n = max(used, default=0) + 1
    rows, columns = ([level[axis] for level in levels[:n]] for axis in ("rows", "columns"))
    first = np.cumsum([0, *(r * c for r, c in zip(rows, columns, strict=True))])[:-1].tolist()
    most = np.max([level["components"] for level in levels[:n]], axis=0).tolist()
    # A table needs a column, even for a BTF without any variation.
    most[0] = max(most[0], 1)
    text = {
        name: f"int[{n}]({', '.join(map(str, values))})"
        for name, values in zip(
            ("level_rows", "level_columns", "level_first"), (rows, columns, first), strict=True
        )
    }
    return {
        "n_levels": n,
        "max_lod": float(len(levels) - 1),
        "n_y": most[0],
        "n_cb": most[1],
        "n_cr": most[2],
        **text,
    }


def _heaviest(index: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sample with the largest weight, with the weight of all."""
    best = np.argmax(weight, 1)[:, None]
    return np.take_along_axis(index, best, 1), weight.sum(1, keepdims=True)
