"""Lookups with known answers for renderers that are not ours, and the port package that holds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance, tolerance_of
from btfref.outputs import refuse_existing, require_folder_of
from btfref.rendering.gl.probe import broadcast_points
from btfref.rendering.ports.answers import KnownAnswers
from btfref.rendering.ports.folder import write_folder
from btfref.rendering.ports.package import port_package
from btfref.stress.judging import rounded_range
from btfref.stress.lookups import USUAL, hard_lookups

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike, Progress

#: Lookups of a package.
N_PROBES = 1000

#: One in so many has a direction below the horizon: the answer is exactly 0.
BELOW = 50

#: Rounded arguments at which an answer must be the same to be one, and rounds of drawing after which none are found.
NEIGHBOURS, ROUNDS = 24, 20


def known_answers(
    representation: Representation, n: int = N_PROBES, *, seed: int = 0, progress: Progress | None = None
) -> KnownAnswers:
    """Lookups at the hard places of a representation, and what its definition says.

    Where a value jumps (a silhouette, a border of a shadow or of a texel), a rounded argument may lie on either side:
    no answer is known there, and such lookups are left out.

    Parameters
    ----------
    representation : Representation
    n : int
    seed : int
    progress : callable, optional

    Returns
    -------
    btfref.rendering.ports.answers.KnownAnswers

    Raises
    ------
    InputError
        For a representation that jumps nearly everywhere.
    """
    rng = np.random.default_rng(seed)
    found_rows, found_values, count = [], [], 0
    for _ in range(ROUNDS):
        if count >= n:
            break
        if progress is not None:
            progress(count, n, "known answers")
        lookups = hard_lookups(rng, representation, n, USUAL)
        lookups.w_light[::BELOW, 2] *= -1
        lookups.w_view[BELOW // 2 :: BELOW, 2] *= -1
        low, high = rounded_range(
            representation,
            lookups.points,
            tolerance("stress.ports.argument_ulps"),
            lod=lookups.lod,
            neighbours=NEIGHBOURS,
        )
        values = representation.evaluate(*lookups.points, lod=lookups.lod)
        kept = _steady(representation.meta["method"], low, high, values)
        rows, _ = broadcast_points(*lookups.points, lookups.lod)
        found_rows.append(rows[kept])
        found_values.append(values[kept])
        count += int(kept.sum())
    if count < n:
        raise InputError("no known answers: the values jump nearly everywhere", got=f"{count} of {n}")
    if progress is not None:
        progress(n, n, "known answers")
    method = representation.meta["method"]
    return KnownAnswers(method, np.concatenate(found_rows)[:n], np.concatenate(found_values)[:n])


def _steady(method: str, low: np.ndarray, high: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Where rounded arguments move the answer by less than the mean of what a port may be off, shape (n,)."""
    size = np.abs(values).max(-1)
    scale = np.maximum(size, tolerance_of(method, "probe.agreement.floor") * size.max(initial=0.0))
    return ((high - low).max(-1) <= tolerance_of(method, "probe.agreement.max") * scale).astype(bool)


def export_port(
    path: PathLike,
    out: PathLike,
    *,
    n: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Facts:
    """Write the port package of a representation, with known answers, into a new folder.

    Parameters
    ----------
    path : path-like
        Representation.
    out : path-like
        Folder to make.
    n : int, optional
        Known answers; default :data:`N_PROBES`.
    seed : int
        Of their lookups.
    progress : callable, optional

    Returns
    -------
    dict
        See :func:`btfref.rendering.ports.folder.write_folder`.

    Raises
    ------
    InputError
        No representation, one that a port cannot hold, or an existing path.
    """
    from btfref.representations.file.container import load

    refuse_existing(out)
    require_folder_of(out)
    representation = load(path)
    package = port_package(representation)
    answers = known_answers(representation, N_PROBES if n is None else n, seed=seed, progress=progress)
    return write_folder(package, answers, out)
