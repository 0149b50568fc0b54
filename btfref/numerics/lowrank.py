"""Low-rank approximation of large matrices whose rows are texels."""

from __future__ import annotations

import numpy as np


def texel_matrix(values):
    """Matrix of a sampled BTF with one texel per row.

    Parameters
    ----------
    values : ndarray, shape (view, light, row, column, 3)

    Returns
    -------
    ndarray of float32, shape (row * column, view * light * 3)
    """
    views, lights, rows, columns, channels = values.shape
    table = values.reshape(views * lights, rows * columns, channels)
    result = np.zeros((rows * columns, views * lights, channels), np.float32)
    # Blocks of directions keep source and destination in cache.
    for start in range(0, len(table), 64):
        result[:, start : start + 64] = np.moveaxis(table[start : start + 64], 0, 1)
    return result.reshape(rows * columns, -1)


def range_basis(matrix, rank, rng, *, iterations=1):
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
    ndarray of float32, shape (rank, d)
        Rows sorted by decreasing energy.
    """
    n, d = matrix.shape
    rank = min(rank, n, d)
    width = min(rank + 8, n, d)
    sample = rng.standard_normal((width, n), dtype=np.float32) @ matrix
    for _ in range(iterations):
        # Orthonormalising on the short side between the products keeps float32 from losing small directions.
        left = np.linalg.qr(matrix @ np.linalg.qr(sample.T)[0])[0]
        sample = left.T @ matrix
    basis = np.linalg.qr(sample.T)[0]
    _, _, rotation = np.linalg.svd(matrix @ basis, full_matrices=False)
    return rotation[:rank] @ basis.T


def principal_rows(rows, rank):
    """Leading right singular vectors of a small set of long rows, through the smaller Gram matrix.

    Parameters
    ----------
    rows : ndarray, shape (n, d)
    rank : int

    Returns
    -------
    ndarray of float32, shape (rank, d)
        Orthonormal; zero rows where ``rows`` has a lower rank.
    """
    n, d = rows.shape
    result = np.zeros((rank, d), np.float32)
    if n <= d:
        gram = (rows @ rows.T).astype(np.float64)
        value, vector = np.linalg.eigh(gram)
        value, vector = value[::-1][:rank], vector[:, ::-1][:, :rank]
        # Relative to the largest, float32 products carry nothing below this.
        keep = value > max(value[0], 0) * 1e-6 if len(value) else value > 0
        basis = vector[:, keep].T.astype(np.float32) @ rows
        result[: len(basis)] = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    else:
        value, vector = np.linalg.eigh((rows.T @ rows).astype(np.float64))
        value, vector = value[::-1][:rank], vector[:, ::-1][:, :rank]
        keep = value > max(value[0], 0) * 1e-6
        result[: keep.sum()] = vector[:, keep].T
    return result
