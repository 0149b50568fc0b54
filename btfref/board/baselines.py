"""Rows of the suite's own methods: entries of a plan, fitted to the grids of a data set and asked its test queries."""

from __future__ import annotations

import json
import re
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from btfref.bench import measures
from btfref.bench.subjects import build
from btfref.board.rows import ENDING, write_row
from btfref.datasets import sets
from btfref.datasets.package import dataset
from btfref.errors import InputError
from btfref.outputs import new_file
from btfref.provenance import __version__
from btfref.querying.lookups import lookups

if TYPE_CHECKING:
    from btfref.bench.plan import Entry, Plan
    from btfref.bench.subjects import Built
    from btfref.datasets.package import Package
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike, Progress

#: Places of a footprint that a method without levels is asked at.
LOOKUPS = 4

#: Pairs of directions and places of `energy_and_reciprocity`.
_VIEWS, _PLACES = 8, 16

#: Pixels along a side of a picture, and where they look from and are lit from: polar angle and azimuth, degrees.
_SIDE, _VIEW, _LIGHT = 48, (55, 270), (40, 60)


def run(
    plan: Plan,
    name: str,
    out: PathLike,
    *,
    tier: str = "toy",
    folder: PathLike,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a row for each entry of a plan; materials are added to rows of the same versions that are there.

    Parameters
    ----------
    plan : btfref.bench.plan.Plan
        Whose entries are fitted with its seed; with "eval" among its measures they are timed on one material.
    name : str
        "SET", or "SET/MATERIAL".
    out : path-like
        Folder of the rows, made where it is not there.
    tier : str
    folder : path-like
        Of the set's packages; those that are missing are made.
    progress : callable, optional

    Returns
    -------
    list of Path
        Files of the rows.
    """
    chosen, materials = sets.find(name)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    total, done = len(materials) * len(plan.entries), 0
    written = {entry.name: out / f"{_file_name(entry.name)}{ENDING}" for entry in plan.entries}
    for material in materials:
        package = dataset(f"{chosen.name}/{material.name}", tier=tier, folder=folder)
        btf = package.grid(variance=False)
        facts = {"set": chosen.name, "set_version": chosen.version, "tier": tier}
        facts["fitted"] = f"grid {package.grids[-1]}"
        built: dict[str, Built] = {}
        for entry in plan.entries:
            if progress is not None:
                progress(done, total, f"{material.name}: {entry.name}")
            start = time.process_time()
            payload = built[entry.bytes_of].payload if entry.bytes_of else None
            built[entry.name] = made = build(entry, btf, seed=plan.seed, payload=payload)
            seconds = time.process_time() - start
            row = _row(written[entry.name], _about(entry) | facts)
            row["materials"][material.name] = {
                **_answered(made, package, out, _file_name(entry.name)),
                "bytes": made.payload,
                "fit_seconds": seconds,
                **energy_and_reciprocity(made),
            }
            if "eval" in plan.measures and "evaluate_ns" not in row:
                row["evaluate_ns"] = _times(made, entry, plan)
            write_row(written[entry.name], row)
            done += 1
    if progress is not None:
        progress(total, total, "rows")
    return list(written.values())


def _row(path: Path, about: Facts) -> Facts:
    """A row without materials, or the one that is there where it is of the same method, set and versions."""
    try:
        found = json.loads(path.read_text("utf-8"))
        same = all(found.get(key) == value for key, value in about.items())
    except (OSError, ValueError, AttributeError):
        same = False
    return found if same else about | {"materials": {}}


def _about(entry: Entry) -> Facts:
    """What a row says of its method."""
    setting = entry.name.removeprefix(entry.method or entry.peer).strip(" (,").rstrip(")")
    return {
        "method": entry.method or entry.name,
        "setting": setting if entry.method else "",
        "by": "btfref" if entry.method else "btfref, a peer",
        "suite": __version__,
    }


def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-").lower()


class _Asked:
    """Whatever evaluates, as lookups take it."""

    def __init__(self, built: Built) -> None:
        self.evaluate = built.evaluate


def _answered(built: Built, package: Package, out: Path, name: str) -> Facts:
    """Files of answers and of a picture, relative to the rows' folder."""
    subject = cast("Representation", _Asked(built))
    answers = []
    for number, footprint in enumerate(sets.FOOTPRINTS):
        rows = package.test(footprint)
        count = np.arange(len(rows["B"]))
        seed = sets.TEST_SEED + number
        found = lookups(subject, rows, count, footprint="square", count=LOOKUPS, seed=seed)
        answers.append(found["B"])
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    material = package.manifest["material"]
    with new_file(folder / f"{material}.npy") as draft:
        np.save(draft, np.concatenate(answers))
    with new_file(folder / f"{material}.png") as draft:
        draft.write_bytes(pictured(built))
    return {"answers": f"{name}/{material}.npy", "picture": f"{name}/{material}.png"}


def pictured(built: Built) -> bytes:
    """One tile seen from the side, as the third of a package's pictures, PNG."""
    from btfref.datasets.picture import EXPOSURE
    from btfref.datasets.truth import centres
    from btfref.images.png import encode_png
    from btfref.numerics.colour import encode_srgb
    from btfref.numerics.sphere.directions import spherical

    uv = centres(_SIDE)
    view, light = (np.tile(spherical(*np.radians(pair)), (len(uv), 1)) for pair in (_VIEW, _LIGHT))
    shown = built.evaluate(uv, light, view).reshape(_SIDE, _SIDE, 3)[::-1] * EXPOSURE / light[0, 2]
    return encode_png(np.rint(255 * encode_srgb(np.clip(shown, 0, 1))).astype(np.uint8))


def energy_and_reciprocity(built: Built) -> dict[str, float]:
    """Largest share of light that is reflected, and how far swapped directions are apart.

    Parameters
    ----------
    built : Built

    Returns
    -------
    dict
        ``energy``: the largest over lights, places and channels of ∫ B cos θ_view / cos θ_light dω_view;
        ``reciprocity``: the root mean square of f(l, v) − f(v, l) over that of f. No texel of a BTF need be reciprocal.
    """
    from btfref.numerics.sphere.directions import directions

    grid = directions("6x12")
    weights = grid.quadrature_weights
    rng = np.random.default_rng(0)
    uv = rng.random((_PLACES, 2))
    some = grid.vectors[rng.choice(len(grid), _VIEWS, replace=False)]
    n = len(grid)
    place = np.repeat(uv, _VIEWS * n, 0)
    light = np.tile(np.repeat(some, n, 0), (_PLACES, 1))
    view = np.tile(grid.vectors, (_PLACES * _VIEWS, 1))
    here, there = (built.evaluate(place, *pair) for pair in ((light, view), (view, light)))
    f, swapped = here / light[:, 2:], there / view[:, 2:]
    cosine = (weights * grid.vectors[:, 2])[None, None, :, None]
    share = (f.reshape(_PLACES, _VIEWS, n, 3) * cosine).sum(2)
    size = max(float((f**2).mean()), 1e-300)
    return {
        "energy": float(max(share.max(), 0.0)),
        "reciprocity": float(np.sqrt(((f - swapped) ** 2).mean() / size)),
    }


def _times(built: Built, entry: Entry, plan: Plan) -> dict[str, float]:
    """Nanoseconds of an evaluation by all evaluators that this machine has."""
    found: dict[str, Any] = {}
    rng = np.random.default_rng(plan.seed)
    with tempfile.TemporaryDirectory() as folder:
        path = measures.saved(built, entry, Path(folder))
        for record in measures.measure_eval(built, path, plan, entry, rng):
            if record["evaluator"] not in found:  # of the first way of lookup
                found[record["evaluator"]] = 1e9 * statistics.median(record["warm_s"]) / record["points"]
    return found


def refuse_other_data(plan: Plan, btf: object) -> None:
    """InputError where a plan is run on a data set and on something else as well."""
    if btf is not None:
        raise InputError("a plan on a data set takes its grids", field="--btf", expected="--dataset alone")
    if not plan.entries:
        raise InputError("a plan without entries", field="--only")
