"""Run time against error: plans (TOML) over all methods, and suites of their own for what no plan can say.

A plan is run by :mod:`btfref.bench.matrix`. A suite is a module with ``run(options) -> dict``, see
:class:`btfref.bench.options.Options`, and ``table(result) -> header, rows``.
"""

from __future__ import annotations

#: Suites by name.
SUITES = {
    "between": "btfref.bench.experiments.between",
    "demand": "btfref.bench.demand",
    "directions": "btfref.bench.experiments.directions",
    "env": "btfref.bench.experiments.env",
    "factors": "btfref.bench.experiments.factors",
    "gbrdf": "btfref.bench.experiments.gbrdf",
    "loading": "btfref.bench.experiments.loading",
    "lobes": "btfref.bench.experiments.lobes",
    "lod": "btfref.bench.experiments.lod",
    "gradients": "btfref.bench.optimisation.gradients",
    "offgrid": "btfref.bench.experiments.offgrid",
    "proposals": "btfref.bench.experiments.proposals",
    "pyramid": "btfref.bench.experiments.pyramid",
    "queries": "btfref.bench.experiments.queries",
    "refinement": "btfref.bench.optimisation.refinement",
    "reflectance": "btfref.bench.experiments.reflectance",
    "synth": "btfref.bench.synth",
}

#: Suites that make pictures: those that can write a page.
PICTURED = ("gbrdf", "lod")
