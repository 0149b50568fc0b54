"""Normals from reciprocity by batched Levenberg–Marquardt, and heights that fit both.

Sources: Menzel and Guthe 2009, eq. 7 and 8; D. Nehab, S. Rusinkiewicz, J. Davis, R. Ramamoorthi, "Efficiently Combining
Positions and Normals for Precise 3D Geometry", SIGGRAPH 2005.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.heightfield import HeightField
from btfref.representations.gbrdf.decomposition.pairs import surface_stencil, tangent

if TYPE_CHECKING:
    from types import ModuleType

    from btfref.numerics.solvers.levenberg import Model, Samples
    from btfref.representations.gbrdf.decomposition.pairs import ReciprocalPairs
    from btfref.types import Facts, JitArray, Progress


#: Largest slope that is looked for: 80° from the plane.
SLOPE_LIMIT = 5.0

#: Cosine, relative to the length of (−sx, −sy, 1), at which the logarithm is held: behind a facet there is no light.
_FACING = 0.02


def visible(field: HeightField, directions: np.ndarray) -> np.ndarray:
    """Whether the texels' points see directions, bool (rows * columns, n): views and lights alike.

    Parameters
    ----------
    field : btfref.numerics.heightfield.HeightField
    directions : ndarray, shape (n, 3)
        On the horizon nothing is seen.
    """
    rows, columns = field.shape
    index = np.arange(rows * columns)
    uv = np.stack([(index % columns + 0.5) / columns, (index // columns + 0.5) / rows], -1)
    points = field.points(uv)
    result = np.zeros((rows * columns, len(directions)), bool)
    for column, w in enumerate(directions):
        if w[2] > 1e-6:
            result[:, column] = field.lit(points, np.broadcast_to(w, (len(index), 3)))
    return result


def helmholtz_normals(
    pairs: ReciprocalPairs, heights: np.ndarray, progress: Progress | None = None
) -> tuple[np.ndarray, Facts]:
    """Slopes that minimise ``Σ v log²(ρ(a, b) / ρ(b, a))`` with ``ρ = L / (k1·n)`` (eq. 7).

    Parameters
    ----------
    pairs : btfref.representations.gbrdf.decomposition.pairs.ReciprocalPairs
    heights : ndarray, shape (rows, columns)
        Tile units; where the images are looked up, and what v (visible from both directions) is decided by.
    progress : callable, optional

    Returns
    -------
    slopes : ndarray of float64, shape (rows, columns, 2)
    summary : dict
        Of the fits; see :class:`btfref.numerics.solvers.levenberg.BatchFit`.
    """
    from btfref.numerics.solvers.levenberg import backend, fit_batch

    shape, n = heights.shape, heights.size
    if not len(pairs):
        return np.zeros((*shape, 2)), {"fits": 0}
    field = HeightField(heights.astype(np.float32))
    both = np.concatenate([pairs.first, pairs.second])
    unique, where = np.unique(both, axis=0, return_inverse=True)
    where = where.reshape(-1)
    seen = visible(field, unique)
    stencils = [surface_stencil(heights, tangent(w)) for w in unique]
    ratio, weight = np.zeros((len(pairs), n), np.float32), np.zeros((len(pairs), n), np.float32)
    for pair in range(len(pairs)):
        a, b = where[pair], where[len(pairs) + pair]
        values = []
        for image, direction in zip(pairs.images(pair), (a, b), strict=True):
            index, share = stencils[direction]
            values.append(np.einsum("nk,nk->n", image.reshape(-1)[index], share))
        bright = np.minimum(*values) > pairs.black
        weight[pair] = seen[:, a] & seen[:, b] & bright
        ratio[pair] = np.log(np.maximum(values[0], pairs.black) / np.maximum(values[1], pairs.black))
    report = (lambda done, total: progress(done, total, "normals")) if progress else None
    fitted = fit_batch(
        _model(backend(), ratio, weight, pairs.first, pairs.second),
        np.zeros((n, 2), np.float32),
        [-SLOPE_LIMIT] * 2,
        [SLOPE_LIMIT] * 2,
        len(pairs),
        progress=report,
    )
    return fitted.parameters.reshape(*shape, 2).astype(float), fitted.summary


def _model(
    module: ModuleType, ratio: np.ndarray, weight: np.ndarray, first: np.ndarray, second: np.ndarray
) -> Model:
    """Residuals and Jacobian for `fit_batch`: parameters are the slopes along u and v."""
    import drjit as dr

    Float = module.Float
    n = dr.opaque(module.UInt32, ratio.shape[1])
    data, mask = Float(ratio.ravel()), Float(weight.ravel())
    table = np.zeros((len(first), 8), np.float32)
    table[:, :3], table[:, 4:7] = first, second
    table = Float(table.ravel())

    def model(p: list[JitArray], fit: JitArray) -> tuple[Samples, list[JitArray]]:
        size = dr.sqrt(1 + p[0] * p[0] + p[1] * p[1])

        def facing(w: JitArray) -> tuple[JitArray, JitArray, JitArray]:
            """Logarithm of the cosine times ``size``, and what its derivatives are, up to their sign."""
            x, y, z, _ = w
            cosine = z - x * p[0] - y * p[1]
            held = cosine < _FACING * size
            cosine = dr.select(held, _FACING * size, cosine)
            return dr.log(cosine), dr.select(held, 0, x / cosine), dr.select(held, 0, y / cosine)

        def samples(step: JitArray) -> list[tuple[JitArray, list[JitArray]]]:
            log_a, xa, ya = facing(dr.gather(module.Array4f, table, 2 * step))
            log_b, xb, yb = facing(dr.gather(module.Array4f, table, 2 * step + 1))
            at = dr.fma(step, n, fit)
            share = dr.gather(Float, mask, at)
            # Seen from a under b: ρ (b·n); the other way round: ρ (a·n).
            value = dr.gather(Float, data, at) - log_b + log_a
            return [(share * value, [share * (xb - xa), share * (yb - ya)])]

        return samples, [Float(1), Float(1)]

    return model


def fuse(heights: np.ndarray, slopes: np.ndarray, depth_weight: float = 0.2) -> np.ndarray:
    """Heights that are near given ones and whose differences fit given slopes.

    Minimises ``λ Σ (h − h0)² + (1 − λ) Σ (difference of neighbours − mean slope between them)²`` on the periodic tile.
    Its normal equations have constant coefficients there, so that the sparse system is solved exactly by one Fourier
    transform.

    Parameters
    ----------
    heights : ndarray, shape (rows, columns)
        Tile units.
    slopes : ndarray, shape (rows, columns, 2)
        Along u and v.
    depth_weight : float
        λ in (0, 1].

    Returns
    -------
    ndarray of float64, shape (rows, columns)
    """
    rows, columns = heights.shape
    numerator = depth_weight * np.fft.fft2(heights)
    denominator = np.full(heights.shape, float(depth_weight))
    for axis, component, n in ((1, 0, columns), (0, 1, rows)):
        slope = slopes[..., component]
        step = (slope + np.roll(slope, -1, axis)) / (2 * n)
        turn = np.exp(2j * np.pi * np.fft.fftfreq(n)) - 1
        turn = turn[None, :] if axis == 1 else turn[:, None]
        numerator = numerator + (1 - depth_weight) * np.conj(turn) * np.fft.fft2(step)
        denominator = denominator + (1 - depth_weight) * np.abs(turn) ** 2
    return np.fft.ifft2(numerator / denominator).real
