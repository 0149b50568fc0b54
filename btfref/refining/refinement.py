"""Refinement of a fit: its maps follow the gradient of a loss at rows of true values.

Adam (Kingma and Ba 2015) with steps relative to the size of each map's values, on random batches, the rate falling as a
cosine. Some rows are held out. The maps that are best on these are kept, and the search ends when they get no better.
Maps of halves are floats while they are refined; in the end they are rounded, and judged once more: what is worse than
the start is not taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.querying.footprints import offset
from btfref.refining.losses import LOSSES
from btfref.refining.rows import Rows, rows_of
from btfref.refining.variables import Variables

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, JitArray, PathLike, Progress

#: Largest share of rows that are held out, and the most of them.
HELD_OUT, MOST_HELD_OUT = 0.1, 1 << 14

#: Random places in the footprint of a row.
LOOKUPS = 4

#: Steps between two looks at the held-out rows, and looks without progress after which the search ends.
PERIOD, PATIENCE = 20, 8

#: Share of the first rate that is left in the end.
LAST_RATE = 0.05

#: Texels, views and rule over the lights of the check of energy.
ENERGY_TEXELS, ENERGY_VIEWS, ENERGY_RULE = 128, 8, (6, 16)

#: Halvings of the way from the start, where its end reflects too much.
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
    rate: float = 0.02
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
    rate: float = 0.02,
    seed: int = 0,
    maps: Sequence[str] | None = None,
    footprint: str = "square",
    progress: Progress | None = None,
) -> Representation:
    """Move the maps of a fit so that its values are nearer to true ones.

    Parameters
    ----------
    representation : Representation or path-like
        The start; of any method whose maps have derivatives.
    data : path-like, SampledBTF or dict of ndarray
        Queries, a sampled BTF, or columns of rows: see `btfref.refining.rows.rows_of`.
    loss, steps, batch, rate, seed
        See :class:`Settings`. Same seed, same result on the same machine, up to the order in which threads add up.
    maps : sequence of str, optional
        Some of the maps, by their names in ``mi.traverse``; default: all that have derivatives and can be stored.
    footprint : str
        Shape of the footprints of columns.
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
    from btfref.representations.protocol import Representation as Protocol

    settings = Settings(loss, steps, batch, rate, seed)
    if not isinstance(representation, Protocol):
        from btfref.representations import load

        representation = load(representation)
    rng = np.random.default_rng(seed)
    rows = rows_of(data, rng, footprint=footprint)
    if len(rows) < 2:
        raise InputError("too few rows to hold some out", field="data", got=len(rows), expected="at least 2")
    order = rng.permutation(len(rows))
    n_held = int(np.clip(HELD_OUT * len(rows), 1, MOST_HELD_OUT))
    held, used = rows.part(order[:n_held]), rows.part(order[n_held:])
    variables = Variables(representation, None if maps is None else list(maps))
    before = Judge(held, settings).loss_of(variables)
    if not np.isfinite(before):
        raise InputError("values of the start are not finite at some rows", field="data", got=rows.source)
    best, history = _search(
        variables, Judge(used, settings), Judge(held, settings), before, settings, rng, progress
    )
    made, after, albedo, share = _taken(variables, best, held, settings, before)
    facts: Facts = {
        "data": rows.source,
        "rows": len(used),
        "held_out": len(held),
        **vars(settings),
        "maps": list(variables.names),
        "steps_taken": history[-1][0] if history else 0,
        "history": history,
        "before": before,
        "after": after,
        "share": share,
        "albedo": albedo,
    }
    meta = made.meta | {"refined": [*made.meta.get("refined", []), facts]}
    return type(made).from_arrays(dict(made.arrays()), meta)


class Judge:
    """The loss of rows.

    Parameters
    ----------
    rows : Rows
    settings : Settings
    """

    def __init__(self, rows: Rows, settings: Settings) -> None:
        import mitsuba_plugins

        mi = mitsuba_plugins.ready()
        self.rows, self.settings = rows, settings
        self.level = max(float(np.abs(rows.columns["B"]).mean(dtype=float)), 1e-12)
        columns = rows.columns
        self.lookups = LOOKUPS if (columns["radius"] > 0).any() else 1
        self._packed = {
            "place": to_device(mi.Float, np.concatenate([columns["uv"], columns["radius"][:, None]], 1)),
            **{name: to_device(mi.Float, columns[name]) for name in ("w_light", "w_view", "B")},
        }
        # The same places at each look.
        self._fixed = np.random.default_rng(settings.seed + 1).random((len(rows), self.lookups, 2))

    def loss(self, variables: Variables, index: np.ndarray, places: np.ndarray | None = None) -> JitArray:
        """Mean loss of some rows by the maps as they are put, as a Float; ``places`` are random numbers."""
        import drjit as dr
        import mitsuba as mi

        places = self._fixed[index] if places is None else places
        n, k = places.shape[:2]
        at = to_device(mi.UInt32, np.repeat(index, k))
        shift = offset(self.rows.footprint, places.reshape(n * k, 2))
        u, v, radius = dr.gather(mi.Vector3f, self._packed["place"], at)
        uv = mi.Point2f(
            dr.fma(radius, to_device(mi.Float, shift[:, 0]), u),
            dr.fma(radius, to_device(mi.Float, shift[:, 1]), v),
        )
        w_light, w_view = (dr.gather(mi.Vector3f, self._packed[name], at) for name in ("w_light", "w_view"))
        above = (w_light.z > 0) & (w_view.z > 0)
        value = dr.select(above, variables.evaluator.evaluate(uv, w_light, w_view, above), mi.Color3f(0))
        if k > 1:
            value = mi.Color3f(*(dr.block_sum(channel, k) * (1 / k) for channel in value))
        truth = dr.gather(mi.Color3f, self._packed["B"], to_device(mi.UInt32, index))
        return dr.mean(LOSSES[self.settings.loss](value, truth, self.level))

    def loss_of(self, variables: Variables) -> float:
        """Mean loss of all rows by the maps as they are put."""
        import drjit as dr

        with dr.suspend_grad():
            return float(self.loss(variables, np.arange(len(self.rows)))[0])


def _search(
    variables: Variables,
    used: Judge,
    held: Judge,
    before: float,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress | None,
) -> tuple[dict[str, JitArray], list[tuple[int, float]]]:
    """The variables that are best on the held-out rows, and (step, held-out loss) as it went."""
    import drjit as dr
    import mitsuba as mi

    optimizer = mi.ad.Adam(lr=settings.rate)
    for name, z in variables.zeros().items():
        optimizer[name] = z
    best, least, waited = variables.zeros(), before, 0
    history = [(0, before)]
    n, size = len(used.rows), min(settings.batch, len(used.rows))
    for step in range(settings.steps):
        if progress is not None:
            progress(step, settings.steps, "refine")
        fall = 0.5 * (1 + np.cos(np.pi * step / settings.steps))
        optimizer.set_learning_rate(settings.rate * (LAST_RATE + (1 - LAST_RATE) * fall))
        variables.put(dict(optimizer.items()))
        # With replacement where rows are many: no pass over all of them is needed.
        index = rng.integers(0, n, size) if size < n else np.arange(n)
        dr.backward(used.loss(variables, index, rng.random((size, used.lookups, 2))))
        optimizer.step()
        for name, z in variables.held(dict(optimizer.items())).items():
            optimizer[name] = z
        if (step + 1) % PERIOD and step + 1 < settings.steps:
            continue
        now = {name: type(z)(dr.detach(z)) for name, z in optimizer.items()}
        variables.put(now)
        found = held.loss_of(variables)
        history.append((step + 1, found))
        waited += 1
        if found < least:
            best, least, waited = now, found, 0
        if waited > PATIENCE or not np.isfinite(found):
            break
    return best, history


def _taken(
    variables: Variables, best: Mapping[str, JitArray], held: Rows, settings: Settings, before: float
) -> tuple[Representation, float, Facts, float]:
    """The rounded maps, as far on the way to the best ones as energy allows; the start where these are no better."""
    start = variables.representation
    albedo = largest_albedo(start, settings.seed)
    limit = max(1.0, albedo) * (1 + 1e-3)
    share = 1.0
    for _ in range(HALVINGS):
        made = variables.representation_of(best, share)
        found = largest_albedo(made, settings.seed)
        if found <= limit:
            after = Judge(held, settings).loss_of(Variables(made, list(variables.names)))
            if after < before:
                return made, after, {"before": albedo, "after": found}, share
            break
        share *= 0.5
    return start, before, {"before": albedo, "after": albedo}, 0.0


def largest_albedo(representation: Representation, seed: int = 0) -> float:
    """Largest ``∫ B dω_light`` of some texels and views, by quadrature over the lights; 1 is a white surface."""
    rng = np.random.default_rng([seed, 7])
    light, weight = gauss_hemisphere(*ENERGY_RULE)
    uv = rng.random((ENERGY_TEXELS, 1, 1, 2))
    z, phi = rng.uniform(0.1, 1, ENERGY_VIEWS), rng.uniform(0, 2 * np.pi, ENERGY_VIEWS)
    r = np.sqrt(1 - z * z)
    view = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    value = representation.evaluate(uv, light[None, None], view[None, :, None])
    return float(np.einsum("tvlc,l->tvc", value, weight).max())
