"""A method's evaluators against each other, and its sampling against its density."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from btfref.gates.verdicts import GateResult, Measured, judge
from btfref.numerics.device_arrays import to_device
from btfref.stress.evaluators import EVALUATORS, PORTS, evaluator, present, surface
from btfref.stress.judging import port_agreement
from btfref.stress.lookups import USUAL, hard_lookups, unit
from btfref.validate.sampling import chi_square

if TYPE_CHECKING:
    from btfref.types import JitArray, PathLike

#: Gates of a method on its own.
GATES = (
    "probe.agreement",
    "probe.finite",
    "image.witness",
    "chi2.rejected",
    "sample.weight",
    "sample.pdf",
    "fit.between_samples",
)

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


def probe_gates(path: PathLike, *, seed: int = 7) -> list[GateResult]:
    """The ports against the float64 definition at ordinary and awkward lookups, and at all levels of detail.

    WebGL 2 takes part where there is a Chromium.

    Parameters
    ----------
    path : path-like
        A representation.
    seed : int

    Returns
    -------
    list of GateResult
        ``probe.agreement`` of each port, and ``probe.finite``; the detail says whose.
    """
    from btfref.representations import load

    representation = load(path)
    lookups = hard_lookups(np.random.default_rng(seed), representation, PROBES, USUAL)
    gates, bad = [], 0
    reference = representation.evaluate(*lookups.points, lod=lookups.lod)
    for name in present(PORTS):
        value = evaluator(name, representation, path).evaluate(*lookups.points, lod=lookups.lod)
        found = port_agreement(value, representation, lookups.points, lookups.lod, reference=reference)
        gates += [gate.named(EVALUATORS[name].title) for gate in found.gates]
        bad += int(np.count_nonzero(~np.isfinite(value)))
    return gates + judge("probe.finite", {"nonfinite": Measured(bad)})


def sampling_gates(
    path: PathLike,
    *,
    samples: int,
    intervals: int | None = None,
    altered: Callable[[JitArray], JitArray] | None = None,
) -> list[GateResult]:
    """χ² of `sample()` against `pdf()`, and its weights against value over density.

    Parameters
    ----------
    path : path-like
        A representation.
    samples : int
        Of each of the tests; their significance is Šidák-corrected.
    intervals : int, optional
        As of :func:`btfref.validate.sampling.chi_square`.
    altered : callable, optional
        ``plugin -> plugin``: a fault.

    Returns
    -------
    list of GateResult
        ``chi2.rejected``, ``sample.weight``, ``sample.pdf``.
    """
    import mitsuba_plugins

    mi, plugin = mitsuba_plugins.ready(), mitsuba_plugins.load(path)
    plugin = altered(plugin) if altered else plugin
    failed: list[str] = []
    weights: list[float] = []
    pdfs: list[float] = []
    places = [(name, unit(view), uv) for name, view in VIEWS.items() for uv in UVS]
    for name, w_view, uv in places:
        right, message = chi_square(
            mi, plugin, uv, w_view, samples=samples, intervals=intervals, tests=len(places)
        )
        if not right:
            failed.append(f"{name} view, uv {uv}: {message}")
        weight, pdf = _weights(mi, plugin, uv, w_view)
        weights.append(weight)
        pdfs.append(pdf)
    detail = "; ".join(failed) or f"{len(places)} tests of {samples} samples"
    rejected = Measured(len(failed), None, detail)
    return [
        *judge("chi2.rejected", {"tests": rejected}),
        *judge("sample.weight", {"max": max(weights)}),
        *judge("sample.pdf", {"max": max(pdfs)}),
    ]


def _weights(
    mi: ModuleType, plugin: JitArray, uv: tuple[float, float], w_view: np.ndarray, n: int = 1 << 13
) -> tuple[float, float]:
    """Largest error of weight × density against the value, and of the density, relative."""
    rng, context = np.random.default_rng(5), mi.BSDFContext()
    si = surface(mi, n, uv, w_view)
    bs, weight = plugin.sample(
        context, si, to_device(mi.Float, rng.random(n)), to_device(mi.Point2f, rng.random((2, n)))
    )
    value, pdf = np.array(plugin.eval(context, si, bs.wo)), np.array(plugin.pdf(context, si, bs.wo))
    floor = 1e-3 * max(float(np.abs(value).max()), 1e-30)
    error = np.abs(np.array(weight) * pdf - value) / np.maximum(np.abs(value), floor)
    return float(error.max()), float((np.abs(np.array(bs.pdf) - pdf) / np.maximum(pdf, 1e-30)).max())
