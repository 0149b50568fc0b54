"""Materials: texels whose distributions are alike but for a turn about the normal.

Source: Menzel and Guthe 2009, section 5.3; relaxation labelling after A. Rosenfeld, R. Hummel, S. Zucker, "Scene
Labeling by Relaxation Operations", 1976, in the form the paper uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.numerics.sphere.parabolic import bilinear_stencil

#: Polar and azimuthal samples over which distributions are compared.
N_THETA, N_PHI = 8, 32

#: Iterations of k-means and of relaxation.
_ITERATIONS, _RELAXATIONS = 12, 10

#: Tangents of a material are left alone when turning them leaves more than this share of the squared distances, or when
#: distributions of norm 1 differ by less than the second number (RMS) without any turn: what is left is noise.
_ISOTROPIC, _SAME = 0.5, 0.15

#: RMS distance to a common centre, of distributions of norm 1, below which all texels are one material. The separation
#: index cannot tell: noise in one dimension, cut in two, has an index of 0.3.
_ALIKE = 0.25


@dataclass(frozen=True)
class Clustering:
    """Materials of n texels.

    Attributes
    ----------
    labels : ndarray of int, shape (n,)
    rotation : ndarray, shape (n,)
        Turns from a texel's frame to its material's.
    centres : ndarray, shape (k, N_THETA, N_PHI)
    separation : float
        RMS distance to the centres over the smallest distance between two; infinite for one material.
    rms : float
        RMS distance to the centres.
    """

    labels: np.ndarray
    rotation: np.ndarray
    centres: np.ndarray
    separation: float
    rms: float


def spherical_features(ndf: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Distributions over (θ, φ), of unit length, weighted by the solid angles of the grid.

    Parameters
    ----------
    ndf : ndarray, shape (n, s, s)
        Parabolic tables.
    weight : ndarray, shape (n,), optional
        Factor of each.

    Returns
    -------
    ndarray of float32, shape (n, N_THETA, N_PHI)
    """
    edges = np.linspace(0, np.pi / 2, N_THETA + 1)
    theta = 0.5 * (edges[1:] + edges[:-1])
    phi = (np.arange(N_PHI) + 0.5) * (2 * np.pi / N_PHI)
    t, f = np.meshgrid(theta, phi, indexing="ij")
    w = np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], -1)
    index, share = bilinear_stencil(w, ndf.shape[-1])
    values = np.einsum("nijk,ijk->nij", ndf.reshape(len(ndf), -1)[:, index], share, optimize=True)
    values = values * np.sqrt(np.cos(edges[:-1]) - np.cos(edges[1:]))[:, None]
    length = np.sqrt((values**2).sum((1, 2), keepdims=True))
    values = values / np.where(length > 0, length, 1)
    if weight is not None:
        values = values * weight[:, None, None]
    return values.astype(np.float32)


def alignment(features: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances of features to centres at the best turn, and that turn.

    By the Fourier shift theorem: the turn is where the cross-correlation over φ, summed over θ, is largest.

    Returns
    -------
    distance : ndarray, shape (n, k)
    shift : ndarray of int, shape (n, k)
        ``feature(φ) ≈ centre(φ − shift)`` in steps of 2π / N_PHI.
    """
    power = (features**2).sum((1, 2))[:, None] + (centres**2).sum((1, 2))[None]
    spectrum = np.fft.rfft(features)
    best, shift = [], []
    for centre in np.fft.rfft(centres):
        correlation = np.fft.irfft((spectrum * np.conj(centre)).sum(1), N_PHI)
        shift.append(correlation.argmax(1))
        best.append(correlation.max(1))
    return np.maximum(power - 2 * np.stack(best, 1), 0), np.stack(shift, 1)


def turned(features: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """``feature(φ + shift)``: features turned back to their centre's frame."""
    index = (np.arange(N_PHI)[None] + shift[:, None]) % N_PHI
    return np.take_along_axis(features, index[:, None, :], 2)


def k_means(features: np.ndarray, count: int, rng: np.random.Generator) -> Clustering:
    """Lloyd's algorithm with aligned distances; centres are means of aligned members.

    Returns
    -------
    Clustering
    """
    centres = features[rng.integers(len(features))][None]
    while len(centres) < count:
        # k-means++: the next one with a chance in proportion to the squared distance.
        distance = alignment(features, centres)[0].min(1).astype(float)
        total = distance.sum()
        chance = distance / total if total > 0 else np.full(len(features), 1 / len(features))
        centres = np.concatenate([centres, features[rng.choice(len(features), p=chance)][None]])
    labels = np.zeros(len(features), int)
    for turn in range(_ITERATIONS):
        distance, shift = alignment(features, centres)
        new = distance.argmin(1)
        if turn and (new == labels).all():
            break
        labels = new
        aligned = turned(features, shift[np.arange(len(labels)), labels])
        centres = np.stack(
            [aligned[labels == k].mean(0) if (labels == k).any() else centres[k] for k in range(count)]
        )
    distance, shift = alignment(features, centres)
    labels = distance.argmin(1)
    own = distance[np.arange(len(labels)), labels]
    separation = np.inf
    if count > 1:
        apart = alignment(centres, centres)[0] + np.diag(np.full(count, np.inf))
        separation = float(np.sqrt(own.mean()) / max(np.sqrt(apart.min()), 1e-12))
    rotation = shift[np.arange(len(labels)), labels] / N_PHI
    return Clustering(labels, rotation, centres, separation, float(np.sqrt(own.mean())))


def relaxed_labels(features: np.ndarray, centres: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Labels whose borders are smoothed: probabilities 1 / distance, drawn towards those of the neighbours.

    Parameters
    ----------
    features : ndarray, shape (n, N_THETA, N_PHI)
    centres : ndarray, shape (k, N_THETA, N_PHI)
    shape : tuple of int
        Rows and columns of the periodic tile.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    distance = np.sqrt(alignment(features, centres)[0])
    p = 1 / np.maximum(distance, 1e-6)
    p = (p / p.sum(1, keepdims=True)).reshape(*shape, -1)
    for _ in range(_RELAXATIONS):
        around = sum(np.roll(p, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0))
        p = p * around
        p = p / np.maximum(p.sum(-1, keepdims=True), 1e-30)
    return p.reshape(len(features), -1).argmax(1)


def cluster_materials(
    ndf: np.ndarray,
    shape: tuple[int, ...],
    *,
    weight: np.ndarray | None = None,
    largest: int = 6,
    count: int | None = None,
    seed: int = 0,
) -> tuple[Clustering, dict[int, float]]:
    """Materials of the texels' distributions.

    Parameters
    ----------
    ndf : ndarray, shape (n, s, s)
    shape : tuple of int
        Rows and columns, n of them.
    weight : ndarray, shape (n,), optional
        How much each distribution counts, in [0, 1].
    largest : int
        Most materials that are tried.
    count : int, optional
        That many instead of the number of the smallest separation index.
    seed : int

    Returns
    -------
    clustering : Clustering
        Labels relaxed, empty materials dropped; rotation 0 in isotropic materials.
    indices : dict of int to float
        Separation index of each number tried. One material is taken when no number brings it below 1, or when all
        texels are alike anyway.
    """
    features = spherical_features(ndf, weight)
    rng = np.random.default_rng(seed)
    tried = {}
    numbers = [count] if count else range(1, min(largest, len(features)) + 1)
    for number in numbers:
        found = [k_means(features, min(number, len(features)), rng) for _ in range(1 if number == 1 else 3)]
        tried[number] = min(found, key=lambda c: c.separation)
    indices = {number: c.separation for number, c in tried.items()}
    best = min(indices, key=lambda number: indices[number])
    if not count and (tried[1].rms < _ALIKE or not indices[best] < 1):
        best = 1
    centres = tried[best].centres
    labels = relaxed_labels(features, centres, shape)
    kept, labels = np.unique(labels, return_inverse=True)
    centres = centres[kept]
    distance, shift = alignment(features, centres)
    rows = np.arange(len(labels))
    rotation = shift[rows, labels] / N_PHI
    for k in range(len(centres)):
        members = labels == k
        plain = ((features[members] - features[members].mean(0)) ** 2).sum((1, 2)).mean()
        if distance[members, k].mean() > _ISOTROPIC * plain or plain < _SAME**2:
            rotation[members] = 0
    labels = labels.reshape(-1)
    return Clustering(labels, rotation, centres, indices[best], tried[best].rms), indices
