"""Fitting lobes: the batched solver against ``scipy.optimize.least_squares``.

Both from the same starts and within the same bounds; the peer with the same analytic Jacobian, and, as it is mostly
called, without.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import interleaved, machine
from btfref.numerics.solvers.threads import one_blas_thread

if TYPE_CHECKING:
    from btfref.numerics.solvers.levenberg import BatchFit
    from btfref.sampling import SampledBTF
    from btfref.types import Facts


LOBES = 2

#: Rounds in which the solvers take turns, after one that warms up.
ROUNDS = 5

#: Ways to call SciPy's optimizer: name in tables, and whether it gets the Jacobian.
PEERS = {
    "jacobian": ("scipy, analytic Jacobian", True),
    "differences": ("scipy, its own differences", False),
}


def run(options: Options) -> Facts:
    """Seconds per fit and mean error of both.

    Parameters
    ----------
    options : Options
        ``quick``: 8 fits of the peer instead of 64. ``btf``: default: a checker of 64² texels and 81² directions.
        ``only``: some of the peers "jacobian", "differences"; the batched solver always runs.

    Returns
    -------
    dict
        ``raw``: seconds of every round; ``summary``: for each solver the median of the seconds a fit takes, that of the
        paired ratios to the batched solver with the least and the largest, and the mean root-mean-square and mean
        absolute residual over the same random fits, times π; ``parameters``; ``machine``.
    """
    from btfref.bench.data import checker
    from btfref.representations.analytic import rf_lobes
    from btfref.representations.analytic.lobe_start import lobe_starts

    options.demand(PEERS)
    btf = options.btf or checker(spp=8, progress=options.progress)
    lights = btf.lights.vectors
    data = residual_fields(btf)
    start = time.perf_counter()
    whole = rf_lobes.fit(btf).meta["fit"]
    raw: Facts = {"whole fit": time.perf_counter() - start}
    chosen = np.sort(np.random.default_rng(0).choice(len(data), 8 if options.quick else 64, replace=False))
    some = data[chosen].astype(float)
    starts = lobe_starts(data[chosen], lights, LOBES).astype(float)
    lower, upper = (bound.astype(float) for bound in rf_lobes.lobe_bounds(data[chosen], btf.lights, LOBES))
    found: dict[str, np.ndarray] = {}
    fits: list[BatchFit] = []

    def batched() -> None:
        fits[:] = [rf_lobes.fit_lobes(data, btf.lights, LOBES)]

    def peer(name: str, jacobian: bool) -> Callable[[], None]:
        def task() -> None:
            # Threads would slow such small algebra down, which is no fair peer.
            with one_blas_thread():
                found[name] = np.stack(
                    [
                        scipy_fit(some[i], lights, starts[i], lower[i], upper[i], jacobian)
                        for i in range(len(chosen))
                    ]
                )

        return task

    wanted = {name: gets for short, (name, gets) in PEERS.items() if options.wants(short)}
    tasks = {"batched": batched} | {name: peer(name, gets) for name, gets in wanted.items()}
    raw |= interleaved(tasks, 1 if options.quick else ROUNDS)
    result = fits[0]
    found = {"batched": result.parameters[chosen].astype(float), **found}
    own = [seconds / len(data) for seconds in raw["batched"]]
    of_solvers = {}
    for name, lobes in found.items():
        model = np.stack([lobes_and_jacobian(p, lights)[0] for p in lobes])
        residual = np.pi * (model - some)
        seconds = own if name == "batched" else [t / len(chosen) for t in raw[name]]
        ratios = [a / b for a, b in zip(seconds, own, strict=True)]
        of_solvers[name] = {
            "seconds_per_fit": statistics.median(seconds),
            "ratio": statistics.median(ratios),
            "ratio_min": min(ratios),
            "ratio_max": max(ratios),
            "mean_rms": float(np.sqrt((residual**2).mean(1)).mean()),
            "mean_absolute": float(np.abs(residual).mean()),
        }
    parameters = {"samples": len(lights), "peer_fits": len(chosen), "lobes": LOBES}
    return {
        "suite": "lobes",
        "parameters": parameters | result.summary,
        "raw": raw,
        "summary": of_solvers,
        "whole": whole,
        "machine": machine(),
    }


def residual_fields(btf: SampledBTF) -> np.ndarray:
    """Luminance without its diffuse term, shape (n_views · n_texels, n_lights)."""
    from btfref.representations.analytic import rf_lobes
    from btfref.representations.analytic.light_functions import luminance_blocks

    lights, data = btf.lights.vectors, []
    for _, luminance, _ in luminance_blocks(btf):
        diffuse = rf_lobes.diffuse_albedo(luminance, lights, rf_lobes.DIFFUSE_QUANTILE)
        luminance -= (diffuse * lights[:, 2, None]).astype(np.float32)
        data.append(luminance.swapaxes(1, 2).reshape(-1, len(lights)))
    return np.concatenate(data)


def lobes_and_jacobian(p: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values at the lights and derivatives by the parameters (s, t, ln n, peak) of each lobe."""
    value, columns = np.zeros(len(lights)), []
    for s, t, log_n, peak in p.reshape(-1, 4):
        d = 1 + s * s + t * t
        cosine = lights @ np.array([2 * s, 2 * t, 2 - d]) / d
        there = cosine > 2.0**-24
        safe, n = np.where(there, cosine, 1), np.exp(log_n)
        power = np.where(there, safe**n, 0)
        slope = 2 / d * peak * n * power / safe
        along = cosine + lights[:, 2]
        columns += [slope * (lights[:, 0] - s * along), slope * (lights[:, 1] - t * along)]
        columns += [peak * power * n * np.log(safe), power]
        value += peak * power
    return value, np.stack(columns, 1)


def scipy_fit(
    data: np.ndarray,
    lights: np.ndarray,
    start: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    jacobian: bool,
) -> np.ndarray:
    """Parameters that ``scipy.optimize.least_squares`` finds with its default settings."""
    from scipy.optimize import least_squares

    # Its method needs a start inside the bounds, and bounds apart.
    upper = np.maximum(upper, lower + 1e-6)
    inside = np.clip(start, lower + 1e-9, upper - 1e-9)
    further = {"jac": lambda p: lobes_and_jacobian(p, lights)[1]} if jacobian else {}
    bounds = lower, upper
    return least_squares(
        lambda p: lobes_and_jacobian(p, lights)[0] - data, inside, bounds=bounds, **further
    ).x


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: solver, time of a fit, ratio, errors."""
    header = ("solver", "time of a fit", "ratio", "mean rms × π", "mean |residual| × π")
    rows: list[tuple[str, ...]] = [
        (
            name,
            f"{1e6 * s['seconds_per_fit']:.1f} µs",
            f"{s['ratio']:.0f} ({s['ratio_min']:.0f} … {s['ratio_max']:.0f})",
            f"{s['mean_rms']:.6f}",
            f"{s['mean_absolute']:.6f}",
        )
        for name, s in result["summary"].items()
    ]
    whole, seconds = result["whole"], result["raw"]["whole fit"]
    rows.append((f"rf_lobes, {whole['fits']} fits, with all around", f"{seconds:.1f} s", "", "", ""))
    rows.append(("fits that did not converge", str(whole["not_converged"]), "", "", ""))
    return header, rows
