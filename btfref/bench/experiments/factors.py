"""Factored BTFs: speed of the factorizations and of clustering, and what 8-bit maps and codebooks cost.

Suykens et al. 2003 report, for one texel of 4096 samples and one channel, 33 s with homomorphic factorization and 8 s
with chained matrix factorization, 35 minutes of clustering for 4096 texels, and that 8-bit maps spoil the former only.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES, material_name, materials
from btfref.bench.options import Options
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from btfref.representations.factored.definition import Representation
    from btfref.representations.factored.fit import Factors
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, Progress


#: How the paper stores maps: no scales fitted again, linear codes.
PUBLISHED: Facts = {"rescale": False, "code": "linear"}

#: Name → method, parameters of the factorization, parameters of storing.
VARIANTS: dict[str, tuple[str, Facts, Facts]] = {
    "cmf, as published": ("cmf", {"sweeps": 0}, PUBLISHED),
    "hf, as published": ("hf", {"floor": 1e-3, "bounded": False}, PUBLISHED),
    "cmf": ("cmf", {}, {}),
    "hf": ("hf", {}, {}),
}

STORAGES = ("float", "half", "byte")
CLUSTERS = {"unclustered": None, "clustered": 256}

#: Paths a sample of the BTFs whose errors are measured, and of that whose times are.
SPP, DRAFT_SPP = 16, 2

#: Share of the mean value whose square is the ε of relMSE: below it a sample's error is judged absolutely.
RELMSE_SHARE = 0.1

#: Pairs of directions whose pictures are compared by colour difference.
N_PICTURES = 64


def run(options: Options) -> Facts:
    """Times and errors of the variants.

    Parameters
    ----------
    options : Options
        ``quick``: one round instead of three, and the errors of the BTF that is timed alone. ``btf``: to be timed and
        judged. Default: times of a checker of 64² texels at 8 × 8 views and as many lights, 4096 samples a texel as
        in the paper; errors of the three mesostructures with 64² texels and 81² directions. ``only``: of "cmf" and
        "hf".

    Returns
    -------
    dict
        ``raw``: seconds of factorization and of clustering into 256 prototypes a factor, per variant; ``rate``: texels
        a minute and channel of the median; ``clustering``: median seconds; ``errors``: material → variant → "storage,
        clustered" or "storage, unclustered" → rmse, nrmse, relmse, delta_e00; ``range``: material → variant → factor →
        median over texels of peak over median of the map, the largest of the channels.
    """
    from btfref.representations.factored.storage import cluster
    from btfref.sampling.synthesis import synthesize

    options.demand(dict.fromkeys(key for key, *_ in VARIANTS.values()))
    variants = {name: v for name, v in VARIANTS.items() if options.wants(v[0])}
    report = options.tell
    timed = options.btf or synthesize(
        "checker",
        texels=64,
        views="8x8",
        lights="8x8",
        spp=DRAFT_SPP,
        estimator="path",
        progress=options.progress,
    )
    rounds = 1 if options.quick else 3
    raw: dict[str, list[float]] = {
        f"{name}, {part}": [] for name in variants for part in ("factorization", "clustering")
    }
    kept = {}
    for turn in range(rounds):
        for i, (name, (key, parameters, _)) in enumerate(variants.items()):
            report(turn * len(variants) + i + 1, rounds * len(variants), f"times: {name}")
            start = time.perf_counter()
            kept[name] = factorize(key, timed, parameters)
            middle = time.perf_counter()
            cluster(kept[name], CLUSTERS["clustered"])
            raw[f"{name}, factorization"].append(middle - start)
            raw[f"{name}, clustering"].append(time.perf_counter() - middle)
    median = {name: float(np.median(times)) for name, times in raw.items()}
    n_tables = int(np.prod(timed.texels)) * 3
    errors, ranges = {}, {}
    if options.quick or options.btf is not None:
        name = material_name(timed)
        errors[name], ranges[name] = judged(timed, variants, kept, report)
    else:
        kept.clear()
        for name, data in materials(
            None, MESOSTRUCTURES, texels=64, spp=SPP, estimator="path", progress=options.progress
        ):
            errors[name], ranges[name] = judged(data, variants, {}, report)
    return {
        "suite": "factors",
        "parameters": {
            "shape": list(timed.values.shape),
            "rounds": rounds,
            "attributes": timed.attributes,
        },
        "raw": raw,
        "rate": {name: n_tables * 60 / median[f"{name}, factorization"] for name in variants},
        "clustering": {name: median[f"{name}, clustering"] for name in variants},
        "errors": errors,
        "range": ranges,
        "machine": machine(),
    }


def factorize(key: str, btf: SampledBTF, parameters: Facts) -> Factors:
    """Factors by one method."""
    return import_module(f"btfref.representations.{key}").factorize(btf, **parameters)


def judged(
    btf: SampledBTF,
    variants: Mapping[str, tuple[str, Facts, Facts]],
    factors: Mapping[str, Factors],
    report: Progress,
) -> tuple[Facts, Facts]:
    """Errors of every variant and storage on one BTF, and the ranges of the factors' values.

    Parameters
    ----------
    btf : SampledBTF
    variants : dict
        As ``VARIANTS``.
    factors : dict of str to btfref.representations.factored.fit.Factors
        Those of ``btf`` that are there already.
    report : callable

    Returns
    -------
    errors, ranges : dict
    """
    from btfref.representations.factored.storage import Storing, cluster, store

    errors: Facts = {}
    ranges: Facts = {}
    for i, (name, (key, parameters, how)) in enumerate(variants.items()):
        report(i + 1, len(variants), f"errors: {name}")
        fitted = factors.get(name) or factorize(key, btf, parameters)
        errors[name] = {}
        for label, clusters in CLUSTERS.items():
            codebooks = cluster(fitted, clusters)
            if clusters is None:
                ranges[name] = {factor: spread(maps) for factor, maps in codebooks.prototypes.items()}
            for storage in STORAGES:
                storing = Storing(clusters, storage, **how)
                errors[name][f"{storage}, {label}"] = table_errors(store(btf, codebooks, storing), btf)
    return errors, ranges


def spread(maps: np.ndarray) -> float:
    """Median over maps of peak over median, the largest of the channels; shape (map, n, n, 3)."""
    texels = maps.reshape(len(maps), -1, 3)
    middle = np.median(texels, 1)
    lit = middle > 0
    ratio = np.where(lit, texels.max(1) / np.where(lit, middle, 1), np.nan)
    return float(np.nanmedian(np.nanmax(ratio[lit.any(1)], 1))) if lit.any() else 0.0


def table_errors(fitted: Representation, btf: SampledBTF) -> dict[str, float]:
    """Errors of a factored representation at all measured pairs of directions.

    Parameters
    ----------
    fitted : btfref.representations.factored.definition.Representation
    btf : SampledBTF

    Returns
    -------
    dict of str to float
        ``rmse`` and ``nrmse`` (over the RMS of the data); ``relmse``, the mean of (t − r)²/(r² + ε) with
        ε = (``RELMSE_SHARE`` · mean)²; ``delta_e00``, the mean over ``N_PICTURES`` pictures of one view and light
        each, under one exposure.
    """
    from btfref.comparison.colour import delta_e00
    from btfref.images.display import fit_display
    from btfref.numerics.solvers.factoring import map_operators
    from btfref.representations.factored.definition import texel_parts

    operators = map_operators(
        btf.views.vectors, btf.lights.vectors, fitted.maps["factor_p"].shape[1], "factor_d" in fitted.maps
    )
    values = btf.values.reshape(*btf.values.shape[:2], -1, 3)
    n_texels = values.shape[2]
    epsilon = (RELMSE_SHARE * float(values.mean(dtype=float))) ** 2
    squared = relative = energy = 0.0
    pick = np.random.default_rng(0).integers(0, values.shape[:2], (N_PICTURES, 2)).T
    pictures: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    for texels in texel_parts(n_texels):
        reference = values[:, :, texels].astype(np.float32)
        model = fitted.tables(texels, operators)
        square = (model - reference) ** 2
        squared += float(square.sum(dtype=float))
        energy += float((reference**2).sum(dtype=float))
        relative += float((square / (reference**2 + epsilon)).sum(dtype=float))
        for stack, table in zip(pictures, (model, reference), strict=True):
            stack.append(table[pick[0], pick[1]])
    test, reference = (np.concatenate(stack, 1) for stack in pictures)
    return {
        "rmse": float(np.sqrt(squared / values.size)),
        "nrmse": float(np.sqrt(squared / energy)),
        "relmse": relative / values.size,
        "delta_e00": float(delta_e00(test, reference, fit_display(reference)).mean()),
    }


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: material, variant, speed, range of Q, and errors of each storage."""
    header = (
        "material",
        "method",
        "maps",
        "texels/min/channel",
        "clustering s",
        "range of Q",
        "RMSE",
        "relMSE",
        "ΔE00",
    )
    rows: list[tuple[str, ...]] = []
    for material, variants in result["errors"].items():
        for name, storages in variants.items():
            about = (
                f"{result['rate'][name]:.0f}",
                f"{result['clustering'][name]:.1f}",
                f"{result['range'][material][name]['q']:.0f}",
            )
            for storage, e in storages.items():
                figures = (f"{e['rmse']:.5f}", f"{e['relmse']:.4f}", f"{e['delta_e00']:.3f}")
                rows.append((material, name, storage, *about, *figures))
                about = ("", "", "")
    return header, rows
