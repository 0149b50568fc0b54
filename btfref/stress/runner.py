"""The stress run: every registered method, on all data, through all evaluators."""

from __future__ import annotations

import inspect
import shlex
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import malformed
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.registry import method, usable_methods
from btfref.stress import properties
from btfref.stress.data import DATA, make, scattered
from btfref.stress.evaluators import DEFINITION, EVALUATORS, MEASURED, Evaluator, evaluator, present
from btfref.stress.judging import Finding, judge_values, limit_finding, valid_lookups
from btfref.stress.lookups import BLOCK, Lookups, block

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.types import Facts, Progress

#: Data whose kernels the path tracer's port is compiled for in a short run, and blocks of lookups of each in both.
SHORT_DATA, SHORT_BLOCKS, LONG_BLOCKS = ("bumpy", "scattered", "wide range"), 1, 4

#: Further storages that a method's fit may offer, beside its default.
STORAGES = ("half", "float", "byte")

#: Data that the checks of fits look at.
PROPERTY_DATA = ("bumpy",)


def run(
    *,
    only: Iterable[str] | None = None,
    data: Iterable[str] | None = None,
    evaluators: Iterable[str] | None = None,
    long: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Facts:
    """All checks.

    Parameters
    ----------
    only : iterable of str, optional
        Keys of methods; default all.
    data : iterable of str, optional
        Names in :data:`btfref.stress.data.DATA`; default all, and the checks of fits.
    evaluators : iterable of str, optional
        Ports; default all that this machine can run.
    long : bool
        More lookups, and all ports on all data and storages: above 10⁶ lookups.
    seed : int
    progress : callable, optional

    Returns
    -------
    dict
        ``findings``: list of `Finding`; ``cases``: lookups and comparisons judged; ``failures``; ``explained``;
        ``parameters``.

    Raises
    ------
    InputError
        Unknown names.
    """
    keys = list(usable_methods()) if only is None else [method(key).key for key in only]
    names = list(DATA) if data is None else list(data)
    for name in names:
        if name not in DATA:
            raise InputError("unknown data", field="--data", got=repr(name), expected=", ".join(DATA))
    ports = present(MEASURED) if evaluators is None else tuple(evaluators)
    for name in ports:
        if name not in MEASURED:
            raise InputError(
                "unknown evaluator", field="--evaluator", got=repr(name), expected=", ".join(MEASURED)
            )
    report = progress or (lambda *_: None)
    findings: list[Finding] = []
    total = len(keys) * (len(names) + (data is None))
    for i, key in enumerate(keys):
        for j, name in enumerate(names):
            report(i * (total // len(keys)) + j, total, f"{key}, {name}")
            # The definition always runs; what compiles only where the run is long or the data ask for it.
            every = long or data is not None or name in SHORT_DATA
            some = [p for p in ports if every or not EVALUATORS[p].compiles]
            findings += stress_data(key, name, some, seed=seed, long=long)
        if data is None:
            report((i + 1) * (total // len(keys)) - 1, total, f"{key}, fits")
            findings += stress_fits(key)
    if data is None:
        findings += stress_directions()
    report(total, total, "done")
    return {
        "suite": "stress",
        "findings": findings,
        "cases": sum(f.cases for f in findings),
        "failures": sum(f.failures for f in findings),
        "explained": sum(f.explained for f in findings),
        "parameters": {
            "methods": keys,
            "data": names,
            "evaluators": list(ports),
            "absent": [] if evaluators is not None else [name for name in MEASURED if name not in ports],
            "seed": seed,
            "long": long,
        },
    }


def stress_data(
    key: str, name: str, ports: Iterable[str], *, seed: int = 0, long: bool = False
) -> Iterator[Finding]:
    """Fit one method to one data set, or see it refuse; then all its lookups.

    Yields
    ------
    Finding
    """
    row = method(key)
    btf = make(name, seed)
    kinds: list[str | None] = [None]
    if long and name in SHORT_DATA and "storage" in inspect.signature(row.fit).parameters:
        kinds += STORAGES
    for kind in kinds:
        further = {} if kind is None else {"storage": kind}
        label = name if kind is None else f"{name}, {kind}"
        try:
            made = row.quick_fit(btf, **further)
        except InputError as refusal:
            if kind is None or refusal.field != "storage":
                yield limit_finding("refusal", key, label, 0, "stress.refusal.silent", where=str(refusal))
            continue
        yield from stress_lookups(made, label, ports, seed=seed, blocks=LONG_BLOCKS if long else SHORT_BLOCKS)
        if kind is None:
            yield from properties.continuous(row, made, label, seed=seed)


def stress_lookups(
    representation: Representation,
    name: str,
    ports: Iterable[str],
    *,
    seed: int = 0,
    blocks: int = 1,
    n: int = BLOCK,
) -> Iterator[Finding]:
    """Blocks of lookups through the definition and the ports.

    Parameters
    ----------
    representation : Representation
    name : str
        Of the data.
    ports : iterable of str
    seed, blocks, n : int

    Yields
    ------
    Finding
    """
    from btfref.representations import load, save

    key = representation.meta["method"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"stress.{key}.exr"
        save(representation, path)
        # What the ports see is what was stored.
        representation = load(path)
        sets = [block(representation, seed, number, n) for number in range(blocks)]
        references = _values(evaluator(DEFINITION, representation, path), sets)
        yield _definition_finding(representation, name, sets, references)
        for which in ports:
            port = evaluator(which, representation, path)
            values = _values(port, sets)
            yield _port_finding(representation, name, which, sets, references, values, seed)
            yield _count_finding(representation, name, which, sets, port)


def _values(port: Evaluator, sets: Sequence[Lookups]) -> list[np.ndarray]:
    return [port.evaluate(*lookups.points, lod=lookups.lod) for lookups in sets]


def _definition_finding(
    representation: Representation, name: str, sets: Sequence[Lookups], references: Sequence[np.ndarray]
) -> Finding:
    """The definition is finite, and exactly 0 where a direction is none; its sign is what its class says."""
    key = representation.meta["method"]
    bad, where = 0, ""
    lowest, largest = 0.0, 1e-300
    for lookups, reference in zip(sets, references, strict=True):
        wrong = ~np.isfinite(reference).all(1) | (~valid_lookups(lookups) & (reference != 0).any(1))
        if wrong.any() and not where:
            where = lookups.where(int(np.argmax(wrong)))
        bad += int(wrong.sum())
        lowest = min(lowest, float(np.nanmin(reference, initial=0)))
        largest = max(largest, float(np.nanmax(reference, initial=0)))
    detail = {"negative": lowest / largest}
    return limit_finding(
        "finite, 0 if invalid", key, name, bad, "stress.definition.wrong",
        cases=sum(len(s) for s in sets), where=where, detail=detail,
    )  # fmt: skip


def _count_finding(
    representation: Representation, name: str, which: str, sets: Sequence[Lookups], port: Evaluator
) -> Finding:
    """Lookups that ask for what is none are counted alike by all evaluators; their values are exactly 0."""
    expected = [malformed(*lookups.points) for lookups in sets]
    found = [port.malformed(*lookups.points) for lookups in sets]
    off = sum(abs(a[kind] - b[kind]) for a, b in zip(expected, found, strict=True) for kind in a)
    totals = {kind: sum(counts[kind] for counts in expected) for kind in expected[0]}
    return limit_finding(
        "malformed counted", representation.meta["method"], name, off, "stress.malformed.off",
        evaluator=which, cases=sum(len(s) for s in sets),
        where=", ".join(f"{n} {kind}" for kind, n in totals.items()), detail=totals,
    )  # fmt: skip


def _port_finding(
    representation: Representation,
    name: str,
    which: str,
    sets: Sequence[Lookups],
    references: Sequence[np.ndarray],
    values: Sequence[np.ndarray],
    seed: int,
) -> Finding:
    key = representation.meta["method"]
    results = [
        judge_values(value, reference, representation, lookups, "stress.ports")
        for value, reference, lookups in zip(values, references, sets, strict=True)
    ]
    failed, explained, error, ulps = (np.concatenate(part) for part in zip(*results, strict=True))
    # The worst case is a failure where there is one; else the largest error that needs no explanation.
    order = np.where(failed, np.inf, np.where(explained, -1, error))
    first = int(np.argmax(order))
    number, index = _locate(sets, first)
    valid = np.concatenate([valid_lookups(lookups) for lookups in sets])
    detail = {
        "relative": _distribution(error[valid]),
        "ulps": _distribution(ulps[valid]),
        "invalid": int(np.count_nonzero(~valid)),
        "worst_explained": float(error[explained].max(initial=0)),
    }
    plain = np.where(explained, 0, error)
    command = ["btfref", "stress", "--only", key, "--data", name.partition(",")[0], "--evaluator", which]
    command += ["--seed", str(seed), "--case", f"{number}:{index}:{len(sets[number])}"]
    if ", " in name:
        command += ["--storage", name.partition(", ")[2]]
    return Finding(
        "port",
        key,
        which,
        name,
        len(error),
        float(plain.max(initial=0)),
        tolerance("stress.ports.max"),
        int(failed.sum()),
        int(explained.sum()),
        sets[number].where(index),
        shlex.join(command),
        detail,
    )


def _locate(sets: Sequence[Lookups], index: int) -> tuple[int, int]:
    for number, lookups in enumerate(sets):
        if index < len(lookups):
            return number, index
        index -= len(lookups)
    raise IndexError(index)


def _distribution(values: np.ndarray) -> dict[str, float]:
    """Percentiles of errors of valid lookups."""
    if not len(values):
        return {}
    names = {"p50": 50, "p99": 99, "p999": 99.9, "max": 100}
    ordered = np.sort(values)
    # By rank: an infinite error must not become NaN by interpolation.
    return {name: float(ordered[int(np.ceil(p / 100 * len(ordered))) - 1]) for name, p in names.items()}


def stress_fits(key: str) -> Iterator[Finding]:
    """The checks of a method's fit itself.

    Yields
    ------
    Finding
    """
    row = method(key)
    for name in PROPERTY_DATA:
        btf = make(name)
        yield from properties.deterministic(row, btf, name)
        yield from properties.monotone(row, btf, name)
        yield from properties.symmetric(row, btf, name)
        yield from properties.energy(row, row.quick_fit(btf), btf, name)
    relief = make("relief")
    yield from properties.energy(row, row.quick_fit(relief), relief, "relief", "stress.energy.relief")
    yield from properties.overflow(row)
    with tempfile.TemporaryDirectory() as folder:
        yield from properties.refuses_nan(row, Path(folder))


def stress_directions() -> Iterator[Finding]:
    """Partition of unity on direction sets with and without rings.

    Yields
    ------
    Finding
    """
    for spec in ("ubo81", "ubo151", "10x5"):
        yield from properties.partition_of_unity(spec, spec)
    yield from properties.partition_of_unity(scattered(0), "scattered")


def show_case(
    key: str, name: str, port: str, case: str, *, seed: int = 0, storage: str | None = None
) -> Facts:
    """One lookup again: what a reproducer prints.

    Parameters
    ----------
    key, name, port : str
        Method, data and evaluator.
    case : str
        ``block:index:size`` as a reproducer has it.
    seed : int
    storage : str, optional

    Returns
    -------
    dict
        Arguments, the definition's value, the port's, and the verdict.

    Raises
    ------
    InputError
        A case that is not one.
    """
    from btfref.representations import load, save

    words = case.split(":")
    if len(words) != 3 or not all(word.isdecimal() for word in words) or int(words[1]) >= int(words[2]):
        raise InputError("not a case", field="--case", got=repr(case), expected="BLOCK:INDEX:SIZE")
    number, index, n = map(int, words)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"stress.{key}.exr"
        further = {} if storage is None else {"storage": storage}
        save(method(key).quick_fit(make(name, seed), **further), path)
        representation = load(path)
        lookups = block(representation, seed, number, n)
        reference, value = (
            _values(evaluator(which, representation, path), [lookups])[0] for which in (DEFINITION, port)
        )
    failed, explained, error, ulps = judge_values(value, reference, representation, lookups, "stress.ports")
    return {
        "where": lookups.where(index),
        "uv": lookups.uv[index].tolist(),
        "w_light": lookups.w_light[index].tolist(),
        "w_view": lookups.w_view[index].tolist(),
        "lod": float(lookups.lod[index]),
        "definition": reference[index].tolist(),
        port: value[index].tolist(),
        "relative_error": float(error[index]),
        "ulps": float(ulps[index]),
        "explained_by_rounded_arguments": bool(explained[index]),
        "failed": bool(failed[index]),
    }
