"""How wrong every method is between its samples: against the data's interpolation, and against path-traced values.

The interpolation is no truth: on coarse grids it smears highlights. So values are path traced at random pairs of
directions as well, and every method is set beside the tabulated BTF there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES, material_name
from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.registry import methods

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts

#: Two grids without a pole, of few and of more azimuths, and the set of the measured BTFs.
SETS = ("10x5", "16x8", "ubo81")

TEXELS, SPP = 16, 16

#: Random views, as many lights, and paths of the values that count as true.
TRUE_DIRECTIONS, TRUE_SPP = 32, 32

#: Its seed: another than that of the BTFs, so that no noise is shared.
TRUE_SEED = 1000

#: Least z of those directions: nearer to the horizon a value is less than its noise.
LEAST_Z = 0.02


def run(options: Options) -> Facts:
    """Figures by material, set of directions and method.

    Parameters
    ----------
    options : Options
        ``quick``: the checker at 10x5 only. ``btf``: instead of the suite's data, without true values. ``only``: some
        of the methods, mesostructures and sets of directions.

    Returns
    -------
    dict
        ``summary``: "material, directions" → method → what :func:`btfref.representations.between.measure` finds, the
        squared ``error`` at the samples, and against true values ``rms_truth``, the RMS error over that of ``raw``,
        ``mean_truth``, the mean over the true mean, and ``nrmse_truth``, the RMS error over the true values' RMS;
        ``raw``: seconds of the fit and of the measurement.
    """
    names, sets, keys = _chosen(options)
    summary: Facts = {}
    raw: Facts = {}
    truth, of = None, ""
    for name, directions, btf in _materials(options, names, sets):
        if options.btf is None and of != name:
            truth, of = _true_values(name, options), name
        label = f"{name}, {directions}"
        summary[label], raw[label] = _measured(btf, truth, keys, options)
    return {
        "suite": "between",
        "parameters": {"texels": TEXELS, "spp": SPP, "true_directions": TRUE_DIRECTIONS},
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def _chosen(options: Options) -> list[Sequence[str]]:
    """Mesostructures, sets and methods that are asked for."""
    axes: list[Sequence[str]] = [MESOSTRUCTURES, SETS, list(methods())]
    if options.quick:
        axes[:2] = MESOSTRUCTURES[:1], SETS[:1]
    return chosen_of(axes, options)


def chosen_of(axes: Sequence[Sequence[str]], options: Options) -> list[Sequence[str]]:
    """Of each axis the names in ``options.only``, or all where none of them is there.

    Raises
    ------
    InputError
        For a name that is on no axis.
    """
    options.demand(dict.fromkeys(name for axis in axes for name in axis))
    return [[name for name in axis if name in (options.only or ())] or axis for axis in axes]


def fitted_to(name: str, directions: str | DirectionSet, options: Options) -> SampledBTF:
    """What methods are fitted to: a mesostructure at a set of directions."""
    from btfref.sampling.synthesis import synthesize

    return synthesize(
        name,
        texels=TEXELS,
        views=directions,
        lights=directions,
        spp=SPP,
        estimator="surface",
        progress=options.progress,
    )


def _materials(
    options: Options, names: Sequence[str], sets: Sequence[str]
) -> list[tuple[str, str, SampledBTF]]:
    if options.btf is not None:
        return [(material_name(options.btf), options.btf.views.name, options.btf)]
    return [(name, directions, fitted_to(name, directions, options)) for name in names for directions in sets]


def _true_values(name: str, options: Options) -> SampledBTF:
    """Path-traced values at random pairs of directions."""
    from btfref.numerics.sphere.directions import directions
    from btfref.sampling.synthesis import synthesize

    def some(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        z, phi = np.maximum(rng.random(TRUE_DIRECTIONS), LEAST_Z), 2 * np.pi * rng.random(TRUE_DIRECTIONS)
        r = np.sqrt(1 - z * z)
        return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)

    return synthesize(
        name,
        texels=TEXELS,
        views=directions(some(1)),
        lights=directions(some(2)),
        spp=TRUE_SPP,
        estimator="surface",
        seed=TRUE_SEED,
        progress=options.progress,
    )


def _measured(
    btf: SampledBTF, truth: SampledBTF | None, keys: Sequence[str], options: Options
) -> tuple[Facts, Facts]:
    """Figures and seconds of every method on one BTF."""
    from btfref.representations import between

    rows = methods()
    found: Facts = {}
    seconds: Facts = {}
    yardstick = None if truth is None else at_pairs(rows["raw"].fit(btf), truth)
    for i, key in enumerate(keys):
        options.tell(i, len(keys), f"between the samples: {key}")
        start = time.perf_counter()
        made = rows[key].fit(btf)
        middle = time.perf_counter()
        found[key] = {"error": made.meta.get("fit", {}).get("error"), **between.measure(made, btf)}
        seconds[key] = {"fit": middle - start, "measurement": time.perf_counter() - middle}
        if truth is not None and yardstick is not None:
            found[key] |= _against_truth(at_pairs(made, truth), yardstick, truth.values.astype(float))
    return found, seconds


def _against_truth(value: np.ndarray, yardstick: np.ndarray, true_values: np.ndarray) -> Facts:
    """Errors of values and of those of ``raw``, arrays of one shape."""
    error, of_raw = (float(np.sqrt(np.mean((v - true_values) ** 2))) for v in (value, yardstick))
    return {
        "rms_truth": error / of_raw if of_raw > 0 else None,
        "mean_truth": float(value.mean() / true_values.mean()),
        "nrmse_truth": error / float(np.sqrt(np.mean(np.square(true_values)))),
    }


def at_pairs(representation: Representation, truth: SampledBTF) -> np.ndarray:
    """Values of a representation at a BTF's pairs of directions and centres of texels, in the order of its values."""
    rows, columns = truth.values.shape[2:4]
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    uv, lights = np.stack([u, v], -1), truth.lights.vectors[:, None, None]
    return np.stack([representation.evaluate(uv, lights, view) for view in truth.views.vectors])


#: Head of the table, and where its figures come from.
COLUMNS = {
    "error": "error²",
    "peak": "peak",
    "peak_p999": "99.9 %",
    "mean_ratio": "mean/data",
    "rms_to_data": "RMS to data",
    "albedo": "albedo",
    "data_albedo": "of data",
    "negative_fraction": "negative",
    "rms_truth": "RMS/raw's",
    "mean_truth": "mean/truth",
    "nrmse_truth": "nRMSE",
}


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a material, a set of directions and a method each."""
    rows = []
    for label, found in result["summary"].items():
        for key, facts in found.items():
            figures = [facts.get(name) for name in COLUMNS]
            rows.append((label, key, *("–" if f is None else f"{f:.3f}" for f in figures)))
    return ("material", "method", *COLUMNS.values()), rows
