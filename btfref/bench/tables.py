"""Metrics for people: tables of each kind, diagrams of error against cost, and two runs side by side."""

from __future__ import annotations

import random
import statistics
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from btfref.bench.metrics import latest, read_records, rows
from btfref.querying import off_grid
from btfref.report.pareto import Panel, Point, front

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


#: Relative errors up to this are the rounding of float32 answers.
REPEATED = 1e-6

#: Kinds of records in the order of tables: title and columns.
KINDS = {
    "off_grid": "Error at directions that nobody fitted (99 % interval)",
    "build": "Fits",
    "error": "Error at measured entries (99 % interval)",
    "eval": "Evaluations",
    "render": "Path tracing, equal samples",
    "sampling": "Importance sampling against cosine sampling",
    "realtime": "Frames in GLSL",
}


def tables(found: list[Facts]) -> list[tuple[str, tuple[str, ...], list[tuple[str, ...]]]]:
    """Tables of metrics.

    Parameters
    ----------
    found : list of dict
        Of :func:`btfref.bench.metrics.rows`.

    Returns
    -------
    list of (title, header, rows of str)
    """
    result = []
    for kind, title in KINDS.items():
        some = [r for r in found if r["kind"] == kind]
        if some:
            columns = _COLUMNS[kind]
            result.append((title, tuple(columns), [tuple(f(r) for f in columns.values()) for r in some]))
    return result


def markdown(title: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """A table in Markdown, as lines."""
    cells = [header, ["---"] * len(header), *lines]
    return [f"**{title}**", "", *("| " + " | ".join(line) + " |" for line in cells), ""]


def panels(found: list[Facts], material: str) -> list[Panel]:
    """Diagrams of a material: error against bytes, time to fit, and time to evaluate in Dr.Jit and GLSL.

    Parameters
    ----------
    found : list of dict
    material : str

    Returns
    -------
    list of btfref.report.pareto.Panel
        Those for which there is anything; entries that repeat the data are left out. Names are short: what a method
        was built with by its numbers alone.
    """
    own = [r for r in found if r["material"] == material]
    error = {r["entry"]: r for r in own if r["kind"] == "error" and r["rmse"] > REPEATED}
    group = {name: name.split(" (")[0] for name in error}
    costs = {
        "bytes of the maps": {r["entry"]: r["payload"] for r in own if r["kind"] == "build"},
        "seconds to fit": {r["entry"]: r["time"]["median"] for r in own if r["kind"] == "build"},
    }
    for kind, label in (("drjit", "ns an evaluation, Dr.Jit"), ("glsl", "ns an evaluation, GLSL")):
        costs[label] = {
            r["entry"]: 1e9 / r["per_second"]
            for r in own
            if r["kind"] == "eval" and r["evaluator"] == kind and r["query"] in ("", "bilinear")
        }
    result = []
    for label, cost in costs.items():
        points = [
            Point(_short(name), cost[name], e["rmse"], group[name], e["rmse_low"] or None, e["rmse_high"])
            for name, e in error.items()
            if name in cost
        ]
        if points:
            result.append(Panel(material, label, "RMSE / RMS of the BTF", points))
    return result


def _short(name: str) -> str:
    method, _, described = name.partition(" (")
    return " ".join(
        [method, "×".join(word.split(" ")[-1] for word in described.rstrip(")").split(", "))]
    ).strip()


def summary(folder: PathLike) -> Facts:
    """Machine-readable metrics of a folder, with what no other entry beats.

    Returns
    -------
    dict
        ``runs``, ``metrics``, ``front``: by material and cost the names of the entries on the front.
    """
    records = latest(read_records(folder))
    found = rows(folder, records)
    fronts = {}
    for material in dict.fromkeys(r["material"] for r in found):
        fronts[material] = {
            panel.x_label: [p.name for p, best in zip(panel.points, front(panel.points), strict=True) if best]
            for panel in panels(found, material)
        }
    return {"runs": [r for r in records if r["record"] == "run"], "metrics": found, "front": fronts}


def compared(a: PathLike, b: PathLike) -> list[Facts]:
    """What two folders have in common, as ratios of the second to the first.

    Parameters
    ----------
    a, b : path-like

    Returns
    -------
    list of dict
        ``what``, ``first``, ``second``, ``ratio``, ``low``, ``high``: medians of times in seconds and the 95 % interval
        of their ratio (bootstrap over rounds; none for a single round), or errors, whose interval is that of the
        data's own ends.
    """
    index = [{_key(r): r for r in rows(folder)} for folder in (a, b)]
    times = [{_key(r): _times(r) for r in _raw(folder)} for folder in (a, b)]
    result = []
    for key, first in index[0].items():
        second = index[1].get(key)
        if second is None:
            continue
        what = " · ".join(str(k) for k in key if k)
        if first["kind"] in ("error", "off_grid"):
            x, y = (r["rmse"] if r["kind"] == "error" else r["nrmse"][0] for r in (first, second))
            line = {"what": what + " · RMSE", "first": x, "second": y, "ratio": y / x if x else None}
            result.append(line | {"low": None, "high": None})
        elif "time" in first:
            x, y = times[0][key], times[1][key]
            low, high = _bootstrap(x, y)
            x, y = statistics.median(x), statistics.median(y)
            result.append({"what": what, "first": x, "second": y, "ratio": y / x, "low": low, "high": high})
    return result


def _raw(folder: PathLike) -> list[Facts]:
    return [r for r in latest(read_records(folder)) if "warm_s" in r and r.get("way") != "cosine"]


def _times(record: Facts) -> list[float]:
    return record["warm_s"] or [record["cold_s"]]


def _key(r: Facts) -> tuple[str, ...]:
    query = r.get("query", "")
    query = " ".join(map(str, query.values())) if isinstance(query, dict) else query
    size = r.get("size", "")
    size = "x".join(map(str, size)) if isinstance(size, list) else size
    name = r.get("entry") or r["name"]
    kind = r.get("kind") or r["record"]
    return kind, r["material"], name, query, r.get("evaluator", ""), r.get("scene", ""), size


def _bootstrap(
    x: Sequence[float], y: Sequence[float], n: int = 2000
) -> tuple[float, float] | tuple[None, None]:
    """Ends of the 95 % interval of the ratio of two medians, y over x."""
    if len(x) < 2 or len(y) < 2:
        return None, None
    rng = random.Random(0)
    ratios = sorted(
        statistics.median(rng.choices(y, k=len(y))) / statistics.median(rng.choices(x, k=len(x)))
        for _ in range(n)
    )
    return ratios[int(0.025 * n)], ratios[int(0.975 * n)]


def _span(value: Facts, digits: str = "{:.3g}") -> str:
    if value["n"] < 2:
        return digits.format(value["median"])
    return (
        f"{digits.format(value['median'])} ({digits.format(value['min'])} to {digits.format(value['max'])})"
    )


def _bytes(n: int | None) -> str:
    return "–" if n is None else f"{n:,}".replace(",", " ")


def _new_kernels(facts: Facts | None) -> str:
    """How many kernels the first call had to compile or load, and what that took."""
    if facts is None:
        return "–"
    found = facts["compiled"], facts["from_disk"]
    return f"{found[0]} compiled, {found[1]} from disk: {facts['codegen_s'] + facts['backend_s']:.2g} s"


def _off_grid(number: int) -> Callable[[Facts], str]:
    """A column of errors off the grid."""
    return lambda r: off_grid.cells(r)[number]


def _if_there(row: Facts, name: str) -> str:
    return f"{row[name]:.2f}" if name in row else "–"


_NAME = {
    "material": lambda r: r["material"],
    "entry": lambda r: r["entry"],
}
_QUERY = {**_NAME, "query": lambda r: r["query"]}

_COLUMNS = {
    "off_grid": {
        **_NAME,
        "footprint": lambda r: r["query"],
        **{head: _off_grid(number) for number, head in enumerate(off_grid.HEADS)},
    },
    "build": {
        **_NAME,
        "seconds": lambda r: _span(r["time"]),
        "cold": lambda r: f"{r['cold_s']:.3g}",
        "ratio": lambda r: _span(r["ratio"]),
        "bytes of maps": lambda r: _bytes(r["payload"]),
        "peak bytes of the fit": lambda r: _bytes(r["peak_bytes"]),
    },
    "error": {
        **_NAME,
        "RMSE / RMS": lambda r: f"{r['rmse']:.4f} ({r['rmse_low']:.4f} to {r['rmse_high']:.4f})",
        "relMSE": lambda r: f"{r['relmse']:.4f}",
        "ΔE00": lambda r: f"{r['delta_e00']:.2f} ({r['delta_e00_low']:.2f} to {r['delta_e00_high']:.2f})",
        "bias": lambda r: f"{100 * r['bias']:+.2f} %",
    },
    "eval": {
        **_QUERY,
        "evaluator": lambda r: r["evaluator"],
        "million a second": lambda r: f"{1e-6 * r['per_second']:.3g}",
        "seconds": lambda r: _span(r["time"]),
        "cold": lambda r: f"{r['cold_s']:.3g}",
        "kernels, new": lambda r: _new_kernels(r["kernels"]),
        "difference": lambda r: f"{r['largest_difference']:.1e}",
    },
    "render": {
        "material": lambda r: r["material"],
        "scene": lambda r: r["scene"],
        "entry": lambda r: " ".join([r["entry"], r["query"]]).strip(),
        "seconds": lambda r: _span(r["time"]),
        "cold": lambda r: f"{r['cold_s']:.3g}",
        "kernels, new": lambda r: _new_kernels(r["kernels"]),
        "ratio": lambda r: _span(r["ratio"]),
        "noise after 1 s": lambda r: f"{100 * r['noise_at_1s']:.2f} %",
        "over blended: time": lambda r: _span(r["time_ratio"]) if "time_ratio" in r else "–",
        "variance": lambda r: _if_there(r, "variance_ratio"),
        "efficiency": lambda r: _if_there(r, "efficiency"),
        "error after equal time": lambda r: _if_there(r, "equal_time_error"),
    },
    "sampling": {
        **_QUERY,
        "variance": lambda r: f"{r['variance_ratio']:.3f}",
        "time": lambda r: _span(r["time_ratio"]),
        "efficiency": lambda r: f"{r['efficiency']:.2f}",
    },
    "realtime": {
        **_QUERY,
        "size": lambda r: r["size"],
        "milliseconds": lambda r: _span({**r["time"], **_scaled(r["time"], 1e3)}),
        "cold": lambda r: f"{1e3 * r['cold_s']:.3g}",
        "noise of a frame": lambda r: f"{100 * r['noise']:.2f} %" if "noise" in r else "–",
        "noise after 1 s": lambda r: f"{100 * r['noise_at_1s']:.2f} %" if "noise" in r else "–",
    },
}


def _scaled(value: Facts, factor: float) -> dict[str, float]:
    return {key: factor * value[key] for key in ("median", "min", "max")}
