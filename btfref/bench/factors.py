"""Factored BTFs: speed of the factorizations and of clustering, and what 8-bit maps cost.

Suykens et al. 2003 report, for one texel of 4096 samples and one channel, 33 s with homomorphic factorization and 8 s
with chained matrix factorization, 35 minutes of clustering for 4096 texels, and that 8-bit maps spoil the former only.
"""

from __future__ import annotations

import time

import numpy as np

from btfref.bench.timing import machine
from btfref.errors import InputError

#: Name → method and parameters. "as published": no refinement, and 8-bit scales where the maps have 8 bits.
VARIANTS = {
    "cmf, as published": ("cmf", {"sweeps": 0, "rescale": False}),
    "hf, as published": ("hf", {"rescale": False}),
    "cmf": ("cmf", {}),
    "hf": ("hf", {}),
}

STORAGES = ("float", "byte")

#: Share of the mean value whose square is the ε of relMSE: below it a sample's error is judged absolutely.
RELMSE_SHARE = 0.1

#: Pairs of directions whose pictures are compared by colour difference.
N_PICTURES = 64


def run(*, quick=False, progress=None, btf=None, only=None):
    """Times and errors of the variants.

    Parameters
    ----------
    quick : bool
        One round instead of three.
    progress : callable, optional
    btf : SampledBTF, optional
        Default: a checker of 64² texels at 8 × 8 views and as many lights, 4096 samples a texel as in the paper.
    only : iterable of str, optional
        Of "cmf" and "hf".

    Returns
    -------
    dict
        ``raw``: seconds of factorization (nothing clustered) and of the whole fit with 256 prototypes, per variant;
        ``rate``: texels a minute and channel of the median; ``clustering``: median seconds that codebooks add;
        ``errors``: variant → "storage" or "storage, clustered" → rmse, nrmse, relmse, delta_e00.
    """
    from btfref.registry import method
    from btfref.sampling.synthesis import synthesize

    btf = btf or synthesize("checker", texels=64, views="8x8", lights="8x8", spp=2, progress=progress)
    variants = {name: v for name, v in VARIANTS.items() if not only or v[0] in only}
    if not variants:
        raise InputError("nothing to measure", field="--only", got=", ".join(only), expected="cmf or hf")
    rounds = 1 if quick else 3
    raw, errors = {}, {name: {} for name in variants}
    for turn in range(rounds):
        for name, (key, parameters) in variants.items():
            for label, clusters in (("factorization", None), ("clustered", 256)):
                for storage in STORAGES:
                    if turn and storage != STORAGES[0]:
                        continue
                    scales = storage if "published" in name else None
                    start = time.perf_counter()
                    fitted = method(key).fit(
                        btf, clusters=clusters, storage=storage, scale_storage=scales, **parameters
                    )
                    seconds = time.perf_counter() - start
                    if storage == STORAGES[0]:
                        raw.setdefault(f"{name}, {label}", []).append(seconds)
                    if not turn:
                        label_of = storage if clusters is None else f"{storage}, clustered"
                        errors[name][label_of] = table_errors(fitted, btf)
    median = {name: float(np.median(times)) for name, times in raw.items()}
    n_tables = int(np.prod(btf.texels)) * 3
    return {
        "suite": "factors",
        "parameters": {"shape": list(btf.values.shape), "rounds": rounds, "attributes": btf.attributes},
        "raw": raw,
        "rate": {name: n_tables * 60 / median[f"{name}, factorization"] for name in variants},
        "clustering": {
            name: median[f"{name}, clustered"] - median[f"{name}, factorization"] for name in variants
        },
        "errors": errors,
        "machine": machine(),
    }


def table_errors(fitted, btf):
    """Errors of a factored representation at all measured pairs of directions.

    Parameters
    ----------
    fitted : btfref.representations.factored.Representation
    btf : SampledBTF

    Returns
    -------
    dict of str to float
        ``rmse`` and ``nrmse`` (over the RMS of the data); ``relmse``, the mean of (t − r)²/(r² + ε) with
        ε = (``RELMSE_SHARE`` · mean)²; ``delta_e00``, the mean over ``N_PICTURES`` pictures of one view and light
        each, under one exposure.
    """
    from btfref.compare.colour import delta_e00, fit_display
    from btfref.representations.factored import texel_parts
    from btfref.representations.factored_fit import map_operators

    operators = map_operators(
        btf.views.vectors, btf.lights.vectors, fitted.maps["factor_p"].shape[1], "factor_d" in fitted.maps
    )
    values = btf.values.reshape(*btf.values.shape[:2], -1, 3)
    n_texels = values.shape[2]
    epsilon = (RELMSE_SHARE * float(values.mean(dtype=float))) ** 2
    squared = relative = energy = 0.0
    pick = np.random.default_rng(0).integers(0, values.shape[:2], (N_PICTURES, 2)).T
    pictures = [], []
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


def table(result):
    """Rows for people: variant, rate, clustering, and errors of each storage."""
    header = ("method", "maps", "texels/min/channel", "clustering s", "RMSE", "NRMSE", "relMSE", "ΔE00")
    rows = []
    for name, storages in result["errors"].items():
        for storage, e in storages.items():
            first = storage == STORAGES[0]
            rows.append(
                (
                    name,
                    storage,
                    f"{result['rate'][name]:.0f}" if first else "",
                    f"{result['clustering'][name]:.1f}" if first else "",
                    f"{e['rmse']:.5f}",
                    f"{e['nrmse']:.4f}",
                    f"{e['relmse']:.4f}",
                    f"{e['delta_e00']:.3f}",
                )
            )
    return header, rows
