"""Low-rank approximation of large matrices whose rows are texels."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.threads import one_blas_thread, product


def texel_matrix(values: np.ndarray) -> np.ndarray:
    """Matrix of a sampled BTF with one texel per row.

    Parameters
    ----------
    values : ndarray, shape (view, light, row, column, 3)

    Returns
    -------
    ndarray of float32, shape (row * column, view * light * 3)

    Raises
    ------
    InputError
        For values that are not finite.
    """
    views, lights, rows, columns, channels = values.shape
    # A texel's colour moves as one item: three times fewer, and larger, strided copies.
    colour = np.dtype((np.void, channels * values.itemsize))
    table = np.ascontiguousarray(values).reshape(views * lights, -1).view(colour)
    result = np.zeros((rows * columns, views * lights * channels), np.float32)
    # Blocks of texels keep source and destination in cache.
    for start in range(0, rows * columns, 256):
        block = np.ascontiguousarray(table[:, start : start + 256].T)
        result[start : start + 256] = block.view(values.dtype).reshape(len(block), -1)
        if not np.isfinite(result[start : start + 256]).all():
            raise InputError("the BTF holds a value that is not finite", field="values")
    return result


def range_basis(
    matrix: np.ndarray, rank: int, rng: np.random.Generator, *, iterations: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal rows that span the dominant row space of ``matrix``, by randomized subspace iteration.

    Halko, Martinsson, Tropp (SIAM Review 2011), algorithm 4.4 on the transpose.

    Parameters
    ----------
    matrix : ndarray of float32, shape (n, d)
    rank : int
        Rows of the basis, at most min(n, d).
    rng : numpy.random.Generator
    iterations : int
        Power iterations; each sharpens the separation from the spectrum's tail.

    Returns
    -------
    basis : ndarray of float32, shape (rank, d)
        Rows sorted by decreasing energy.
    coordinates : ndarray of float32, shape (n, rank)
        ``matrix @ basis.T``.
    """
    n, d = matrix.shape
    rank = min(rank, n, d)
    width = min(rank + 8, n, d)
    sample = product(rng.standard_normal((width, n), dtype=np.float32), matrix)
    for _ in range(iterations):
        # Orthonormalising on the short side between the products keeps float32 from losing small directions.
        sample = product(_orthonormal(product(matrix, _orthonormal(sample.T))).T, matrix)
    return _rotated(matrix, _orthonormal(sample.T), rank)


def _rotated(matrix: np.ndarray, columns: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """The leading principal directions within the span of orthonormal columns, and the coordinates along them."""
    projected = product(matrix, columns)
    with one_blas_thread():
        # The small Gram matrix in float64 keeps what float32 products resolve.
        _, vectors = np.linalg.eigh(projected.T.astype(float) @ projected.astype(float))
    vectors = vectors[:, ::-1][:, :rank].astype(np.float32)
    return product(vectors.T, columns.T), projected @ vectors


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the same space."""
    with one_blas_thread():
        return np.linalg.qr(columns)[0]
