"""Low-rank approximation of matrices that are read by blocks of columns, in as few passes as it takes.

Source: N. Halko, P. Martinsson, J. Tropp, "Finding Structure with Randomness", SIAM Review 2011, section 4.5, with both
products of a power iteration in one pass: for a block A_b of columns, ``A_bᵀ P`` is a part of ``Aᵀ P``, and the sum of
``A_b (A_bᵀ P)`` over the blocks is ``A Aᵀ P``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from btfref.numerics.solvers.threads import one_blas_thread, product

#: Columns of a subspace beyond the rank that is wanted: so many make two passes as good as three with eight.
OVERSAMPLING = 24

#: Rows of a block that a thread multiplies at a time: a block has a few hundred.
ROWS = 64

#: Singular values below this share of the largest are what float32 products leave of zero.
NOISE = 1e-6


S = TypeVar("S")
R = TypeVar("R")


class Columns(Protocol):
    """A matrix that is read by blocks of columns, always the same blocks in the same order."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows n and columns d."""

    def over(self, work: Callable[[S, slice, np.ndarray], R], shared: S) -> Iterator[tuple[slice, R]]:
        """Which columns, and what is made of them, block by block; other processes may make it.

        Parameters
        ----------
        work : callable
            ``(shared, columns, block) -> result``, a function of a module; the block is the columns' transpose,
            float32, shape (columns of the block, n), contiguous, for one use.
        shared : object
            The same for all blocks; nothing may change it.
        """


@dataclass(frozen=True)
class Leading:
    """The leading principal directions of a matrix (about zero).

    Attributes
    ----------
    basis : ndarray of float32, shape (rank, d)
        Orthonormal rows by decreasing energy.
    coordinates : ndarray of float32, shape (n, rank)
        The matrix times the transpose of the basis.
    squares : ndarray of float64, shape (n,)
        Squared lengths of the matrix's rows.
    """

    basis: np.ndarray
    coordinates: np.ndarray
    squares: np.ndarray


class GramPass:
    """What one pass over the columns of a matrix A adds up for a basis P: ``Aᵀ P`` and ``A Aᵀ P``.

    Parameters
    ----------
    basis : ndarray of float32, shape (n, w)
    d : int
        Columns of the matrix.
    """

    def __init__(self, basis: np.ndarray, d: int) -> None:
        self.basis = np.ascontiguousarray(basis, np.float32)
        #: ``Aᵀ P``, (d, w) float32, and ``A Aᵀ P``, (n, w) float64.
        self.image = np.zeros((d, basis.shape[1]), np.float32)
        self.sums = np.zeros(basis.shape)

    def add(self, part: slice, image: np.ndarray, sums: np.ndarray) -> None:
        """Take what :func:`gram_products` makes of a block of columns."""
        self.image[part] = image
        self.sums += sums

    def next_basis(self) -> np.ndarray:
        """Orthonormal columns that span ``A Aᵀ P``, by decreasing energy: their products lose least to rounding."""
        with one_blas_thread():
            q, r = np.linalg.qr(self.sums)
            return (q @ np.linalg.svd(r)[0]).astype(np.float32)

    def leading(self, rank: int) -> tuple[np.ndarray, np.ndarray]:
        """The leading directions of the rows of A within the span of ``Aᵀ P``, and the coordinates along them.

        Parameters
        ----------
        rank : int

        Returns
        -------
        basis : ndarray of float32, shape (rank, d)
        coordinates : ndarray of float32, shape (n, rank)
            Zero along directions that carry no more than rounding.
        """
        with one_blas_thread():
            q, r = np.linalg.qr(self.image.astype(float))
            u, singular, vt = np.linalg.svd(r)
        kept = (
            singular > NOISE * max(singular[0], np.finfo(np.float32).tiny) if len(singular) else singular > 0
        )
        inverse = np.where(kept, 1 / np.where(kept, singular, 1), 0)[:rank]
        coordinates = product(self.sums, vt.T[:, :rank] * inverse)
        return product(u.T[:rank].copy(), q.T).astype(np.float32), coordinates.astype(np.float32)


def gram_products(basis: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a block of columns of A, given as its transpose, adds to ``Aᵀ P`` and to ``A Aᵀ P``.

    Parameters
    ----------
    basis : ndarray of float32, shape (n, w)
        P, contiguous.
    block : ndarray of float32, shape (columns of the block, n)

    Returns
    -------
    image : ndarray of float32, shape (columns of the block, w)
    sums : ndarray of float32, shape (n, w)
    """
    image = product(block, basis, rows=ROWS)
    return image, product(block.T, image)


def leading(matrix: Columns, rank: int, rng: np.random.Generator, *, passes: int) -> Leading:
    """The leading principal directions of a matrix, by randomized subspace iteration.

    Parameters
    ----------
    matrix : Columns
    rank : int
        At most min(n, d) are found.
    rng : numpy.random.Generator
    passes : int
        At least 1: how often the matrix is read. With q of them the basis spans what ``(Aᵀ A)^(q − 1) Aᵀ Ω`` does.

    Returns
    -------
    Leading
    """
    n, d = matrix.shape
    rank = min(rank, n, d)
    basis = rng.standard_normal((n, min(rank + OVERSAMPLING, n, d)), dtype=np.float32)
    squares = np.zeros(n)
    for index in range(passes):
        step = GramPass(basis, d)
        for part, (image, sums, own) in matrix.over(_block_products, (step.basis, index == 0)):
            step.add(part, image, sums)
            if own is not None:
                squares += own
        if index < passes - 1:
            basis = step.next_basis()
    return Leading(*step.leading(rank), squares)


def _block_products(
    shared: tuple[np.ndarray, bool], part: slice, block: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """:func:`gram_products`, and where they are asked for the squared lengths of the rows of A within the block."""
    basis, with_squares = shared
    return *gram_products(basis, block), np.einsum("ij,ij->j", block, block) if with_squares else None


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the same space."""
    with one_blas_thread():
        return np.linalg.qr(columns)[0]


def principal(columns: np.ndarray, projected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The principal directions of rows within a span, from the rows' products with it.

    Parameters
    ----------
    columns : ndarray, shape (d, w)
        Orthonormal; the span.
    projected : ndarray of float64, shape (n, w)
        Rows times these columns.

    Returns
    -------
    basis : ndarray of float32, shape (w, d)
        By decreasing energy; zero where there is no more than rounding.
    coordinates : ndarray of float64, shape (n, w)
    """
    with one_blas_thread():
        _, vectors = np.linalg.eigh(projected.T @ projected)
        vectors = vectors[:, ::-1]
        coordinates = projected @ vectors
        energy = (coordinates**2).sum(0)
        # Relative to the largest, float32 products carry nothing below this.
        kept = energy > 1e-7 * energy.max(initial=0)
        basis = vectors.T.astype(np.float32) @ columns.T
    return basis * kept[:, None], coordinates * kept


def array_columns(matrix: np.ndarray, width: int) -> Columns:
    """An array as :class:`Columns`, blocks of ``width`` columns."""
    return _ArrayColumns(matrix, width)


@dataclass(frozen=True)
class _ArrayColumns:
    matrix: np.ndarray
    width: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape[0], self.matrix.shape[1]

    def over(self, work: Callable[[S, slice, np.ndarray], R], shared: S) -> Iterator[tuple[slice, R]]:
        for start in range(0, self.matrix.shape[1], self.width):
            part = slice(start, min(start + self.width, self.matrix.shape[1]))
            yield part, work(shared, part, np.ascontiguousarray(self.matrix[:, part].T, np.float32))
