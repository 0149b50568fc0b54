"""What a fit must keep whatever its data: determinism, symmetry, monotone error, continuity, energy, range.

Every check yields a :class:`btfref.stress.judging.Finding`. None knows a method by name: what a fit can vary is read
from its signature.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import DirectionSet, directions
from btfref.representations.protocol import Spreads
from btfref.sampling import SampledBTF
from btfref.stress.data import make
from btfref.stress.judging import Finding, limit_finding, valid_lookups
from btfref.stress.lookups import block, unit

if TYPE_CHECKING:
    from btfref.registry import Method
    from btfref.representations.protocol import Representation

#: Parameters of fits that say how much a representation may hold, and what is tried of each.
SIZES = {"components": (1, 2, 4, 8), "lobes": (1, 2, 4), "clusters": (1, 4, 16), "terms": (1, 2)}

#: Further seeds of fits, whose errors show what a random start is worth.
SEEDS = (1, 2, 3)

#: Samples of a BTF at which a fit is compared with its data.
SAMPLES = 8192

#: Directions and coordinates are moved by this much to look for jumps.
STEP = 1e-9


def sample_error(representation: Representation | _Moved, btf: SampledBTF, *, seed: int = 0) -> float:
    """Relative RMS difference between a representation and its data at random samples; 0 for black data met exactly."""
    value, reference = _at_samples(representation, btf, seed)
    scale = np.sqrt((reference**2).mean())
    error = np.sqrt(((value - reference) ** 2).mean())
    return float(error / scale) if scale > 0 else float(error)


def _at_samples(
    representation: Representation | _Moved, btf: SampledBTF, seed: int = 0, turned: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows, columns = btf.texels
    v, light, r, c = (rng.integers(0, n, SAMPLES) for n in btf.values.shape[:4])
    uv = np.stack([(c + 0.5) / columns, (r + 0.5) / rows], -1)
    w_light, w_view = btf.lights.vectors[light], btf.views.vectors[v]
    if turned:
        uv, w_light, w_view = 1 - uv, w_light * [-1, -1, 1], w_view * [-1, -1, 1]
    value = representation.evaluate(uv, w_light, w_view)
    return value, btf.values[v, light, r, c].astype(float)


def deterministic(method: Method, btf: SampledBTF, name: str) -> Iterator[Finding]:
    """Two fits with one seed hold the same bytes."""
    one, two = (method.quick_fit(btf, seed=1).arrays() for _ in range(2))
    different = [k for k in one if one[k].tobytes() != two[k].tobytes()]
    yield limit_finding(
        "same seed, same bytes", method.key, name, len(different), "stress.deterministic.maps",
        cases=len(one), where=", ".join(different),
    )  # fmt: skip


def monotone(method: Method, btf: SampledBTF, name: str) -> Iterator[Finding]:
    """More components, lobes or clusters do not raise the error."""
    parameters = inspect.signature(method.fit).parameters
    for size, steps in SIZES.items():
        if size not in parameters:
            continue
        default = parameters[size].default
        errors = []
        for n in steps:
            value = (n,) * len(default) if isinstance(default, tuple) else n
            errors.append(sample_error(method.quick_fit(btf, **{size: value}), btf))
        rise = max(b / max(a, 1e-12) for a, b in itertools.pairwise(errors))
        yield limit_finding(
            f"error by {size}", method.key, name, rise, "stress.monotone.rise",
            cases=len(steps), where=" → ".join(f"{e:.4f}" for e in errors),
        )  # fmt: skip


def symmetric(method: Method, btf: SampledBTF, name: str) -> Iterator[Finding]:
    """Scaled channels, shifted texels, and the whole material turned by half a turn."""
    plain = method.quick_fit(btf)
    own, _ = _at_samples(plain, btf)
    scale = max(np.sqrt((own**2).mean()), 1e-300)
    error = sample_error(plain, btf)

    def finding(
        check: str,
        value: np.ndarray,
        other_btf: SampledBTF,
        key: str,
        other: Representation,
        errors: Sequence[float],
    ) -> Finding:
        change = np.sqrt(((value - own) ** 2).mean()) / scale
        other_error = sample_error(other, other_btf)
        low, high = (max(e, 1e-3) for e in (min(errors), max(errors)))
        ratio = max(max(other_error, 1e-3) / high, low / max(other_error, 1e-3))
        before = f"{error:.4f}" if len(errors) == 1 else f"{min(errors):.4f} … {max(errors):.4f}"
        return limit_finding(
            check, method.key, name, ratio, key,
            cases=SAMPLES, where=f"error {before} → {other_error:.4f}", detail={"rms_change": float(change)},
        )  # fmt: skip

    # A power of two changes no rounding of the data.
    scaled = _with(btf, btf.values.astype(np.float32) * np.float32(0.25))
    other = method.quick_fit(scaled)
    yield finding(
        "channels × ¼", 4 * _at_samples(other, btf)[0], scaled, "stress.scaling.ratio", other, [error]
    )
    # Where texels or directions change places, what starts at random starts elsewhere: other seeds show what that does.
    errors = [error, *(sample_error(method.quick_fit(btf, seed=seed), btf) for seed in SEEDS)]
    shift = (btf.texels[0] // 4, btf.texels[1] // 4)
    rolled = _with(btf, np.roll(btf.values, shift, (2, 3)))
    other = method.quick_fit(rolled)
    offset = np.array([shift[1] / btf.texels[1], shift[0] / btf.texels[0]])
    moved = _Moved(other, lambda uv, *w: (uv + offset, *w))
    yield finding(
        "texels shifted", _at_samples(moved, btf)[0], rolled, "stress.permutation.ratio", other, errors
    )
    turned = half_turn(btf)
    if turned is not None:
        other = method.quick_fit(turned)
        value = _at_samples(other, btf, turned=True)[0]
        yield finding("half a turn", value, turned, "stress.turn.ratio", other, errors)


class _Moved:
    """A representation whose arguments are changed before it is evaluated."""

    def __init__(self, representation: Representation, change: Callable[..., tuple[np.ndarray, ...]]) -> None:
        self._representation, self._change = representation, change

    def evaluate(self, *points: ArrayLike, **further: ArrayLike) -> np.ndarray:
        return self._representation.evaluate(*self._change(*points), **further)


def _with(btf: SampledBTF, values: np.ndarray) -> SampledBTF:
    return SampledBTF(values, btf.views, btf.lights, attributes=btf.attributes)


def half_turn(btf: SampledBTF) -> SampledBTF | None:
    """The material turned by π about its normal, on the same directions; None where these have no such symmetry."""
    values = btf.values[:, :, ::-1, ::-1]
    for axis, chosen in enumerate((btf.views, btf.lights)):
        turned = chosen.vectors * [-1, -1, 1]
        nearest = np.argmax(turned @ chosen.vectors.T, 1)
        if np.abs(chosen.vectors[nearest] - turned).max() > 1e-9:
            return None
        values = np.take(values, nearest, axis)
    return _with(btf, np.ascontiguousarray(values))


def continuous(
    method: Method, representation: Representation, name: str, *, seed: int = 0, blocks: int = 1
) -> Iterator[Finding]:
    """No jumps where cells of directions, rings, seams, tiles and levels meet.

    A height field's silhouettes and shadows are jumps by nature: where it has them (`Spreads`) nothing is asked.
    """
    if isinstance(representation, Spreads) or representation.meta["filter_type"] != "bilinear":
        return
    worst, where, cases = 0.0, "", 0
    for number in range(blocks):
        lookups = block(representation, seed, number)
        lookups = lookups[valid_lookups(lookups) & np.isfinite(lookups.uv).all(1) & np.isfinite(lookups.lod)]
        rng = np.random.default_rng([seed, number, 1])
        ends = []
        moves = [rng.normal(size=a.shape) for a in (*lookups.points, lookups.lod)]
        for sign in (-1, 1):
            moved = [
                a.astype(float) + sign * STEP * m
                for a, m in zip((*lookups.points, lookups.lod), moves, strict=True)
            ]
            for w in moved[1:3]:
                w[:, 2] = np.maximum(w[:, 2], 1e-30)
            moved[1:3] = (unit(w) for w in moved[1:3])
            ends.append(representation.evaluate(*moved[:3], lod=moved[3]))
        largest = max(np.abs(ends[0]).max(), 1e-300)
        jump = np.abs(ends[1] - ends[0]).max(-1) / largest
        cases += len(lookups)
        if jump.max() > worst:
            worst, where = float(jump.max()), lookups.where(int(np.argmax(jump)))
    yield limit_finding(
        "continuity", method.key, name, worst, "stress.continuity.jump", cases=cases, where=where
    )


def energy(
    method: Method,
    representation: Representation,
    btf: SampledBTF,
    name: str,
    key: str = "stress.energy.relative",
) -> Iterator[Finding]:
    """The mean over the tile and all pairs of directions, against the data's; ``key`` names the bound."""
    value, reference = _at_samples(representation, btf)
    mean = abs(reference.mean())
    worst = abs(value.mean() - reference.mean()) / mean if mean > 0 else abs(value.mean())
    yield limit_finding("energy of the tile", method.key, name, worst, key, cases=SAMPLES)


def overflow(method: Method) -> Iterator[Finding]:
    """Values beyond the stored type: refused, or kept in a type that holds them; never a silent infinity."""
    for name in ("huge", "wide range"):
        btf = make(name)
        parameters = inspect.signature(method.fit).parameters
        further = {"storage": "half"} if "storage" in parameters else {}
        try:
            made = method.quick_fit(btf, **further)
        except InputError as refusal:
            yield limit_finding(
                "overflow", method.key, name, 0, "stress.overflow.silent", where=f"refused: {refusal}"
            )
            continue
        stored = [a for a in made.arrays().values() if a.dtype.kind == "f"]
        silent = sum(int(np.count_nonzero(~np.isfinite(a))) for a in stored)
        yield limit_finding(
            "overflow", method.key, name, silent, "stress.overflow.silent", where="stored, all finite"
        )


def refuses_nan(method: Method, folder: Path) -> Iterator[Finding]:
    """Data with NaN: no BTF is made of them, the store does not take them, and no fit makes numbers of them."""
    btf = make("bumpy")
    values = btf.values.copy()
    values[3, 5, 2, 1] = np.nan
    # What has a path counts as read and checked: so NaN get as far as the fit and the store.
    file = folder / "read.btf.zarr"
    spoiled = SampledBTF(values, btf.views, btf.lights, attributes=btf.attributes, path=file)
    silent = 0
    attempts = (
        lambda: _with(btf, values),
        lambda: method.quick_fit(spoiled),
        lambda: spoiled.save(folder / "nan.btf.zarr"),
    )
    for attempt in attempts:
        try:
            attempt()
        except InputError:
            continue
        silent += 1
    yield limit_finding("NaN refused", method.key, "NaN texel", silent, "stress.refusal.silent", cases=3)


def partition_of_unity(
    spec: str | DirectionSet | np.ndarray, name: str, *, seed: int = 0, n: int = 100_000
) -> Iterator[Finding]:
    """Weights of directions: not negative, sum 1 for views, and for lights the fade towards the horizon."""
    chosen = spec if isinstance(spec, DirectionSet) else directions(spec)
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2]) * 10 ** rng.uniform(-8, 0, n)
    w = unit(w)
    _, views = chosen.stencil(w)
    _, lights = chosen.stencil(w, hold=False)
    worst = max(
        float(np.abs(views.sum(-1) - 1).max()),
        float(-min(views.min(), lights.min(), 0)),
        float(max(lights.sum(-1).max() - 1, 0)),
    )
    yield limit_finding(
        "partition of unity", "–", name, worst, "stress.unity.deviation", evaluator="directions", cases=n
    )
    # One sum of lights away from the last ring's fade: exactly the views'.
    inside = w[:, 2] > chosen.vectors[:, 2].min() + tolerance("stress.unity.margin")
    worst = float(np.abs(lights.sum(-1) - 1)[inside].max(initial=0))
    if chosen.rings is not None:
        yield limit_finding(
            "partition of unity, lights", "–", name, worst, "stress.unity.deviation",
            evaluator="directions", cases=int(inside.sum()),
        )  # fmt: skip
