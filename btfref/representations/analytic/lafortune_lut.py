"""Lafortune lobes times a view-dependent factor from a table per texel: the baseline "SLAF" of reflectance fields.

Sources: K. Daubert et al., "Efficient Cloth Modeling and Rendering", EGWR 2001: the factor stands for what the texel
shows of itself to a view (self-occlusion); Meseth, Müller, Klein 2004, Table 1. Lobes: see
:mod:`btfref.representations.analytic.lafortune`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.representations.analytic import lafortune, light_functions
from btfref.representations.file.schema import MapSchema, Schema
from btfref.representations.lookup import positive_integer
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike

    from btfref.representations.analytic.light_functions import HeldStencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(
    blocks=220 << 20, scales=("lobes",), rows=4, texels=light_functions.BLOCK, texel=400, field=12
)

#: "paper": Table 1's four lobes, in floats.
PRESETS: dict[str, Facts] = {"paper": {"lobes": 4, "bounded": False, "storage": "float"}}

#: Largest factor; a texel that the model misses altogether from one view must not make it grow without limit.
FACTOR_BOUND = 8.0

#: Rule over the lights for directional albedos.
ALBEDO_RULE = (6, 20)


class Representation(light_functions.AnalyticMaps):
    """Maps of :class:`btfref.representations.analytic.lafortune.Representation` and ``factor`` [row, column, view]."""

    #: Maps by view; see :mod:`btfref.representations.file.resident`.
    DIRECTION_AXES: ClassVar = {"view": {"factor": 2}}
    EXPONENTS: ClassVar = {"lobes": (3, 4)}
    DRAWS_VIEWS: ClassVar = True

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        return lafortune.lobe_schema(factor=MapSchema("rows columns views", least=0, most=FACTOR_BOUND))

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`; ``lod`` is ignored. Never negative.

        The factor is interpolated over views as tables are; the lobes are evaluated at the view itself.
        """
        maps = lafortune.flat_maps(self.maps)

        def kernel(s: HeldStencils) -> np.ndarray:
            factor = np.einsum(
                "ntv,nv->nt", maps["factor"][s.texel[:, :, None], s.view[:, None, :]], s.view_weight
            )
            value = factor * lafortune.texel_values(maps, s)
            return np.einsum("nt,ntc,nt->nc", s.texel_weight, maps["colour"][s.texel, :3], value)

        return light_functions.evaluate_analytic(self, kernel, uv, w_light, w_view, draw=draw)

    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Model of luminance at measured views and all measured lights, shape (n, n_views, n_lights)."""
        factor = self.maps["factor"].reshape(-1, self.maps["factor"].shape[-1])[texels[:, None], views]
        return factor[..., None].astype(np.float32) * lafortune.luminance_tables(self.maps, texels, views)


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    lobes: int = 4,
    rounds: int = 1,
    bounded: bool = True,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Fit lobes, then the factor in closed form, then lobes with that factor, and so on.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        ``progress(done, total, label)``.
    lobes : int
        Per texel, at least 1.
    rounds : int
        Refits of the lobes after the first fit; the factor is updated after each. At least 1.
    bounded : bool
        The factor is at most what keeps the directional albedo of each measured view, of luminance, at 1, or at that of
        the data where they have more: least squares at a few lights leave open how bright a lobe is between them.
        Differs from the paper (False).
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` as for :func:`btfref.representations.analytic.lafortune.fit`.

    Raises
    ------
    InputError
        For parameters out of range, or values that are not finite or do not fit ``storage``.
    MissingDependencyError
        Without LLVM or CUDA.
    """
    n_lobes, rounds = positive_integer("lobes", lobes), positive_integer("rounds", rounds)
    parameters = {"lobes": n_lobes, "rounds": rounds, "bounded": bounded, "storage": storage, "seed": seed}
    return lafortune.fit_texels(
        Representation, "lafortune_lut", btf, _lobes_and_factor, parameters, progress, storage, filter_type
    )


def _lobes_and_factor(btf: BTFBlocks, parameters: Facts, luminance: np.ndarray) -> lafortune.BlockFit:
    """A block's lobes and factor."""
    n_lobes, bounded = parameters["lobes"], parameters["bounded"]
    result = lafortune.fit_lafortune(luminance, btf.views, btf.lights, n_lobes)
    factor = view_factor(luminance, result.parameters, btf, bounded=bounded)
    for _ in range(parameters["rounds"]):
        result = lafortune.fit_lafortune(
            luminance, btf.views, btf.lights, n_lobes, start=result.parameters, factor=factor
        )
        factor = view_factor(luminance, result.parameters, btf, bounded=bounded)
    return result, {"factor": factor.T}


def view_factor(
    luminance: np.ndarray, parameters: np.ndarray, btf: BTFBlocks, *, bounded: bool = False
) -> np.ndarray:
    """Least-squares factor of each view and texel, ``Σ_l B M / Σ_l M²`` in [0, 8]; 1 where the model is 0.

    Parameters
    ----------
    luminance : ndarray, shape (view, light, n)
    parameters : ndarray, shape (n, 1 + 5 k)
        Of the lobes.
    btf : BTFBlocks
    bounded : bool
        See :func:`fit`.

    Returns
    -------
    ndarray of float32, shape (view, n)
    """
    lobes, peaks, diffuse = lafortune.lobe_maps(parameters)
    colour = np.pad(diffuse[:, None], ((0, 0), (3, 0)))
    maps = {"lobes": lobes, "peaks": peaks, "colour": colour, "view_directions": btf.views.vectors}
    texels = np.arange(len(parameters))
    nodes, solid_angle = gauss_hemisphere(*ALBEDO_RULE)
    factor = np.ones(luminance.shape[::2], np.float32)
    for view in range(len(factor)):

        def model(lights: np.ndarray, view: int = view) -> np.ndarray:
            at = maps | {"light_directions": lights}
            return lafortune.luminance_tables(at, texels, np.array([view]))[:, 0]

        measured = model(btf.lights.vectors)
        square = np.einsum("nl,nl->n", measured, measured)
        product = np.einsum("ln,nl->n", luminance[view], measured)
        known = square > 1e-20
        factor[view, known] = np.clip(product[known] / square[known], 0, FACTOR_BOUND)
        if bounded:
            albedo = model(nodes) @ solid_angle.astype(np.float32)
            limit = np.maximum(1, btf.lights.quadrature_weights @ luminance[view])
            lit = albedo > 0
            factor[view, lit] = np.minimum(factor[view, lit], limit[lit] / albedo[lit])
    return factor
