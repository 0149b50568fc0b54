"""Reflectance fields as biquadratic polynomials: one per texel and measured view.

Sources: J. Meseth, G. Müller, R. Klein, "Reflectance Field Based Real-Time, High-Quality Rendering of Bidirectional
Texture Functions", Computers & Graphics 2004, section 4 ("RFP"); T. Malzbender, D. Gelb, H. Wolters, "Polynomial
Texture Maps", SIGGRAPH 2001, eq. 2: ``a0 l_x² + a1 l_y² + a2 l_x l_y + a3 l_x + a4 l_y + a5`` for luminance, times the
texel's chroma.

Differs from that equation in its basis: ``a5 l_z²`` stands in place of ``a5``. On the sphere ``1 = l_x² + l_y² +
l_z²``, so the functions are the same, but at grazing light, where they are small, large terms do not have to cancel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref.numerics.solvers.threads import reproducible
from btfref.precision import real
from btfref.representations.analytic import light_functions
from btfref.representations.file.schema import MapSchema, Schema
from btfref.representations.lookup import stored
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike

    from btfref.representations.analytic.light_functions import HeldStencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(rows=6, texels=light_functions.BLOCK, field=61)

#: "paper": all 81 views in floats.
PRESETS = {"paper": {"storage": "float"}}

#: Singular values below this share of the largest are dropped: float32 data cannot tell such a combination of the
#: six terms from zero.
CUTOFF = 1e-5


def terms(w_light: np.ndarray) -> np.ndarray:
    """The six terms of the polynomial, shape (..., 3) -> (..., 6)."""
    x, y, z = np.moveaxis(w_light, -1, 0)
    return np.stack([x * x, y * y, x * y, x, y, z * z], -1)


class Representation(light_functions.AnalyticMaps):
    """``polynomial`` [row, column, view, 6], ``chroma`` [row, column, 3], and the direction tables."""

    #: Maps by view; see :mod:`btfref.representations.file.resident`.
    DIRECTION_AXES: ClassVar = {"view": {"polynomial": 2}}
    DRAWS_VIEWS: ClassVar = True
    ROWS_BY: ClassVar = {"polynomial": (2,)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        maps = {
            "polynomial": MapSchema("rows columns views 6"),
            "chroma": MapSchema("rows columns 3"),
        }
        return Schema(maps, light_functions.EDGES)

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

        May be negative where a polynomial undershoots.
        """
        polynomial = self.maps["polynomial"]
        polynomial = polynomial.reshape(-1, *polynomial.shape[2:])
        chroma = real(self.maps["chroma"].reshape(-1, 3))

        def kernel(s: HeldStencils) -> np.ndarray:
            coefficient = real(polynomial[s.texel[:, :, None], s.view[:, None, :]])
            value = np.einsum("ntvk,nk->ntv", coefficient, terms(s.w_light))
            value = np.einsum("ntv,nt,nv->nt", value, s.texel_weight, s.view_weight)
            return np.einsum("nt,ntc->nc", value, chroma[s.texel])

        return light_functions.evaluate_analytic(self, kernel, uv, w_light, w_view, draw=draw)

    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Model of luminance at measured views and all measured lights, shape (n, n_views, n_lights)."""
        polynomial = self.maps["polynomial"]
        coefficient = polynomial.reshape(-1, *polynomial.shape[2:])[texels[:, None], views].astype(np.float32)
        return coefficient @ terms(self.maps["light_directions"].astype(np.float32)).T


def light_operator(lights: np.ndarray) -> tuple[np.ndarray, Facts]:
    """The pseudo-inverse of the terms at the measured lights.

    Parameters
    ----------
    lights : ndarray, shape (n_lights, 3)

    Returns
    -------
    operator : ndarray of float64, shape (6, n_lights)
        Of least norm where the lights do not determine all six coefficients, as when they lie on one ring.
    report : dict
        ``rank`` and ``condition``, the ratio of the largest to the smallest singular value that is kept.
    """
    u, singular, vt = np.linalg.svd(terms(np.asarray(lights, float)), full_matrices=False)
    kept = singular > CUTOFF * singular[0]
    inverse = np.where(kept, 1 / np.where(kept, singular, 1), 0)
    return (vt.T * inverse) @ u.T, {
        "rank": int(kept.sum()),
        "condition": float(singular[0] / singular[kept][-1]),
    }


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Least-squares polynomials of ``btf`` in closed form.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        ``progress(done, total, label)``.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds ``epsilon`` (see :func:`light_functions.fit_report`), ``rank`` and ``condition``,
        ``memory`` (see :func:`light_functions.memory_report`).

    Raises
    ------
    InputError
        For values that are not finite or do not fit ``storage``.
    """
    # All views share the measured lights, hence one operator.
    operator, conditioning = light_operator(btf.lights.vectors)
    n_views, (rows, columns) = len(btf.views), btf.texels
    polynomial = np.zeros((rows * columns, n_views, 6), np.float32)
    chroma = np.zeros((rows * columns, 3))
    blocks = light_functions.over_luminance(
        btf, _polynomials, operator.astype(np.float32), progress, "polynomials"
    )
    for part, (found, colour) in blocks:
        polynomial[part], chroma[part] = found, colour
    maps = {
        "polynomial": stored("polynomial", polynomial.reshape(rows, columns, n_views, 6), storage),
        "chroma": stored("chroma", chroma.reshape(rows, columns, 3), storage),
    }
    return light_functions.finished(
        Representation,
        "rf_poly",
        btf,
        maps,
        {"storage": storage, "seed": seed},
        filter_type=filter_type,
        facts=conditioning,
        by_view=True,
    )


def _polynomials(
    btf: BTFBlocks, operator: np.ndarray, part: slice, luminance: np.ndarray, chroma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials of a block's texels, (n, view, 6), and their chroma."""
    return np.einsum("kl,vln->nvk", operator, luminance, optimize=True), chroma
