"""Are derivatives by maps right? Every method, storage, filter and map, alone and all together, and 20 steps of Adam.

The derivatives are those of `btfref.stress.gradients`: of the mean of a rendered picture, forward and backward, against
differences of means in float64. The steps begin at a map that was moved away, and go towards the picture of the map as
it was: of the largest error that a map can make up for, all can be undone.
"""

from __future__ import annotations

import inspect
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.conventions import FILTER_TYPES
from btfref.registry import methods
from btfref.stress.data import bumpy
from btfref.stress.gradients import STEPS

if TYPE_CHECKING:
    from btfref.registry import Method
    from btfref.types import Facts

#: Rows and columns of the data; derivatives do not know of more.
TEXELS = (8, 6)

#: Parameters of fits to so few texels.
SMALL = {"clusters": 4}

#: Storages, of methods that have a choice.
STORAGES = ("half", "float")


def run(options: Options) -> Facts:
    """Slopes by method, storage and filter.

    Parameters
    ----------
    options : Options
        ``quick``: halves and bilinear lookups, all maps together only. ``only``: some of the methods. ``btf``: in place
        of the suite's data.

    Returns
    -------
    dict
        ``summary``: "method, storage, filter" → ``slopes``: maps, difference, forward, backward, relative to the mean,
        and ``deviation``; ``steps``: map → RMSE over the mean before and after steps of Adam; ``gates``; ``warnings``:
        texts of warnings; ``raw``: seconds of processor time; ``parameters``; ``machine``.

    Raises
    ------
    InputError
        For a name in ``only`` that there is not.
    """
    from btfref.representations import save
    from btfref.stress.gradients import SIZE, SPP, STEP

    options.demand(methods())
    btf = options.btf or bumpy(0, TEXELS)
    keys = [key for key in methods() if options.wants(key)]
    summary: Facts = {}
    raw: Facts = {}
    with tempfile.TemporaryDirectory() as folder:
        for i, key in enumerate(keys):
            options.tell(i, len(keys), key)
            for storage, settings in _storages(methods()[key], quick=options.quick):
                path = Path(folder) / f"bench.{key}.{storage}.exr"
                save(methods()[key].fit(btf, **settings), path)
                for filter_type in FILTER_TYPES if not options.quick else ("bilinear",):
                    label = f"{key}, {storage}, {filter_type}"
                    start = time.process_time()
                    summary[label] = measured(path, filter_type, together=options.quick)
                    raw[label] = time.process_time() - start
    parameters = {"size": SIZE, "spp": SPP, "step": STEP, "texels": list(btf.texels)}
    return {
        "suite": "gradients",
        "parameters": parameters,
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def _storages(row: Method, *, quick: bool) -> Iterator[tuple[str, Facts]]:
    known = inspect.signature(row.fit).parameters
    settings = {name: value for name, value in SMALL.items() if name in known}
    if "storage" not in known:
        yield "half", settings
        return
    for storage in STORAGES[:1] if quick else STORAGES:
        yield storage, {**settings, "storage": storage}


def measured(path: Path, filter_type: str, *, together: bool = False) -> Facts:
    """Slopes of a file's maps, the verdict, and warnings that were given; ``together``: of all at once alone."""
    import mitsuba_plugins
    from btfref.stress.gradients import Subject, gradient_gates

    mitsuba_plugins.ready()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        subject = Subject(mitsuba_plugins.load(path, filter_type=filter_type))
        slopes = [subject.slope(subject.names)] if together else subject.slopes()
        walked = {} if together else {name: subject.approach(name) for name in subject.names}
    return {
        "slopes": [vars(slope) | {"deviation": slope.deviation, "silent": slope.silent} for slope in slopes],
        "steps": walked,
        "gates": [gate.to_dict() for gate in gradient_gates(slopes)],
        "warnings": [str(one.message) for one in told],
    }


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a method, storage, filter and map each."""
    rows = []
    for label, found in result["summary"].items():
        passed = all(gate["passed"] for gate in found["gates"]) and not found["warnings"]
        for slope in found["slopes"]:
            name = slope["maps"][0] if len(slope["maps"]) == 1 else "all"
            cells = (f"{slope[what]:+.3e}" for what in ("difference", "forward", "backward"))
            deviation = "silent" if slope["silent"] else f"{slope['deviation']:.1e}"
            before, after = found["steps"].get(name, (0.0, 0.0))
            steps = f"{before:.1e} to {after:.1e}" if before else "–"
            verdict = "pass" if passed else "FAIL"
            rows.append((*label.split(", "), name, *cells, deviation, steps, verdict))
    heads = ("difference / mean", "forward", "backward", "deviation", f"RMSE, {STEPS} steps", "")
    return ("method", "storage", "filter", "map", *heads), rows
