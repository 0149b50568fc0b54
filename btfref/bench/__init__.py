"""Run time against error: suites of benchmarks, each a function that returns its raw times and its summary."""

from __future__ import annotations

#: Suites by name: module with ``run(*, quick, progress, btf, only) -> dict`` and ``table(result) -> rows``.
SUITES = {
    "environment": "btfref.bench.environment",
    "factors": "btfref.bench.factors",
    "fit": "btfref.bench.fit",
    "gbrdf": "btfref.bench.gbrdf",
    "lobes": "btfref.bench.lobes",
    "lod": "btfref.bench.lod",
    "pyramid": "btfref.bench.pyramid",
    "reflectance": "btfref.bench.reflectance",
    "render": "btfref.bench.render",
    "synth": "btfref.bench.synth",
}
