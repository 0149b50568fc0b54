"""Directions chosen for a surface: rings whose angles and counts make interpolation between them least wrong.

A coarse table of the surface at many candidates stands for it. The error of a choice is that of the pictures of all
candidates, interpolated between the chosen directions, as views and as lights together, each times the solid angle that
the candidate stands for. From even rings on, a greedy search moves rings and hands directions from one to another as
long as that error falls. Rings are interpolated between four directions, scattered sets between three: a free choice of
directions was no better. Only inner products of pictures are needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.directions import DirectionSet, directions, ring_directions

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.types import PathLike, Progress

#: Polar angle in degrees and number of directions of each ring.
Rings = tuple[tuple[float, int], ...]

#: Polar angles of the candidates' rings and their spacing along a ring, degrees.
RINGS = tuple(np.arange(7.5, 83, 7.5))
SPACING = 7.5

#: Azimuths of candidates on a ring: a multiple of this.
FIRST = 8

#: Polar angle of the outermost ring that a search begins with, and bounds of a ring's angle and of the distance of two.
OUTER, LARGEST, APART = 75.0, 84.0, 4.0

#: Steps of an angle, degrees, from coarse to fine; layouts that are tried from one start at most.
STEPS, MOST = (4.0, 2.0, 1.0), 150

#: Fewest directions of a ring beside the pole, and fewest of a choice.
LEAST, FEWEST = 3, 9

#: Of the coarse table.
TEXELS, SPP = 4, 16

#: Of the display whose light is compared.
GAMMA = 2.4

#: Name of such a set on a command line: ``adaptive:N``.
ADAPTIVE = "adaptive"


def candidates() -> DirectionSet:
    """What is chosen from: the pole and rings of even spacing."""
    rings = [(0.0, 1, 0.0)]
    for theta in RINGS:
        count = FIRST * max(1, round(360 * np.sin(np.radians(theta)) / SPACING / FIRST))
        rings.append((float(theta), count, 0.0))
    return directions(ring_directions(rings))


def chosen_directions(
    mesostructure: PathLike | Mesostructure,
    n: int,
    *,
    seed: int = 0,
    max_depth: int = 8,
    variant: str = "llvm_ad_rgb",
    progress: Progress | None = None,
    **parameters: Any,
) -> DirectionSet:
    """Choose directions for the views and lights of a surface.

    Parameters
    ----------
    mesostructure : str, path-like or Mesostructure
    n : int
        Directions.
    seed, max_depth, variant
        Of the coarse table, as of `btfref.synthesize`.
    progress : callable, optional
    **parameters
        Of the mesostructure.

    Returns
    -------
    DirectionSet
        The same for the same seed: rings, from the pole on.

    Raises
    ------
    InputError
        More directions than there are candidates, or too few to span the hemisphere.
    """
    from btfref.sampling.synthesis import synthesize

    given = candidates()
    if not FEWEST <= n <= len(given):
        raise InputError("directions to choose", field="n", got=n, expected=f"{FEWEST} to {len(given)}")
    btf = synthesize(
        mesostructure,
        texels=TEXELS,
        views=given,
        lights=given,
        spp=SPP,
        seed=seed,
        max_depth=max_depth,
        variant=variant,
        estimator="surface",
        variance=False,
        progress=progress,
        **parameters,
    )
    # As a display shows them: of squared radiances a few highlights would be all that counts.
    shown = np.clip(np.pi * btf.values.astype(np.float64), 0, 1) ** (1 / GAMMA)
    values = shown.reshape(len(given), len(given), -1)
    with reproducible():
        weight = given.quadrature_weights
        gram = sum(
            np.tensordot(a * weight[None, :, None], a, ([1, 2], [1, 2]))
            for a in (values, values.swapaxes(0, 1))
        )
        return directions(vectors_of(choose(given, np.asarray(gram), n)))


def choose(given: DirectionSet, gram: np.ndarray, n: int) -> Rings:
    """Rings of the choice.

    Parameters
    ----------
    given : DirectionSet
        Candidates.
    gram : ndarray (m, m)
        Inner products of what belongs to each candidate.
    n : int
        Directions.

    Returns
    -------
    tuple of (float, int)
        Polar angle in degrees and number of directions of each ring, the pole first.
    """
    spacing = np.degrees(np.sqrt(2 * np.pi / n))
    usual = min(1 + round(OUTER / spacing), 1 + (n - 1) // (LEAST + 1))
    starts = [_even(n, count) for count in range(max(3, usual - 1), max(3, usual + 1) + 1)]
    return min((_improved(given, gram, start) for start in starts), key=lambda found: found[0])[1]


def vectors_of(rings: Rings) -> np.ndarray:
    """Directions of rings, (n, 3)."""
    return ring_directions([(theta, count, 0.0) for theta, count in rings])


def error_of(given: DirectionSet, gram: np.ndarray, vectors: np.ndarray) -> float:
    """Squared error of the candidates' pictures, interpolated between directions whose own pictures lie between them.

    Parameters
    ----------
    given : DirectionSet
    gram : ndarray (m, m)
    vectors : ndarray (n, 3)
    """
    known = _shares(given, vectors)
    left = np.eye(len(given)) - _shares(directions(vectors), given.vectors) @ known
    return float(given.quadrature_weights @ np.einsum("jk,jk->j", left @ gram, left))


def _shares(among: DirectionSet, w: np.ndarray) -> np.ndarray:
    """Weights of the directions of a set in the interpolation at others, (len(w), len(among))."""
    index, share = among.stencil(w)
    found = np.zeros((len(w), len(among)))
    np.add.at(found, (np.arange(len(w))[:, None], index), share)
    return found


def _even(n: int, count: int) -> Rings:
    """So many rings of even spacing, and n directions on them."""
    theta = OUTER * np.arange(1, count) / (count - 1)
    share = np.sin(np.radians(theta))
    on = np.maximum(LEAST, np.round((n - 1) * share / share.sum())).astype(int)
    on[-1] += n - 1 - on.sum()
    while on[-1] < LEAST:
        on[on.argmax()] -= 1
        on[-1] += 1
    return ((0.0, 1), *((float(t), int(k)) for t, k in zip(theta, on, strict=True)))


def _improved(given: DirectionSet, gram: np.ndarray, rings: Rings) -> tuple[float, Rings]:
    """The error of rings after the search, and what they have become."""
    error, tried = error_of(given, gram, vectors_of(rings)), 0
    for step in STEPS:
        moved = True
        while moved and tried < MOST:
            moved = False
            for other in _neighbours(rings, step):
                tried += 1
                found = error_of(given, gram, vectors_of(other))
                if found < error:
                    error, rings, moved = found, other, True
                    break
    return error, rings


def _neighbours(rings: Rings, step: float) -> Iterator[Rings]:
    """Rings with one of them moved by a step, or with a direction handed from one to another."""
    for r in range(1, len(rings)):
        theta, count = rings[r]
        for moved in (theta + step, theta - step):
            made = (*rings[:r], (moved, count), *rings[r + 1 :])
            angles = [angle for angle, _ in made]
            if angles[-1] <= LARGEST and min(np.diff(angles)) >= APART:
                yield made
        for q in range(1, len(rings)):
            if q != r and rings[q][1] > LEAST:
                change = {r: 1, q: -1}
                yield tuple((angle, k + change.get(i, 0)) for i, (angle, k) in enumerate(rings))
