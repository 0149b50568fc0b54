"""Global truncated singular value decomposition of the texel-by-direction matrix: the codec in common use.

Source: M. Koudelka, S. Magda, P. Belhumeur, D. Kriegman, "Acquisition, Compression, and Synthesis of Bidirectional
Texture Functions", Texture 2003. ``B_x = Σ_c w_{x,c} E_c``, without a mean.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref import conventions
from btfref.numerics.solvers.streaming import leading
from btfref.numerics.solvers.threads import reproducible
from btfref.precision import real
from btfref.representations.columns import Steps, TexelColumns
from btfref.representations.file.schema import MapSchema, Number, Schema
from btfref.representations.guide import feature_views, group_means, texel_groups
from btfref.representations.lookup import (
    PAIRS,
    StoredMaps,
    base_meta,
    direction_arrays,
    evaluate_tabulated,
    packed_arrays,
    positive_integer,
    stored,
    unit_peaks,
)
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike

    from btfref.representations.lookup import Stencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(view=12, columns=24, tables=("components",))

#: Koudelka et al. keep 150 components for one texture; 16 cost a lookup about three times what local PCA's 4 cost.
PRESETS = {"paper": {"components": 150, "storage": "float"}}

#: How often the values are read: two power iterations and the last projection.
PASSES = 3


class Representation(StoredMaps):
    """Maps: ``basis`` [component, view, light, 3], ``weights`` [row, column, component], direction tables."""

    DIRECTION_AXES: ClassVar = {"view": {"basis": 1}, "light": {"basis": 2}}
    DRAWS_VIEWS: ClassVar = True
    ROWS_BY: ClassVar = {"basis": (1,)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        maps = {
            "weights": MapSchema("rows columns components"),
            "basis": MapSchema("components views lights 3"),
        }
        return Schema(maps, {"n_components": Number("components")})

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`; ``lod`` is ignored.

        May be slightly negative where the truncated expansion undershoots.
        """
        basis = self.maps["basis"]
        weights = self.maps["weights"]
        weights = weights.reshape(-1, weights.shape[-1])

        def kernel(s: Stencils) -> np.ndarray:
            coefficient = np.einsum("nt,ntk->nk", s.texel_weight, weights[s.texel])
            table = real(basis[:, s.view[:, :, None], s.light[:, None, :]])
            return np.einsum("nk,nvl,knvlc->nc", coefficient, s.pair_weight, table, optimize=True)

        return evaluate_tabulated(
            self, kernel, uv, w_light, w_view, draw=draw, gathered=PAIRS * 3 * len(basis)
        )

    def port_arrays(self) -> dict[str, np.ndarray]:
        """``basis`` [view, light, component · 3]: one direction pair is contiguous."""
        basis = np.moveaxis(self.maps["basis"], 0, 2)
        return packed_arrays(self.maps, basis=basis.reshape(*basis.shape[:2], -1))

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and their means."""
        weights = self.maps["weights"].astype(np.float32)
        basis = conventions.luminance(self.maps["basis"].astype(np.float32))
        flat = weights.reshape(-1, weights.shape[-1])
        some = np.tensordot(flat, basis[:, feature_views(basis.shape[1])], 1)
        labels = texel_groups(some.reshape(len(flat), -1))
        return labels.reshape(weights.shape[:2]), np.tensordot(group_means(labels, flat), basis, 1)


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    components: int = 16,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Truncated singular value decomposition of ``btf``.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Of the randomized subspace iteration; same seed, same result.
    progress : callable, optional
        ``progress(done, total, label)``.
    components : int
        At least 1; no more than texels are kept.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]["error"]`` holds the relative squared error.

    Raises
    ------
    InputError
        For parameters out of range, or values that do not fit ``storage``.
    """
    components = positive_integer("components", components)
    rows, columns = btf.texels
    steps = Steps(progress, PASSES * len(btf.views))
    steps.begin("singular vectors")
    found = leading(TexelColumns(btf, steps), components, np.random.default_rng(seed), passes=PASSES)
    basis, weights, energy = found.basis, found.coordinates, float(found.squares.sum())
    kept = float((weights.astype(float) ** 2).sum())
    shapes, peak = unit_peaks(basis)
    table = shapes.reshape(-1, len(btf.views), len(btf.lights), 3)
    maps = {
        "basis": stored("basis", table, storage),
        "weights": stored("weights", (weights * peak).reshape(rows, columns, -1), storage),
    }
    parameters = {"components": components, "storage": storage, "seed": seed}
    meta = base_meta("svd", btf, parameters, filter_type=filter_type)
    meta["constants"] = {"n_components": len(basis)}
    meta["fit"] = {"error": max(0.0, 1 - kept / energy) if energy > 0 else 0.0}
    return Representation(maps | direction_arrays(btf.views, btf.lights), meta)
