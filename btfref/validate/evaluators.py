"""A method's three evaluators against each other, and its sampling against its density."""

from __future__ import annotations

import numpy as np

from btfref.comparison.comparison import agreement
from btfref.gates.verdicts import Measured, judge
from btfref.validate.probes import hit_allowance, probe_points, unit
from btfref.validate.sampling import chi_square, surface

#: Gates of a method on its own.
GATES = ("probe.agreement", "probe.finite", "chi2.rejected", "sample.weight", "sample.pdf")

#: Lookups of each evaluator.
PROBES = 8000

#: Texture coordinates and views of the χ² tests: a texel's middle and a place between texels, steep and grazing.
UVS = ((0.31, 0.47), (0.83, 0.12))
VIEWS = {
    name: np.array(w)
    for name, w in {
        "normal": (0.0, 0.0, 1.0),
        "oblique": (0.5, -0.4, 0.77),
        "grazing": (0.1, 0.99, 0.08),
    }.items()
}


def probe_gates(path, *, seed=7):
    """Both ports against the float64 definition at ordinary and awkward lookups, and at all levels of detail.

    Parameters
    ----------
    path : path-like
        A representation.
    seed : int

    Returns
    -------
    list of GateResult
        ``probe.agreement`` of Dr.Jit, then of GLSL, and ``probe.finite``; the detail says whose.
    """
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations import load
    from btfref.representations.protocol import max_lod
    from btfref.stress.evaluators import definition, port
    from btfref.stress.lookups import Lookups

    representation = load(path)
    arrays = representation.arrays()
    views, lights = (
        DirectionSet(arrays[f"{name}_directions"].astype(float), "custom") for name in ("view", "light")
    )
    rng = np.random.default_rng(seed)
    points = probe_points(rng, PROBES, views, lights)
    lod = rng.uniform(0, max_lod(representation), PROBES).astype(np.float32)
    drawn = [np.zeros(PROBES, np.uint8)] * 4
    lookups = Lookups(*points, lod, *drawn)
    reference = definition(representation, lookups)
    gates, bad = [], 0
    for key, name in {"drjit": "Dr.Jit", "glsl": "GLSL"}.items():
        value = port(key, representation, path)(lookups)
        allowance = hit_allowance(representation, value, reference, points)
        found = agreement(value, reference, allowance=allowance)
        gates += [_named(gate, name) for gate in found.gates]
        bad += int(np.count_nonzero(~np.isfinite(value)))
    return gates + judge("probe.finite", {"nonfinite": Measured(bad)})


def _named(gate, whose):
    from dataclasses import replace

    return replace(gate, detail=f"{whose}{': ' if gate.detail else ''}{gate.detail}")


def sampling_gates(path, *, samples, altered=None):
    """χ² of `sample()` against `pdf()`, and its weights against value over density.

    Parameters
    ----------
    path : path-like
        A representation.
    samples : int
        Of each of the tests; their significance is Šidák-corrected.
    altered : callable, optional
        ``plugin -> plugin``: a fault.

    Returns
    -------
    list of GateResult
        ``chi2.rejected``, ``sample.weight``, ``sample.pdf``.
    """
    mi, plugin = _plugin(path)
    plugin = altered(plugin) if altered else plugin
    failed, weights, pdfs = [], [], []
    places = [(name, unit(view), uv) for name, view in VIEWS.items() for uv in UVS]
    for name, w_view, uv in places:
        right, message = chi_square(mi, plugin, uv, w_view, samples=samples, tests=len(places))
        if not right:
            failed.append(f"{name} view, uv {uv}: {message}")
        weight, pdf = _weights(mi, plugin, uv, w_view)
        weights.append(weight)
        pdfs.append(pdf)
    detail = "; ".join(failed) or f"{len(places)} tests of {samples} samples"
    rejected = Measured(len(failed), "fail" if failed else "pass", detail)
    return [
        *judge("chi2.rejected", {"tests": rejected}),
        *judge("sample.weight", {"max": max(weights)}),
        *judge("sample.pdf", {"max": max(pdfs)}),
    ]


def _weights(mi, plugin, uv, w_view, n=1 << 13):
    """Largest error of weight × density against the value, and of the density, relative."""
    rng, context = np.random.default_rng(5), mi.BSDFContext()
    si = surface(mi, n, uv, w_view)
    bs, weight = plugin.sample(context, si, mi.Float(rng.random(n)), mi.Point2f(rng.random((2, n))))
    value, pdf = np.array(plugin.eval(context, si, bs.wo)), np.array(plugin.pdf(context, si, bs.wo))
    floor = 1e-3 * max(float(np.abs(value).max()), 1e-30)
    error = np.abs(np.array(weight) * pdf - value) / np.maximum(np.abs(value), floor)
    return float(error.max()), float((np.abs(np.array(bs.pdf) - pdf) / np.maximum(pdf, 1e-30)).max())


def _plugin(path, **parameters):
    from btfref.platform import prepare_llvm
    from btfref.scene import parsing

    prepare_llvm()
    import mitsuba as mi

    import mitsuba_plugins

    if mi.variant() is None or "llvm" not in mi.variant():
        parsing.use_variant("llvm_ad_rgb")
    mitsuba_plugins.register()
    return mi, mi.load_dict({"type": "btf", "filename": str(path), **parameters})
