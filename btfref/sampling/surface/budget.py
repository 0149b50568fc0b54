"""What the shared estimator holds: blocks of views and lights that fit into a budget of memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.sampling.surface.estimator import GATHER_BUFFER, SurfaceEstimator, walks

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure

#: Bytes of the estimator's buffers, whatever the size of the BTF.
BASE = 160 << 20

#: Bytes per point, and per point and direction: geometry; bins and the visibility of small triangles.
PER_POINT, PER_POINT_DIRECTION = 450, 16

#: Bytes per record (point or view ray) and light: the table of light and visibility.
PER_RECORD_LIGHT = 16

#: Bytes per view ray: geometry, random stream; the visibility of all directions comes on top.
PER_RAY = 260

#: Bytes per first hit of a walk: geometry, what is carried, where it goes; the visibility comes on top, and while hits
#: are joined the largest of these parts is held twice.
PER_HIT, JOINED = 140, 1.4

#: Results that are made together, in sizes of the means of one group of views: means and variances of the points, of
#: both halves of the walks and of photons, what waits to be written, what was written last.
RESULTS = 14

#: Smallest group of results worth having, bytes.
LEAST_RESULTS = 4 << 20

#: Numbers that Dr.Jit can count with: of visibilities of hits, and of entries of the table.
COUNTABLE = 1 << 32

#: Texels of the small copy that tells shares, per side. Hits do not depend on the size of texels (0.123, 0.122 and
#: 0.122 at 16², 32² and 64² on the checker with 10 points, 0.336, 0.344 and 0.345 on the rings with 25); halves of
#: finer texels are emptier (0.11, 0.15, 0.18 and, at 128², 0.19 rays on the checker; 0.028, 0.050, 0.065 and 0.089 on
#: the tissue with 18).
COPY, HITS_MARGIN, RAYS_MARGIN, MORE_RAYS = 32, 1.1, 1.6, 0.05


@dataclass(frozen=True)
class Shares:
    """What differs from surface to surface.

    Attributes
    ----------
    rays : float
        View rays per texel and direction, at most four.
    hits : float
        Share of the walks from texels that hit the surface again.
    """

    rays: float = 4.0
    hits: float = 1.0


def shares(
    mesostructure: Mesostructure, views: np.ndarray, lights: np.ndarray, *, spp: int, max_depth: int
) -> Shares:
    """Shares that a small copy of a synthesis finds, with a margin.

    Parameters
    ----------
    mesostructure : Mesostructure
    views, lights : ndarray (n, 3)
        All of the BTF.
    spp : int
        Points per texel.
    max_depth : int

    Returns
    -------
    Shares

    Notes
    -----
    Use it inside one `mitsuba_variant` block.
    """
    copy = SurfaceEstimator(
        mesostructure, lights, views=views, texels=(COPY, COPY), spp=spp, seed=0, max_depth=max_depth,
        variance=False,
    )  # fmt: skip
    rays, hits = copy.counts()
    return Shares(min(4.0, RAYS_MARGIN * rays + MORE_RAYS), min(1.0, HITS_MARGIN * hits))


def largest(
    free: int,
    *,
    n_views: int,
    n_lights: int,
    n_directions: int,
    texels: int,
    spp: int,
    split_lights: bool,
    found: Shares,
) -> tuple[int, int, int] | int:
    """Blocks of views and lights that take the least time of those that fit.

    Parameters
    ----------
    free : int
        Bytes.
    n_views, n_lights : int
    n_directions : int
        Of views and lights, each once.
    texels, spp : int
        Texels of the tile and points of each.
    split_lights : bool
        Whether lights may be made in several goes; where not, results of the views of a block are held until all are
        made.
    found : Shares

    Returns
    -------
    (int, int, int) or int
        Views, lights, and bytes of results that are made together; or the bytes that the smallest blocks need.
    """
    points, per_half = spp * texels, walks(spp)[1]
    rays, hits = found.rays * texels, found.hits * 2 * per_half * texels

    def need(views: int, lights: int) -> tuple[int, int, bool]:
        """Bytes without results, bytes of one view's results, and whether Dr.Jit can count it."""
        directions = min(n_directions, views + lights)
        records = points + rays * directions
        held: float = points * (PER_POINT + directions * PER_POINT_DIRECTION)
        held += rays * directions * (PER_RAY + directions) + records * lights * PER_RECORD_LIGHT
        held += JOINED * hits * directions * (PER_HIT + directions)
        one = 12 * texels * lights
        if not split_lights:
            held += 2 * one * views
        countable = max(hits * directions**2, 4 * records * lights) < COUNTABLE
        return int(held), one, countable

    def parts(n: int) -> list[int]:
        return sorted({-(-n // k) for k in range(1, n + 1)}, reverse=True)

    best: tuple[tuple[float, int], tuple[int, int, int]] | None = None
    for lights in parts(n_lights) if split_lights else [n_lights]:
        for views in parts(n_views):
            held, one, countable = need(views, lights)
            left = (free - held) // RESULTS
            if left < max(one, LEAST_RESULTS) or not countable:
                continue
            count = -(-n_views // views) * -(-n_lights // lights)
            # Visibility and walks go by directions; what goes by pairs is the same however they are parted.
            cost = float(count * min(n_directions, views + lights)), count
            if best is None or cost < best[0]:
                best = cost, (views, lights, int(min(max(left, one), GATHER_BUFFER)))
    if best is not None:
        return best[1]
    held, one, _ = need(1, 1 if split_lights else n_lights)
    return held + RESULTS * max(one, LEAST_RESULTS)
