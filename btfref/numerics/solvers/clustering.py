"""Clustering of vectors by reconstruction error (local PCA)."""

from __future__ import annotations

import numpy as np

from btfref.numerics.solvers.threads import one_blas_thread

#: The iteration stops when the total error falls by less than this share.
RELATIVE_PROGRESS = 1e-4
MAXIMUM_ITERATIONS = 60
LLOYD_ITERATIONS = 8


def spread_seeds(points: np.ndarray, n_clusters: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of initial centres by k-means++ (Arthur and Vassilvitskii 2007)."""
    chosen = [int(rng.integers(len(points)))]
    squared = (points**2).sum(1)
    distance = _distance(points, squared, chosen[0])
    for _ in range(n_clusters - 1):
        total = distance.sum()
        # All remaining points coincide with a centre: any choice is as good, the first keeps it deterministic.
        following = int(np.searchsorted(np.cumsum(distance), rng.random() * total)) if total > 0 else 0
        following = min(following, len(points) - 1)
        chosen.append(following)
        distance = np.minimum(distance, _distance(points, squared, following))
    return np.array(chosen)


def _distance(points: np.ndarray, squared: np.ndarray, i: int) -> np.ndarray:
    return np.maximum(squared - 2 * points @ points[i] + squared[i], 0)


def assign_nearest(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Index of the nearest centre of each point; ties go to the lowest index."""
    return np.argmin((centres**2).sum(1) - 2 * points @ centres.T, 1)


def lloyd(
    points: np.ndarray, n_clusters: int, rng: np.random.Generator, *, iterations: int = LLOYD_ITERATIONS
) -> tuple[np.ndarray, np.ndarray]:
    """A few iterations of k-means from k-means++ seeds.

    Parameters
    ----------
    points : ndarray, shape (n, d)
    n_clusters : int
        At most n.
    rng : numpy.random.Generator
    iterations : int

    Returns
    -------
    labels : ndarray of int64, shape (n,)
    centres : ndarray, shape (n_clusters, d)
    """
    centres = points[spread_seeds(points, n_clusters, rng)]
    for _ in range(iterations):
        labels = assign_nearest(points, centres)
        member = np.zeros((n_clusters, len(points)), points.dtype)
        member[labels, np.arange(len(points))] = 1
        count = member.sum(1, keepdims=True)
        # An abandoned centre stays where it is.
        centres = np.where(count > 0, member @ points / np.maximum(count, 1), centres)
    return assign_nearest(points, centres), centres


def local_pca(
    points: np.ndarray, n_clusters: int, n_components: int, rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    """Partition points such that each cluster's affine subspace reconstructs its members best.

    Alternates assignment to the cluster whose mean and leading components leave the smallest squared error with the
    PCA of each cluster (Kambhatla and Leen 1997), from k-means centres. Deterministic given ``rng``: ties go to the
    lowest index, an empty cluster takes over the worst reconstructed point.

    Parameters
    ----------
    points : ndarray of float64, shape (n, r)
    n_clusters, n_components : int
    rng : numpy.random.Generator

    Returns
    -------
    labels : ndarray of int64, shape (n,)
    iterations : int
    """
    with one_blas_thread():
        return _local_pca(points, n_clusters, n_components, rng)


def _local_pca(
    points: np.ndarray, n_clusters: int, n_components: int, rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    n, dimension = points.shape
    n_used = min(n_clusters, n)
    rank = min(n_components, dimension)
    labels, _ = lloyd(points, n_used, rng)
    best, best_error, previous = labels, np.inf, np.inf
    iteration = 0
    for iteration in range(1, MAXIMUM_ITERATIONS + 1):  # noqa: B007
        error = reconstruction_errors(points, labels, n_used, rank)
        current = error[np.arange(n), labels]
        total = current.sum()
        if total < best_error:
            best, best_error = labels, total
        if previous - total <= RELATIVE_PROGRESS * previous and np.isfinite(previous):
            break
        previous = total
        labels = np.argmin(error, 1)
        empty = np.setdiff1d(np.arange(n_used), labels)
        if len(empty):
            worst = np.argsort(-error[np.arange(n), labels], kind="stable")[: len(empty)]
            labels[worst] = empty
    return best, iteration


def leading_axes(points: np.ndarray, rank: int) -> np.ndarray:
    """Leading principal directions about the mean, shape (n, r) -> (min(rank, r), r); zero rows without variance."""
    centred = points - points.mean(0)
    value, vector = np.linalg.eigh(centred.T @ centred)
    axes = vector[:, ::-1][:, :rank]
    # Directions without variance are no axes: a single member must not span anything.
    return (axes * (value[::-1][: axes.shape[1]] > 1e-12 * max(value[-1], 1e-300))).T


def reconstruction_errors(points: np.ndarray, labels: np.ndarray, n_clusters: int, rank: int) -> np.ndarray:
    """Squared error of every point in every cluster's affine subspace, shape (n, n_clusters)."""
    n = len(points)
    squared = (points**2).sum(1)
    error = np.full((n, n_clusters), np.inf)
    for k in range(n_clusters):
        members = points[labels == k]
        if not len(members):
            continue
        mean = members.mean(0)
        axes = leading_axes(members, rank).T
        projection = points @ axes - mean @ axes
        error[:, k] = squared - 2 * points @ mean + mean @ mean - (projection**2).sum(1)
    return np.maximum(error, 0)
