"""Run time against error: plans (TOML) over all methods, and suites of their own for what no plan can say.

A plan is run by :mod:`btfref.bench.matrix`. A suite is a module with ``run(*, quick, progress, btf, only) -> dict`` and
``table(result) -> header, rows``.
"""

from __future__ import annotations

#: Suites by name.
SUITES = {
    "demand": "btfref.bench.demand",
    "env": "btfref.bench.env",
    "factors": "btfref.bench.factors",
    "gbrdf": "btfref.bench.gbrdf",
    "lobes": "btfref.bench.lobes",
    "lod": "btfref.bench.lod",
    "proposals": "btfref.bench.proposals",
    "pyramid": "btfref.bench.pyramid",
    "reflectance": "btfref.bench.reflectance",
    "synth": "btfref.bench.synth",
}
