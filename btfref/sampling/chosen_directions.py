"""Directions chosen for a surface: as many as are asked for, where interpolation between the others is wrong most.

A coarse table of the surface at many candidates stands for it. From a pole and a few directions near the horizon on,
the candidate whose pictures the ones chosen so far interpolate worst is added, as a view and as a light together, each
error times the solid angle that the candidate stands for. Only inner products of pictures are needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.directions import DirectionSet, directions, ring_directions

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.types import PathLike, Progress

#: Polar angles of the candidates' rings and their spacing along a ring, degrees.
RINGS = tuple(np.arange(7.5, 83, 7.5))
SPACING = 7.5

#: Directions of the outermost ring that every choice begins with, beside the pole.
FIRST = 8

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
        The same for the same seed; sorted by polar angle.

    Raises
    ------
    InputError
        More directions than there are candidates, or too few to span the hemisphere.
    """
    from btfref.sampling.synthesis import synthesize

    given = candidates()
    if not FIRST + 1 <= n <= len(given):
        raise InputError("directions to choose", field="n", got=n, expected=f"{FIRST + 1} to {len(given)}")
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
        picked = choose(given, np.asarray(gram), n)
    return directions(given.vectors[np.sort(picked)])


def choose(given: DirectionSet, gram: np.ndarray, n: int) -> np.ndarray:
    """Numbers of the candidates that are chosen, in the order of the choice.

    Parameters
    ----------
    given : DirectionSet
        Candidates: a pole first, rings after it, the last one outermost.
    gram : ndarray (m, m)
        Inner products of what belongs to each candidate.
    n : int
    """
    count = int(given.rings[-1, 2])  # type: ignore[index]  # rings they are
    outer = len(given) - count + np.arange(0, count, count // FIRST)[:FIRST]
    picked = [0, *map(int, outer)]
    weight = given.quadrature_weights
    while len(picked) < n:
        chosen = directions(given.vectors[picked])
        index, share = chosen.stencil(given.vectors)
        near = np.asarray(picked)[index]
        cross = np.einsum("mk,mk->m", share, gram[np.arange(len(given))[:, None], near])
        inner = np.einsum("mk,ml,mkl->m", share, share, gram[near[:, :, None], near[:, None]])
        error = weight * (np.diagonal(gram) - 2 * cross + inner)
        error[picked] = -np.inf
        picked.append(int(np.argmax(error)))
    return np.array(picked)
