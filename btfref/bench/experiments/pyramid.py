"""Table 1 and figure 6 of Ma et al. (2005) on modelled mesostructures or on a measured BTF.

Their errors are of 8-bit images in [0, 1]; here values are π B, so that a white diffuser under perpendicular light has
1, in linear light. "Mean square error" there is said to be measured as Meseth et al. (2004) do, who take the mean of
absolute differences over all pairs of directions: both are given, average, least and largest over texels.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES, materials
from btfref.bench.options import Options
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from btfref.representations.laplacian.definition import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts


TEXELS, SPP = 64, 16

#: Numbers of components of Y in figure 6.
COMPONENTS = (1, 2, 3, 4, 6, 8, 10, 12, 16)


def run(options: Options) -> Facts:
    """Errors by material, setting, channel and number of components.

    Parameters
    ----------
    options : Options
        ``quick``: checker only. ``btf``: instead of the mesostructures. ``only``: some of the mesostructures.

    Returns
    -------
    dict
        ``summary``: by material, ``table`` by setting ("paper", "default") and channel with ``mse`` and ``mae``
        (average, minimum, maximum), ``components`` with the average of both for Y by number of components, ``bytes``;
        ``raw``: seconds.
    """
    from btfref.representations.laplacian import definition as laplacian

    options.demand(MESOSTRUCTURES)
    names = options.only or (MESOSTRUCTURES[:1] if options.quick else MESOSTRUCTURES)
    paper: Facts = laplacian.PRESETS["paper"]
    summary: Facts = {}
    raw: Facts = {}
    settings = {"texels": TEXELS, "spp": SPP, "estimator": "surface"}
    for name, data in materials(options.btf, names, progress=options.progress, **settings):
        channels = _channels(data)
        summary[name], raw[name] = {"table": {}, "bytes": {}}, {}
        for setting, parameters in {"paper": paper, "default": {}}.items():
            start = time.perf_counter()
            fitted = laplacian.fit(data, **parameters)
            raw[name][setting] = time.perf_counter() - start
            table = {c: _errors(fitted.tables(i), channels[i]) for i, c in enumerate(("Y", "Cb", "Cr"))}
            summary[name]["table"][setting] = table
            summary[name]["bytes"][setting] = _map_bytes(fitted)
        # Without prediction from compressed levels, fewer components are the first of more.
        most = laplacian.fit(data, **paper | {"components": (max(COMPONENTS), 1, 1)})
        summary[name]["components"] = {
            n: {k: v["average"] for k, v in _errors(_truncated(most, n).tables(0), channels[0]).items()}
            for n in COMPONENTS
        }
    return {
        "suite": "pyramid",
        "parameters": {"texels": TEXELS, "spp": SPP}
        if options.btf is None
        else {"shape": list(options.btf.values.shape)},
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def _channels(btf: SampledBTF) -> list[np.ndarray]:
    """π B in Y, Cb, Cr, each (texels, pairs) float32."""
    from btfref.numerics.solvers.lowrank import texel_matrix
    from btfref.numerics.ycbcr import FROM_RGB

    matrix = texel_matrix(btf.values).reshape(-1, btf.values.shape[0] * btf.values.shape[1], 3)
    return [matrix @ row.astype(np.float32) for row in FROM_RGB]


def _errors(found: np.ndarray, expected: np.ndarray) -> dict[str, dict[str, float]]:
    """Of π B, over the pairs of each texel: average, minimum and maximum over texels."""
    difference = np.pi * (found - expected)
    by_texel = {"mse": (difference**2).mean(1, dtype=float), "mae": np.abs(difference).mean(1, dtype=float)}
    return {
        key: {"average": float(e.mean()), "minimum": float(e.min()), "maximum": float(e.max())}
        for key, e in by_texel.items()
    }


def _truncated(representation: Representation, n: int) -> Representation:
    """The same with the first n components of Y only."""
    levels, maps = [], dict(representation.maps)
    for k, level in enumerate(representation.meta["levels"]):
        y, *colours = level["components"]
        keep = [*range(min(n, y)), *range(y, y + sum(colours))]
        for name in (f"basis_{k}", f"weights_{k}"):
            maps[name] = maps[name][..., keep]
        levels.append(level | {"components": [min(n, y), *colours]})
    return type(representation)(maps, representation.meta | {"levels": levels})


def _map_bytes(representation: Representation) -> int:
    from btfref.representations.file.container import payload_bytes

    maps = {name: (array.shape, array.dtype.name) for name, array in representation.maps.items()}
    return payload_bytes(maps, representation.meta)


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: the paper's table for both settings, then its figure."""
    header = ("material", "setting", "", "average", "minimum", "maximum", "mean |difference|")
    rows = []
    for name, found in result["summary"].items():
        for setting, channels in found["table"].items():
            for channel, e in channels.items():
                figures = [f"{e['mse'][k]:.5f}" for k in ("average", "minimum", "maximum")]
                rows.append((name, setting, f"MSE {channel}", *figures, f"{e['mae']['average']:.4f}"))
            rows.append((name, setting, "bytes", str(found["bytes"][setting]), "", "", ""))
        for n, e in found["components"].items():
            rows.append((name, "paper", f"MSE Y, {n} of Y", f"{e['mse']:.5f}", "", "", f"{e['mae']:.4f}"))
    return header, rows
