"""Places on the periodic tile that keep apart."""

from __future__ import annotations

import numpy as np

#: Random places that compete for each new one.
_CANDIDATES = 24


def scattered(rng: np.random.Generator, count: int) -> np.ndarray:
    """Places that are far from each other: each is the best of several random ones (Mitchell 1991).

    Parameters
    ----------
    rng : numpy.random.Generator
    count : int

    Returns
    -------
    ndarray (count, 2)
        In [0, 1)².
    """
    tried = rng.random((count, _CANDIDATES, 2))
    places = np.zeros((count, 2))
    places[0] = tried[0, 0]
    for k in range(1, count):
        apart = wrapped(tried[k, :, None] - places[None, :k])
        places[k] = tried[k, (apart**2).sum(-1).min(1).argmax()]
    return places


def wrapped(difference: np.ndarray) -> np.ndarray:
    """A difference of places by the shortest way around the tile."""
    return (difference + 0.5) % 1 - 0.5


def distances(places: np.ndarray) -> np.ndarray:
    """Distances of all pairs, (n, n); those to oneself are to one's next copy, 1."""
    apart = np.sqrt((wrapped(places[:, None] - places[None]) ** 2).sum(-1))
    np.fill_diagonal(apart, 1.0)
    return apart


def disjoint_radii(places: np.ndarray, gap: float) -> np.ndarray:
    """Radii of discs that keep a gap between them, and between themselves and their own copies.

    Half the way to the nearest first; then each, in turn, as far as its neighbours leave room.

    Parameters
    ----------
    places : ndarray (n, 2)
    gap : float

    Returns
    -------
    ndarray (n,)
    """
    apart = distances(places)
    radii = 0.5 * (apart.min(1) - gap)
    for k in range(len(places)):
        room = apart[k] - radii - gap
        room[k] = 0.5 * (1 - gap)
        radii[k] = max(radii[k], room.min())
    return radii
