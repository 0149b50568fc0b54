"""Refinement of a fit: its maps follow the gradient of a loss at rows of true values.

Adam (Kingma and Ba 2015) with steps relative to the size of each map's values, on random batches, the rate falling as a
cosine. What maps reflect beyond a limit counts as a loss too. Some rows are held out. The maps that are best on these
are kept, and the search ends when they get no better. Maps of halves are floats while they are refined; in the end they
are rounded, and judged once more: what is worse than the start is not taken.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.refining.energy import WEIGHT, excess, largest_albedo
from btfref.refining.losses import LOSSES
from btfref.refining.objectives import at_pixels, at_rows
from btfref.refining.rows import rows_of
from btfref.refining.variables import Variables

if TYPE_CHECKING:
    from btfref.refining.objectives import Objective
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, JitArray, PathLike, Progress, SceneLike

#: Steps between two looks at the held-out rows, and looks without progress after which the search ends.
PERIOD, PATIENCE = 20, 8

#: Share of the first rate that is left in the end.
LAST_RATE = 0.05

#: By which the limit of albedos may be exceeded: halves.
ENERGY_ROUNDING = 1e-3

#: Halvings of the interval in which the way from the start is to end, where its end reflects too much.
HALVINGS = 6


@dataclass(frozen=True)
class Settings:
    """How a representation is refined.

    Attributes
    ----------
    loss : {"delta_e", "log", "relative"}
        See `btfref.refining.losses`.
    steps : int
        Most steps.
    batch : int
        Rows of a step.
    rate : float
        Of the first step, relative to the root mean square of a map's values.
    seed : int
        Of batches, places in footprints, and of what is held out.
    """

    loss: str = "delta_e"
    steps: int = 600
    batch: int = 8192
    rate: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise InputError("unknown loss", field="loss", got=repr(self.loss), expected=" or ".join(LOSSES))
        for name in ("steps", "batch"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(
                    "a setting is out of range", field=name, got=value, expected="an integer ≥ 1"
                )
        if not 0 < self.rate <= 1:
            raise InputError(
                "a setting is out of range", field="rate", got=self.rate, expected="above 0, ≤ 1"
            )


def refine(
    representation: Representation | PathLike,
    data: PathLike | SampledBTF | Mapping[str, np.ndarray],
    *,
    loss: str = "delta_e",
    steps: int = 600,
    batch: int = 8192,
    rate: float = 0.01,
    seed: int = 0,
    maps: Sequence[str] | None = None,
    footprint: str = "square",
    scene: SceneLike | None = None,
    parameters: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> Representation:
    """Move the maps of a fit so that its values are nearer to true ones.

    Parameters
    ----------
    representation : Representation or path-like
        The start; of any method whose maps have derivatives.
    data : path-like, SampledBTF or dict of ndarray
        Queries, a sampled BTF, or columns of rows: see `btfref.refining.rows.rows_of`. With ``scene`` a picture of it
        (``.exr``), linear radiance.
    loss, steps, batch, rate, seed
        See :class:`Settings`. Same seed, same result on the same machine, up to the order in which threads add up.
    maps : sequence of str, optional
        Some of the maps, by their names in ``mi.traverse``; default: all that have derivatives and can be stored.
    footprint : str
        Shape of the footprints of columns.
    scene, parameters
        What the picture shows: as `btfref.render` takes them, without ``btf``, which is the representation. Its one
        material of that file is moved; it is rendered by ``prb``.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    Representation
        Of the same maps and types, hence of the same bytes. ``meta["refined"]`` lists what was done: data, settings,
        the held-out loss from step to step, before and after, and the largest albedo before and after.

    Raises
    ------
    InputError
        For data, a setting or a map that cannot be used; for rows at which the start has no finite value.
    MissingDependencyError
        Without LLVM or CUDA.
    """
    from btfref.representations import load, save
    from btfref.representations.protocol import Representation as Protocol

    settings = Settings(loss, steps, batch, rate, seed)
    start = representation if isinstance(representation, Protocol) else load(representation)
    chosen = None if maps is None else list(maps)
    rng = np.random.default_rng(seed)
    used: Objective
    held: Objective
    if scene is None:
        used, held, facts = at_rows(rows_of(data, rng, footprint=footprint), loss, batch, seed, rng)
        return _refined(Variables(start, chosen), used, held, settings, facts, rng, progress)
    if not isinstance(data, str | os.PathLike):
        raise InputError(
            "what a scene is compared with", field="data", got=type(data).__name__, expected="a picture"
        )
    with tempfile.TemporaryDirectory() as folder:
        # The scene reads a file: this one, also where the start has none.
        file = Path(folder) / "start.exr"
        save(start, file)
        with at_pixels(file, data, scene, parameters or {}, loss, seed, rng) as (used, held, material, facts):
            return _refined(Variables(start, chosen, material), used, held, settings, facts, rng, progress)


def _refined(
    variables: Variables,
    used: Objective,
    held: Objective,
    settings: Settings,
    facts: Facts,
    rng: np.random.Generator,
    progress: Progress | None,
) -> Representation:
    """The refined representation, with its history."""
    variables.put(variables.zeros())
    before = held.whole(variables)
    if not np.isfinite(before):
        raise InputError("values of the start are not finite somewhere", field="data", got=facts["data"])
    albedo = largest_albedo(variables.start, settings.seed)
    best, history = _search(variables, used, held, before, most_reflected(albedo), settings, rng, progress)
    made, found = _taken(variables, best, held, settings, before, albedo)
    done = {"steps_taken": history[-1][0], "history": history, "before": before}
    facts = facts | vars(settings) | {"maps": list(variables.names)} | done | found
    meta = made.meta | {"refined": [*made.meta.get("refined", []), facts]}
    return type(made).from_arrays(dict(made.arrays()), meta)


def _search(
    variables: Variables,
    used: Objective,
    held: Objective,
    before: float,
    limit: float,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress | None,
) -> tuple[dict[str, JitArray], list[list[float]]]:
    """The variables that are best on what is held out, and [step, held-out loss] as it went."""
    import drjit as dr
    import mitsuba as mi

    optimizer = mi.ad.Adam(lr=settings.rate)
    for name, z in variables.zeros().items():
        optimizer[name] = z
    best, least, waited = variables.zeros(), before, 0
    history = [[0, before]]
    for step in range(settings.steps):
        if progress is not None:
            progress(step, settings.steps, "refine")
        fall = 0.5 * (1 + np.cos(np.pi * step / settings.steps))
        optimizer.set_learning_rate(settings.rate * (LAST_RATE + (1 - LAST_RATE) * float(fall)))
        variables.put(dict(optimizer.items()))
        dr.backward(used.batch(variables, rng) + WEIGHT * before * excess(variables, limit, rng))
        optimizer.step()
        for name, z in variables.held(dict(optimizer.items())).items():
            optimizer[name] = z
        if (step + 1) % PERIOD and step + 1 < settings.steps:
            continue
        now = {name: type(z)(dr.detach(z)) for name, z in optimizer.items()}
        variables.put(now)
        found = held.whole(variables)
        history.append([step + 1, found])
        waited += 1
        if found < least:
            best, least, waited = now, found, 0
        if waited > PATIENCE or not np.isfinite(found):
            break
    return best, history


def _taken(
    variables: Variables,
    best: Mapping[str, JitArray],
    held: Objective,
    settings: Settings,
    before: float,
    albedo: float,
) -> tuple[Representation, Facts]:
    """The rounded maps, as far on the way to the best ones as energy allows; the start where these are no better."""
    limit = most_reflected(albedo) * (1 + ENERGY_ROUNDING)

    def at(share: float) -> tuple[Representation, float]:
        made = variables.representation(best, share)
        return made, largest_albedo(made, settings.seed)

    low, high, share = 0.0, 1.0, 1.0
    made, found = at(share)
    if found > limit:
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            reflects = at(middle)[1] > limit
            low, high = (low, middle) if reflects else (middle, high)
        share = low
        made, found = at(share)
    variables.put_maps(made)
    after = held.whole(variables)
    if share > 0 and found <= limit and after < before:
        return made, {"after": after, "share": share, "albedo": [albedo, found]}
    return variables.start, {"after": before, "share": 0.0, "albedo": [albedo, albedo]}


def most_reflected(albedo: float) -> float:
    """The largest albedo that is allowed where the start has some."""
    return max(1.0, albedo)
