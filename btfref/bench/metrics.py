"""Metrics of raw records: errors with intervals, medians with spread, ratios of pairs, efficiencies.

Everything here reads what :mod:`btfref.bench.matrix` wrote and measures nothing.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.matrix import RESULTS
from btfref.bench.scenes import BASELINE
from btfref.errors import InputError
from btfref.querying import off_grid

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


#: Half-width of a 99 % interval in standard errors.
Z99 = 2.5758


def read_records(folder: PathLike) -> list[Facts]:
    """The records of a folder.

    Parameters
    ----------
    folder : path-like
        As written by :func:`btfref.bench.matrix.run`.

    Returns
    -------
    list of dict

    Raises
    ------
    InputError
        For a folder without results, or a line that is no record.
    """
    path = Path(folder) / RESULTS
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError("no results of a benchmark", file=path, got=error.strerror) from None
    records = []
    for i, line in enumerate(lines):
        try:
            record = json.loads(line)
            record["record"]
        except (json.JSONDecodeError, KeyError, TypeError):
            raise InputError("not a record", file=path, field=f"line {i + 1}", got=line[:60]) from None
        records.append(record)
    return records


def latest(records: list[Facts]) -> list[Facts]:
    """Of each plan and material the records of the last run that measured it, and these runs."""
    plan = {r["id"]: r["plan"]["name"] for r in records if r["record"] == "run"}
    # Later runs replace earlier ones.
    last = {(plan[r["run"]], r["material"]): r["run"] for r in records if r["record"] != "run"}
    return [
        r for r in records if (r["id"] in last.values() if r["record"] == "run" else _is_last(r, plan, last))
    ]


def _is_last(record: Facts, plan: Mapping[str, str], last: Mapping[tuple[str, str], str]) -> bool:
    return last[plan[record["run"]], record["material"]] == record["run"]


def spread(times: Sequence[float]) -> Facts:
    """Median and extremes of times in seconds, one or more."""
    return {"median": statistics.median(times), "min": min(times), "max": max(times), "n": len(times)}


def time_of(record: Facts) -> Facts:
    """Spread of the warm times; of the cold one where no other was taken."""
    return spread(record["warm_s"] or [record["cold_s"]])


def paired_ratio(record: Facts, baseline: Facts) -> Facts:
    """Median and extremes of the ratios of the rounds of two records that took turns."""
    pairs = list(zip(record["warm_s"], baseline["warm_s"], strict=False))
    if not pairs:
        pairs = [(record["cold_s"], baseline["cold_s"])]
    return spread([a / b for a, b in pairs])


def errors(folder: PathLike, record: Facts) -> Facts:
    """Errors of the answers to random entries of a BTF.

    Parameters
    ----------
    folder : path-like
    record : dict
        Of kind "error".

    Returns
    -------
    dict
        ``rmse`` over the root mean square of the data, ``relmse``, ``delta_e00`` (root mean square, entries times π
        as colours), ``bias`` over the mean; ``rmse`` and ``delta_e00`` with the ends of their 99 % intervals
        (normal, over the random choice of entries, by the delta method).
    """
    from btfref.comparison import metrics
    from btfref.comparison.colour import ciede2000, lab

    expected = np.load(Path(folder) / record["queries"])["expected"].astype(float)
    found = np.load(Path(folder) / record["values"]).astype(float)
    squared = ((found - expected) ** 2).sum(1)
    energy = (expected**2).sum(1)
    shown = [lab(np.clip(np.pi * values, 0, 1)) for values in (found, expected)]
    delta = ciede2000(*shown) ** 2
    low, rmse, high = _root_ratio(squared, energy)
    d_low, d, d_high = _root_ratio(delta, np.ones_like(delta))
    return {
        "rmse": rmse,
        "rmse_low": low,
        "rmse_high": high,
        "relmse": metrics.relmse(found, expected),
        "delta_e00": d,
        "delta_e00_low": d_low,
        "delta_e00_high": d_high,
        "bias": float((found - expected).mean() / expected.mean()) if expected.mean() else 0.0,
        "n": len(expected),
    }


def off_grid_errors(folder: PathLike, record: Facts) -> Facts:
    """Errors of the answers at directions that nobody fitted.

    Parameters
    ----------
    folder : path-like
    record : dict
        Of kind "off_grid".

    Returns
    -------
    dict
        Footprint → what `btfref.querying.accuracy.accuracy` finds.
    """
    with np.load(Path(folder) / record["queries"]) as stored:
        truth = off_grid.unpacked(stored)
    answers = np.load(Path(folder) / record["values"])
    return off_grid.errors_of(dict(zip(truth, answers, strict=True)), truth)


def _root_ratio(top: np.ndarray, bottom: np.ndarray) -> tuple[float, float, float]:
    """√(mean top / mean bottom) and the ends of its 99 % interval, from pairs of samples."""
    if not bottom.any():
        return 0.0, 0.0, 0.0
    ratio = top.mean() / bottom.mean()
    error = (top - ratio * bottom).std(ddof=1) / np.sqrt(len(top)) / bottom.mean()
    low, middle, high = (float(np.sqrt(max(0.0, ratio + z * error))) for z in (-Z99, 0, Z99))
    return low, middle, high


def rows(folder: PathLike, records: list[Facts] | None = None) -> list[Facts]:
    """Metrics of all records, grouped by what they are of.

    Parameters
    ----------
    folder : path-like
    records : list of dict, optional
        Default: the last run of each plan in the folder.

    Returns
    -------
    list of dict
        ``kind``, ``material``, ``entry``, ``query`` (text; off the grid, the footprint), and the metrics of the kind.
    """
    records = latest(read_records(folder)) if records is None else records
    plain = {
        (r["run"], r["material"], r["scene"]): r
        for r in records
        if r["record"] == "render" and r.get("name") == BASELINE
    }
    cosine = {
        (r["run"], r["material"], r["entry"], str(r["query"])): r
        for r in records
        if r["record"] == "sampling" and r["way"] == "cosine"
    }
    blended = {_drawn_key(r): r for r in records if r.get("query", {}).get("interpolation") == "blended"}
    baselines = {r["id"]: r["plan"]["baseline"] for r in records if r["record"] == "run"}
    builds = {}
    for r in records:
        if r["record"] == "build":
            key = r["run"], r["material"]
            if r["entry"] == baselines[r["run"]] or key not in builds:
                builds[key] = r
    result = []
    for r in records:
        kind = r["record"]
        if kind == "run":
            continue
        row = {"kind": kind, "material": r["material"], "entry": r.get("entry") or r["name"]}
        row["query"] = " ".join(map(str, r.get("query", {}).values()))
        if kind == "build":
            base = builds[r["run"], r["material"]]
            row |= {"time": time_of(r), "cold_s": r["cold_s"], "ratio": paired_ratio(r, base)}
            row |= {key: r[key] for key in ("payload", "file_bytes", "peak_bytes")}
        elif kind == "off_grid":
            result += [
                {**row, "query": footprint, **found}
                for footprint, found in off_grid_errors(folder, r).items()
            ]
            continue
        elif kind == "error":
            row |= errors(folder, r)
        elif kind == "eval":
            row |= {"evaluator": r["evaluator"], "cold_s": r["cold_s"], "time": time_of(r)}
            row["per_second"] = r["points"] / row["time"]["median"]
            row |= {"largest_difference": r["largest_difference"], "kernels": r.get("kernels")}
        elif kind == "render":
            # A build's rounds have a baseline of their own.
            base = plain[r["run"], r["material"], r["scene"]]
            base = {"warm_s": r["baseline_s"]} if "baseline_s" in r else base
            row |= {"scene": r["scene"], "cold_s": r["cold_s"], "time": time_of(r), "kernels": r["kernels"]}
            row["ratio"] = paired_ratio(r, base)
            # The noise of a picture that is given one second: variance falls with samples, samples grow with time.
            row["noise_at_1s"] = float(np.sqrt(r["variance"] * row["time"]["median"]) / r["mean"])
            if r.get("query", {}).get("interpolation") == "drawn" and _drawn_key(r) in blended:
                row |= over_blended(r, blended[_drawn_key(r)])
        elif kind == "sampling":
            if r["way"] != "data":
                continue
            other = cosine[r["run"], r["material"], r["entry"], str(r["query"])]
            row["variance_ratio"] = r["variance"] / other["variance"] if other["variance"] else 1.0
            row["time_ratio"] = paired_ratio(r, other)
            # 1 / (variance · time), over that of cosine sampling.
            row["efficiency"] = 1 / max(row["variance_ratio"] * row["time_ratio"]["median"], 1e-30)
        elif kind == "realtime":
            row |= {
                "size": "x".join(map(str, r["size"])),
                "cold_s": r["cold_s"],
                "time": time_of(r),
            }
            if "variance" in r:
                row["noise"] = float(np.sqrt(r["variance"]) / r["mean"])
                row["noise_at_1s"] = row["noise"] * float(np.sqrt(row["time"]["median"]))
        result.append(row)
    return result


def _drawn_key(record: Facts) -> tuple[object, ...]:
    """What a record with drawn interpolation and its twin with blended one have in common."""
    query = {name: value for name, value in record.get("query", {}).items() if name != "interpolation"}
    names = ("record", "run", "material", "entry", "scene")
    return *(str(record.get(name)) for name in names), str(query)


def over_blended(record: Facts, blended: Facts) -> Facts:
    """A picture with drawn interpolation against the same with blended one.

    Parameters
    ----------
    record, blended : dict
        Of kind "render". Their rounds took turns with a baseline each, and are compared as ratios to it.

    Returns
    -------
    dict
        ``variance_ratio``; ``time_ratio``, a spread; ``efficiency``, 1 / (variance · time) over that of the other, and
        ``equal_time_error``, the standard deviation over the other's after the same time.
    """
    shares = [[a / b for a, b in zip(r["warm_s"], r["baseline_s"], strict=False)] for r in (record, blended)]
    times = spread([a / b for a, b in zip(*shares, strict=False)])
    variance = record["variance"] / blended["variance"] if blended["variance"] else 1.0
    product = max(variance * times["median"], 1e-30)
    return {
        "variance_ratio": variance,
        "time_ratio": times,
        "efficiency": 1 / product,
        "equal_time_error": float(np.sqrt(product)),
    }
