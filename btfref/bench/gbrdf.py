"""Decomposition into a g-BRDF: time by texels, heights and normals against the truth, error beside local PCA.

Menzel and Guthe 2009 report 3 hours for 256² texels, figure 6 for heights by three ways, and Table 1: RMS ΔE00 of 1.2
to 2 times that of local PCA at a tenth of the bytes.
"""

from __future__ import annotations

import time

import numpy as np

from btfref.bench.timing import machine

#: Pairs of directions whose pictures are compared by colour difference.
N_PICTURES = 64

#: Texels per side; times between them show whether cost is linear.
SIZES = (32, 64)


def run(*, quick=False, progress=None, btf=None, only=None):
    """Times and errors.

    Parameters
    ----------
    quick : bool
        The smaller size only.
    progress : callable, optional
    btf : SampledBTF, optional
        Instead of the checkers; heights are compared with the truth for checkers alone.
    only : iterable of str, optional
        Ignored: there is one method.

    Returns
    -------
    dict
        ``cases``: per BTF the seconds, microseconds a texel and pair, materials, bytes, height and normal errors of
        "ours", "correlation" and "Helmholtz", ``delta_e00`` of "gbrdf", "lpca" and "oracle" (the g-BRDF of the
        geometry itself).
    """
    from btfref.sampling.synthesis import synthesize

    if btf is not None:
        cases = [btf]
    else:
        sizes = SIZES[:1] if quick else SIZES
        cases = [
            synthesize("checker", texels=n, spp=16, estimator="surface", progress=progress) for n in sizes
        ]
    return {"suite": "gbrdf", "cases": [case(b, progress) for b in cases], "machine": machine()}


def case(btf, progress=None):
    """Figures of one BTF; see :func:`run`."""
    from btfref.decomposition import pipeline
    from btfref.registry import method
    from btfref.representations.container import payload_bytes
    from btfref.representations.gbrdf_geometry import from_mesostructure

    start = time.perf_counter()
    stages = {}
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
        result["heights"] = height_errors(btf, stages, others["oracle"])
    return result


def picture_error(representation, btf):
    """RMS ΔE00 over pictures of one view and one light each, under one exposure."""
    from btfref.compare.colour import delta_e00, fit_display

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


def height_errors(btf, stages, truth):
    """RMS error of heights in tiles and mean angle between normals in degrees, of ours and the paper's baselines."""
    from btfref.decomposition.heights import correlation_heights, helmholtz_stereopsis, similarity
    from btfref.decomposition.pairs import ReciprocalPairs
    from btfref.numerics.heightfield import HeightField

    pairs, layers = ReciprocalPairs(btf), stages["layers"]
    correlation = correlation_heights(similarity(pairs, layers), layers)
    helmholtz, slopes = helmholtz_stereopsis(pairs, layers)
    found = {
        "ours": (stages["fused"], None),
        "correlation": (correlation, None),
        "Helmholtz": (helmholtz, slopes),
    }
    result = {}
    for key, (heights, own) in found.items():
        own = HeightField(heights.astype(np.float32)).slopes if own is None else own
        result[key] = {
            "rms": float(np.sqrt(np.mean((heights - truth.field.heights) ** 2))),
            "angle": mean_angle(own, truth.field.slopes),
        }
    return result


def mean_angle(a, b):
    """Mean angle in degrees between the normals of two maps of slopes, shape (rows, columns, 2)."""
    normals = []
    for slopes in (a, b):
        normal = np.concatenate([-np.asarray(slopes, float), np.ones((*slopes.shape[:2], 1))], -1)
        normals.append(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    return float(np.degrees(np.arccos(np.clip((normals[0] * normals[1]).sum(-1), -1, 1))).mean())


def table(result):
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
