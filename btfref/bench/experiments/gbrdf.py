"""Decomposition into a g-BRDF: time by texels, heights and normals against the truth, error beside local PCA.

Menzel and Guthe 2009 report 3 hours for 256² texels, figure 6 for heights by three ways, and Table 1: RMS ΔE00 of 1.2
to 2 times that of local PCA at a tenth of the bytes.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from btfref.numerics.heightfield import HeightField
    from btfref.report import Cell
    from btfref.representations.gbrdf.definition import Representation as Microfacets
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, Progress


#: Pairs of directions whose pictures are compared by colour difference.
N_PICTURES = 64

#: Pixels per side of a texel in the report.
_ENLARGED = 4

#: Texels per side; times between them show whether cost is linear.
SIZES = (32, 64)


def run(options: Options) -> Facts:
    """Times and errors.

    Parameters
    ----------
    options : Options
        ``quick``: the smaller size only. ``btf``: instead of the checkers; heights are compared with the truth for
        checkers alone. ``only``: "gbrdf": there is one method. ``report``: HTML page with the maps, where the truth
        is known.

    Returns
    -------
    dict
        ``cases``: per BTF the seconds, microseconds a texel and pair, materials, bytes, height and normal errors of
        "ours", "correlation" and "Helmholtz", ``delta_e00`` of "gbrdf", "lpca" and "oracle" (the g-BRDF of the
        geometry itself), ``areas``: texels of each material, and ``colours``: mean c_d over the texels of each true
        material, of "ours" and "truth".
    """
    from btfref.sampling.synthesis import synthesize

    options.demand(("gbrdf",))
    if options.btf is not None:
        cases = [options.btf]
    else:
        sizes = SIZES[:1] if options.quick else SIZES
        cases = [
            synthesize("checker", texels=n, spp=16, estimator="surface", progress=options.progress)
            for n in sizes
        ]
    cells: list[Cell] = []
    result: Facts = {
        "suite": "gbrdf",
        "cases": [case(b, options.progress, cells) for b in cases],
        "machine": machine(),
    }
    if options.report is not None:
        from btfref.report import write_report

        write_report(options.report, title="Decomposition into g-BRDFs", cells=cells, facts=result["machine"])
    return result


def case(btf: SampledBTF, progress: Progress | None = None, cells: list[Cell] | None = None) -> Facts:
    """Figures of one BTF; see :func:`run`. A list ``cells`` takes the parts of a report."""
    from btfref.registry import method
    from btfref.representations.file.container import payload_bytes
    from btfref.representations.gbrdf.decomposition import pipeline
    from btfref.representations.gbrdf.geometry import from_mesostructure

    start = time.perf_counter()
    stages: Facts = {}
    made = pipeline.fit(btf, progress=progress, intermediates=stages)
    seconds = time.perf_counter() - start
    pairs = len(btf.views) * len(btf.lights) * int(np.prod(btf.texels))
    others = {"gbrdf": made, "lpca": method("lpca").fit(btf, clusters=16, components=4)}
    parent = btf.attributes.get("parent", {})
    name, parameters = parent.get("name"), parent.get("parameters", {})
    known = name in ("checker", "rings", "tissue", "flat")
    if known:
        others["oracle"] = from_mesostructure(name, texels=btf.texels[0], **parameters)
    result = {
        "mesostructure": name,
        "shape": list(btf.values.shape),
        "seconds": seconds,
        "microseconds_per_sample": 1e6 * seconds / pairs,
        "materials": made.meta["fit"]["materials"],
        "separation": made.meta["fit"]["separation"],
        "bytes": {
            key: payload_bytes({k: (a.shape, a.dtype.name) for k, a in rep.arrays().items()}, rep.meta)
            for key, rep in others.items()
        },
        "delta_e00": {key: picture_error(rep, btf) for key, rep in others.items()},
    }
    if known:
        truth = others["oracle"]
        fields = height_fields(btf, stages)
        result["heights"] = height_errors(fields, truth.field)
        result |= material_figures(made, truth)
        if cells is not None:
            cells += map_cells(f"{name} {btf.texels[0]}²", fields, made, truth)
    return result


def material_figures(made: Microfacets, truth: Microfacets) -> Facts:
    """``areas`` and ``colours`` of materials, found and true; see :func:`run`."""
    part = truth.maps["material"][..., 0]
    both = {"ours": made, "truth": truth}
    return {
        "areas": {
            key: np.bincount(rep.maps["material"].ravel().astype(int)).tolist() for key, rep in both.items()
        },
        "colours": {
            key: [rep.maps["diffuse"][part == k].astype(float).mean(0).tolist() for k in np.unique(part)]
            for key, rep in both.items()
        },
    }


def picture_error(representation: Representation, btf: SampledBTF) -> float:
    """RMS ΔE00 over pictures of one view and one light each, under one exposure."""
    from btfref.comparison.colour import delta_e00
    from btfref.images.display import fit_display

    rows, columns = btf.texels
    rng = np.random.default_rng(0)
    view, light = (rng.integers(0, len(s), N_PICTURES) for s in (btf.views, btf.lights))
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    test = representation.evaluate(
        np.stack([u, v], -1)[None],
        btf.lights.vectors[light][:, None, None],
        btf.views.vectors[view][:, None, None],
    ).reshape(-1, columns, 3)
    reference = btf.values[view, light].astype(float).reshape(-1, columns, 3)
    error = delta_e00(test, reference, fit_display(reference))
    return float(np.sqrt((error**2).mean()))


def height_fields(btf: SampledBTF, stages: Facts) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Heights in tiles and slopes by name: ours and the paper's two baselines."""
    from btfref.numerics.heightfield import HeightField
    from btfref.representations.gbrdf.decomposition.heights import (
        correlation_heights,
        helmholtz_stereopsis,
        similarity,
    )
    from btfref.representations.gbrdf.decomposition.pairs import ReciprocalPairs

    pairs, layers = ReciprocalPairs(btf), stages["layers"]
    correlation = correlation_heights(similarity(pairs, layers), layers)
    helmholtz, slopes = helmholtz_stereopsis(pairs, layers)
    found = {
        "ours": (stages["fused"], None),
        "correlation": (correlation, None),
        "Helmholtz": (helmholtz, slopes),
    }
    return {
        key: (heights, HeightField(heights.astype(np.float32)).slopes if own is None else own)
        for key, (heights, own) in found.items()
    }


def height_errors(
    fields: dict[str, tuple[np.ndarray, np.ndarray]], truth: HeightField
) -> dict[str, dict[str, float]]:
    """RMS error of heights in tiles and mean angle between normals in degrees, of :func:`height_fields`."""
    return {
        key: {
            "rms": float(np.sqrt(np.mean((heights - truth.heights) ** 2))),
            "angle": mean_angle(slopes, truth.slopes),
        }
        for key, (heights, slopes) in fields.items()
    }


def map_cells(
    name: str, fields: dict[str, tuple[np.ndarray, np.ndarray]], made: Microfacets, truth: Microfacets
) -> list[Cell]:
    """Parts of a report: heights, normals, materials and colours beside the truth."""
    from btfref.comparison import compare
    from btfref.report import Cell
    from btfref.representations.gbrdf.maps import PALETTE

    low, high = truth.field.bottom, truth.field.top
    depth = max(high - low, 1e-6)
    every = fields | {"truth": (truth.field.heights, truth.field.slopes)}
    heights = {
        key: np.repeat(np.clip((h - low) / depth, 0, 1)[..., None], 3, -1) for key, (h, _) in every.items()
    }
    normals = {key: 0.5 + 0.5 * unit_normals(slopes) for key, (_, slopes) in every.items()}
    reps = {"ours": made, "truth": truth}
    colours = {key: rep.maps["diffuse"] for key, rep in reps.items()}
    palette = np.array(PALETTE) / 255
    materials = {key: palette[rep.maps["material"][..., 0] % len(palette)] for key, rep in reps.items()}
    cells = []
    for what, images in (
        ("heights", heights),
        ("normals", normals),
        ("diffuse colour", colours),
        ("materials", materials),
    ):
        shown = {"reference": images.pop("truth"), **images}
        large = {
            k: np.kron(v, np.ones((_ENLARGED, _ENLARGED, 1))).astype(np.float32) for k, v in shown.items()
        }
        comparison = compare(large["ours"], large["reference"], flip=False)
        cells.append(Cell(f"{name} · {what}", large, comparison, "The reference is the modelled geometry."))
    return cells


def mean_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Mean angle in degrees between the normals of two maps of slopes, shape (rows, columns, 2)."""
    product = (unit_normals(a) * unit_normals(b)).sum(-1)
    return float(np.degrees(np.arccos(np.clip(product, -1, 1))).mean())


def unit_normals(slopes: np.ndarray) -> np.ndarray:
    """Normals of slopes, shape (..., 2) -> (..., 3)."""
    slopes = np.asarray(slopes, float)
    normal = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], -1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people."""
    header = ("BTF", "s", "µs/sample", "materials", "kB", "ΔE00", "lpca", "oracle", "heights RMS, normals °")
    rows = []
    for c in result["cases"]:
        heights = c.get("heights", {})
        rows.append(
            (
                f"{c['mesostructure']} {c['shape'][2]}²",
                f"{c['seconds']:.1f}",
                f"{c['microseconds_per_sample']:.2f}",
                str(c["materials"]),
                f"{c['bytes']['gbrdf'] / 1000:.0f}",
                *(
                    f"{c['delta_e00'][k]:.2f}" if k in c["delta_e00"] else ""
                    for k in ("gbrdf", "lpca", "oracle")
                ),
                ", ".join(f"{k} {h['rms']:.4f} {h['angle']:.1f}" for k, h in heights.items()),
            )
        )
    return header, rows
