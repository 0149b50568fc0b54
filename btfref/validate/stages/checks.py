"""A method's own checks on one mesostructure: evaluators, sampling, errors at directions that nobody fitted."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.comparison.comparison import json_safe
from btfref.gates.verdicts import judged
from btfref.validate.cache import key_of
from btfref.validate.stages.drawn import code_of
from btfref.validate.stages.fits import fit_key, make_fit
from btfref.validate.stages.off_grid import off_grid_errors, truth_key

if TYPE_CHECKING:
    from btfref.types import Facts
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings


def make_checks(cache: Cache, mesostructure: str, method: str, settings: Settings) -> Facts:
    """Measure, or read, what is measured of a method, and judge it by the limits as they are now.

    Returns
    -------
    dict
        ``gates`` of its evaluators and its sampling, ``off_grid``, ``bytes``, ``fit``, ``seconds``.
    """
    key = key_of(
        {
            "checks": fit_key(mesostructure, method, settings),
            "code": code_of(__name__, method),
            "browser": settings.browser_ways,
            "samples": [settings.chi2_samples, settings.chi2_intervals],
            "off_grid": truth_key(mesostructure, settings),
        }
    )

    def save(path: Path) -> None:
        path.write_text(json.dumps(_measured(cache, mesostructure, method, settings)), "utf-8")

    found: Facts = json.loads(cache.get(key, ".checks.json", save).read_text("utf-8"))
    gates = [judged(measurement) for measurement in found.pop("measured")]
    return json_safe({"gates": [gate.to_dict() for gate in gates], **found})


def _measured(cache: Cache, mesostructure: str, key: str, settings: Settings) -> Facts:
    from btfref.representations.file.container import read_info
    from btfref.stress.between_samples import between_gates
    from btfref.validate.method_gates import probe_gates, sampling_gates
    from btfref.validate.stages.browser import environment_gates
    from btfref.validate.witness.gates import testify

    start = time.perf_counter()
    file = make_fit(cache, mesostructure, key, settings)
    gates = [*probe_gates(file), *testify(file).gates(), *environment_gates(file, settings.browser_ways)]
    gates += sampling_gates(file, samples=settings.chi2_samples, intervals=settings.chi2_intervals)
    info = read_info(file)
    gates += between_gates(key, info["fit"].get("between_samples", {}))
    error = off_grid_errors(cache, mesostructure, file, settings)
    return json_safe(
        {
            "measured": [gate.measurement() for gate in gates],
            "off_grid": error,
            "bytes": info["payload_bytes"],
            "fit": info["fit"],
            "seconds": time.perf_counter() - start,
        }
    )
