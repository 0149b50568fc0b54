"""How much of a BTF is made at once, so that a process stays within a budget of memory."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from btfref.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.sampling.surface.budget import Shares

#: Bytes of a process that holds nothing of the BTF yet: interpreter, Mitsuba, kernels, scene of a small tile.
BASE = 350 << 20

#: Bytes per value (view, light, texel, channel) of what is made together: mean and variance as they are made, those
#: that are being written, and the bytes of their files.
PER_VALUE = 28

#: Bytes of the surface estimator's results that wait to be written: about what it makes at a time, so that writing and
#: tracing go on side by side.
QUEUE = 128 << 20

#: Peak of a pass of paths in sizes of its sample buffer: the samples, their squares and what is summed.
BUFFERS = 4

#: Smallest and largest sample buffer worth having, bytes.
BUFFER_RANGE = (8 << 20, 96 << 20)

#: Bytes per vertex and face of the geometry: ours, Mitsuba's and the acceleration structure's.
PER_TRIANGLE = 400


@dataclass(frozen=True)
class Blocks:
    """What is made together.

    Attributes
    ----------
    buffer : int
        Bytes of the sample buffer of the path estimator, or of the results that the surface estimator makes together.
    views, lights : int
        Views and lights that the surface estimator makes together.
    queue : int
        Bytes that wait to be written; 0 for one part of any size.
    """

    buffer: int
    views: int
    lights: int
    queue: int = 0


#: Bytes of a process that converts or fits, before it holds anything: interpreter, NumPy, SciPy, Zarr, OpenEXR.
CONVERSION_BASE = 160 << 20


def beside_the_interpreter(budget: int | None) -> int:
    """What of a budget is left for a BTF that is converted or fitted.

    Parameters
    ----------
    budget : int or None
        Bytes of the whole process; by default half of the machine's memory.

    Returns
    -------
    int
        Bytes.

    Raises
    ------
    InputError
        Nothing worth having is left.
    """
    budget = default_budget() if budget is None else budget
    if budget < CONVERSION_BASE + (1 << 20):
        refuse(budget, CONVERSION_BASE + (1 << 20))
    return budget - CONVERSION_BASE


def default_budget() -> int:
    """Half of the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def peak() -> int:
    """Largest amount of memory (bytes) that this process ever had in use."""
    own = of_this_process("VmHWM")
    if own is not None:
        return own
    # What other systems offer, with a flaw: a child starts with what its parent had when it was forked.
    import resource
    import sys

    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def of_this_process(field: str) -> int | None:
    """What the system says of this process's memory.

    Parameters
    ----------
    field : str
        Of ``/proc/self/status``: "VmRSS", what it has in use now; "VmHWM", the most since it began or since the
        mark was reset.

    Returns
    -------
    int or None
        Bytes; None where the system does not tell.
    """
    try:
        lines = Path("/proc/self/status").read_text("ascii", "replace").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)


def blocks(
    budget: int,
    *,
    estimator: str,
    triangles: int,
    n_views: int,
    n_lights: int,
    texels: tuple[int, int],
    shard: tuple[int, ...],
    spp: int,
    n_directions: int | None = None,
    split_lights: bool = True,
    shares: Callable[[], Shares] | None = None,
) -> Blocks:
    """Largest blocks within a budget; they have no influence on any result.

    Parameters
    ----------
    budget : int
        Bytes of the whole process.
    estimator : str
        "path" or "surface".
    triangles : int
        Of the geometry.
    n_views, n_lights : int
        Views to be made and all lights.
    texels : tuple of int
        Rows and columns of the tile.
    shard : tuple of int
        Rows and columns of texels of one file of the store.
    spp : int
        Samples, or points, per texel.
    n_directions : int, optional
        Of views and lights together, each once; the sum of both when not given.
    split_lights : bool
        Whether lights may be made in several goes.
    shares : callable, optional
        What the surface estimator would meet, found out at some cost: only asked where the most that any surface may
        need does not fit in one block.

    Returns
    -------
    Blocks

    Raises
    ------
    InputError
        Even the smallest blocks need more.
    """
    free = budget - BASE - triangles * PER_TRIANGLE
    if estimator == "path":
        values = 3 * n_lights * min(shard[0], texels[0]) * min(shard[1], texels[1])
        buffer = (free - values * PER_VALUE) // BUFFERS
        if buffer < BUFFER_RANGE[0]:
            refuse(budget, budget - free + values * PER_VALUE + BUFFERS * BUFFER_RANGE[0])
        return Blocks(min(buffer, BUFFER_RANGE[1]), 1, n_lights)
    from btfref.sampling.surface import budget as surface

    # Means and variances of the whole BTF may be less than what may wait.
    queue = min(QUEUE, 2 * 12 * n_views * n_lights * texels[0] * texels[1])
    free -= surface.BASE + queue
    fitting = partial(
        surface.largest,
        free,
        n_views=n_views,
        n_lights=n_lights,
        n_directions=n_directions or n_views + n_lights,
        texels=texels[0] * texels[1],
        spp=spp,
        split_lights=split_lights,
    )
    size = fitting(found=surface.Shares())
    if shares is not None and (isinstance(size, int) or size[:2] != (n_views, n_lights)):
        size = fitting(found=shares())
    if isinstance(size, int):
        refuse(budget, budget - free + size)
    views, lights, buffer = size
    return Blocks(buffer, views, lights, queue)


def refuse(budget: int, least: int, *, what: str = "memory budget too small for these settings") -> NoReturn:
    """Raise InputError for a budget of fewer bytes than the least that does."""
    raise InputError(
        what,
        field="memory",
        got=f"{budget / 2**20:.0f} MiB",
        expected=f"at least {least / 2**20:.0f} MiB",
    )
