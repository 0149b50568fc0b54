"""Image pyramids that wrap around, of any size: reduction to half the texels, expansion to any level above.

Source: P. J. Burt and E. H. Adelson, "The Laplacian Pyramid as a Compact Image Code", IEEE Trans. Communications 1983.
Differs from it in the expansion: a level is expanded to any finer one in a single step, which is the texture lookup at
the finer level's texel centres. A renderer then needs one lookup a level, and a level that holds the difference to the
sum of the coarser ones expanded that way is reconstructed exactly at its texel centres.

Texel centres are at (i + ½)/n at every level, so that levels do not shift against each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from btfref.conventions import FILTER_TYPES
from btfref.errors import InputError
from btfref.precision import real

#: Kernels of the reduction. "binomial": (1 3 3 1)/8 for even sizes, centred between the two texels that become one.
#: "box": (1 1 1)/3 about the first of the two (Ma et al. 2005), which shifts a level by half a texel of the finer one.
REDUCTIONS = ("binomial", "box")

#: Rounds of balancing that make row and column sums of an odd size's reduction right to float64's rounding.
_BALANCING = 200


def level_shapes(shape: Sequence[int], n_levels: int | None = None) -> list[tuple[int, int]]:
    """Rows and columns of each level: halves, rounded up.

    Parameters
    ----------
    shape : (int, int)
        Of level 0.
    n_levels : int, optional
        At least 1; default: down to a single texel.

    Returns
    -------
    list of (int, int)

    Raises
    ------
    InputError
        When there are not that many levels.
    """
    shapes = [(int(shape[0]), int(shape[1]))]
    while shapes[-1] != (1, 1):
        rows, columns = shapes[-1]
        shapes.append(((rows + 1) // 2, (columns + 1) // 2))
    if n_levels is None:
        return shapes
    if not 1 <= n_levels <= len(shapes):
        raise InputError(
            "the pyramid has another height", field="levels", got=n_levels, expected=f"1 to {len(shapes)}"
        )
    return shapes[:n_levels]


def expansion(n: int, m: int, filter_type: str) -> np.ndarray:
    """Values at the centres of ``n`` texels from those of ``m``, along one axis.

    Parameters
    ----------
    n, m : int
        n ≥ m.
    filter_type : {"nearest", "bilinear"}

    Returns
    -------
    ndarray of float64, shape (n, m)
        Non-negative; rows sum to 1.
    """
    if filter_type not in FILTER_TYPES:
        raise InputError(
            "unknown texel filter",
            field="filter_type",
            got=repr(filter_type),
            expected=" or ".join(FILTER_TYPES),
        )
    position = (np.arange(n) + 0.5) * m / n
    result = np.zeros((n, m))
    if filter_type == "nearest":
        result[np.arange(n), np.minimum(position.astype(int), m - 1)] = 1
        return result
    position = position - 0.5
    low = np.floor(position).astype(int)
    fraction = position - low
    np.add.at(result, (np.arange(n), low % m), 1 - fraction)
    np.add.at(result, (np.arange(n), (low + 1) % m), fraction)
    return result


def reduction(n: int, m: int, kind: str) -> np.ndarray:
    """Values of ``m`` texels from those of ``n``, one level below, along one axis.

    Parameters
    ----------
    n, m : int
        m = ⌈n/2⌉.
    kind : {"binomial", "box"}

    Returns
    -------
    ndarray of float64, shape (m, n)
        Non-negative; rows sum to 1. The columns of "binomial" sum to m/n, so that it keeps the mean.

    Raises
    ------
    InputError
        For another kind.
    """
    if kind not in REDUCTIONS:
        raise InputError(
            "unknown reduction", field="reduction", got=repr(kind), expected=" or ".join(REDUCTIONS)
        )
    if n == m:
        return np.eye(n)
    if kind == "box":
        centre = np.ceil((np.arange(m) + 0.5) * n / m - 1).astype(int)
        result = np.zeros((m, n))
        for step in (-1, 0, 1):
            np.add.at(result, (np.arange(m), (centre + step) % n), 1 / 3)
        return result
    # The transpose of linear interpolation: for n = 2 m exactly (1 3 3 1)/8. Other sizes are balanced (Sinkhorn 1967).
    result = expansion(n, m, "bilinear").T
    for _ in range(_BALANCING):
        result = result * (m / n / result.sum(0))
        total = result.sum(1, keepdims=True)
        result = result / total
        if np.abs(total - 1).max() < 1e-15:
            break
    return result


def apply(rows: np.ndarray, columns: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A separable operator on images, shape (r, c, ...) -> (r', c', ...), in the images' own type."""
    rows, columns = rows.astype(image.dtype), columns.astype(image.dtype)
    # One operator at a time as a matrix product; the trailing axes stay contiguous.
    result = (rows @ image.reshape(len(image), -1)).reshape(len(rows), *image.shape[1:])
    flat = result.reshape(*result.shape[:2], -1)
    return np.matmul(columns, flat).reshape(len(rows), len(columns), *image.shape[2:])


def reduce_image(image: np.ndarray, kind: str) -> np.ndarray:
    """The next coarser level of images, shape (r, c, ...) -> (⌈r/2⌉, ⌈c/2⌉, ...)."""
    r, c = image.shape[:2]
    return apply(reduction(r, (r + 1) // 2, kind), reduction(c, (c + 1) // 2, kind), image)


def expand_image(image: np.ndarray, shape: Sequence[int], filter_type: str) -> np.ndarray:
    """Images looked up at the texel centres of a finer level, shape (r, c, ...) -> (*shape, ...)."""
    r, c = image.shape[:2]
    if (r, c) == tuple(shape):
        return image
    return apply(expansion(shape[0], r, filter_type), expansion(shape[1], c, filter_type), image)


def gaussian_pyramid(image: np.ndarray, n_levels: int, kind: str) -> list[np.ndarray]:
    """Ever coarser levels of images, the images first; a list of ``n_levels`` arrays."""
    level_shapes(image.shape[:2], n_levels)
    levels = [image]
    while len(levels) < n_levels:
        levels.append(reduce_image(levels[-1], kind))
    return levels


def laplacian_pyramid(image: np.ndarray, n_levels: int, kind: str, filter_type: str) -> list[np.ndarray]:
    """Differences of each level to the sum of the coarser ones, and the coarsest level itself.

    Ma et al. 2005, eq. 2 and 3, but for the expansion; see above.

    Parameters
    ----------
    image : ndarray, shape (r, c, ...)
    n_levels : int
    kind : {"binomial", "box"}
    filter_type : {"nearest", "bilinear"}

    Returns
    -------
    list of ndarray
        ``reconstruct(levels, k, filter_type)`` gives level k of the Gaussian pyramid again.
    """
    levels = gaussian_pyramid(image, n_levels, kind)
    for k in range(n_levels - 2, -1, -1):
        coarser = levels[k + 1 :]
        levels[k] = levels[k] - sum(expand_image(c, levels[k].shape[:2], filter_type) for c in coarser)
    return levels


def reconstruct(levels: Sequence[np.ndarray], k: int, filter_type: str) -> np.ndarray:
    """Level k of the images from a Laplacian pyramid: the sum of levels k and coarser."""
    return np.asarray(sum(expand_image(level, levels[k].shape[:2], filter_type) for level in levels[k:]))


def level_weights(lod: ArrayLike, n_levels: int) -> np.ndarray:
    """Weights of the levels at a level of detail, ``w_k = clamp(1 − λ + k, 0, 1)`` (Ma et al. 2005, eq. 7).

    Parameters
    ----------
    lod : array_like, shape (...)
        Clamped to [0, n_levels − 1]; NaN counts as 0.
    n_levels : int

    Returns
    -------
    ndarray of float64, shape (n_levels, ...)
        The coarsest level's weight is 1 for any λ.
    """
    lod = clamped_lod(lod, n_levels)
    k = real(np.arange(n_levels)).reshape(-1, *[1] * lod.ndim)
    return np.clip(1 - lod + k, 0, 1)


def clamped_lod(lod: ArrayLike, n_levels: int) -> np.ndarray:
    """λ within [0, n_levels − 1]; NaN counts as 0."""
    lod = real(lod)
    return np.clip(np.where(np.isnan(lod), 0.0, lod), 0, n_levels - 1)
