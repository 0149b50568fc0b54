"""Synthesis: the shared estimators against one render per pair, each method in a process of its own.

The naive loop is what people write: ``mi.render`` once per view-light pair, with the scene loaded once, one mesh
per material, and the light moved between renders; its time is extrapolated from a random subset of pairs. The
error of each method is measured at pairs for which a much longer reference is rendered.

Whether a method is biased is judged by the images' means. Their noise is the spread of independent runs: most of it may
come from a handful of texels out of all, so that what one image shows of its own noise is often too little.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.options import Options
from btfref.bench.synth_methods import MAX_DEPTH, NAIVE_PAIRS, PAIRS, PATH_VIEWS, REFERENCE_SPP
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from btfref.types import Facts, Progress


#: Samples of the naive loop and of paths: the classes of equal error.
SAMPLES = (16, 64)

#: Surface points a texel for about the errors of these samples. Errors stand beside the times.
POINTS = {"checker": (10, 28), "rings": (25, 80), "tissue": (18, 52)}

#: Independent runs whose spread is the noise of an image's mean; the timed rounds are among them.
RUNS = {"naive": 12, "path": 8, "surface": 12}

#: Significance of the z-test of a method's image means, taken together.
SIGNIFICANCE = 0.01

#: Growth of the cost: what is varied -> its values. The others stay at `BASE`.
GROWTH = {
    "texels": (32, 64, 128, 256),
    "directions": ("5x5", "ubo81", "ubo151"),
    "max_depth": (2, 3, 4, 8),
}
BASE: Facts = {"mesostructure": "checker", "texels": 64, "directions": "ubo81", "max_depth": 8, "spp": 10}

#: What a step takes, roughly and in any unit, for the time left: a render of 16 samples, 16 paths, 16 points.
COST = {"naive": 1, "path": 10, "surface": 10}


def run(options: Options) -> Facts:
    """Time and error of full 64² × 81² synthesis.

    Parameters
    ----------
    options : Options
        ``quick``: the checker at 16² texels, one round, few runs; the growth at small sizes. ``only``: mesostructures
        instead of all; "growth" for the growth of the cost alone. ``btf``: not used.

    Returns
    -------
    dict
        ``summary``: one row per mesostructure and method, see `summary`; ``raw``: seconds of every round per
        mesostructure and method; ``kernel_s``, those of the naive loop that its kernels take; ``values``, how many BSDF
        values the surface estimator sums up, and ``floor_s``, seconds of Mitsuba's own `eval` for as many
        (`btfref.bench.floor`); ``errors``;
        ``means``: the images' means of every run, and ``reference``, those of the reference's rounds;
        ``peak_bytes``; ``growth``: one row per setting; ``parameters``; ``machine``.

    Raises
    ------
    InputError
        For a name in ``only`` that there is not.
    """
    names = list(options.only or (*(MESOSTRUCTURES[:1] if options.quick else MESOSTRUCTURES), "growth"))
    options.demand((*MESOSTRUCTURES, "growth"))
    settings = _growing(options.quick) if "growth" in names else []
    names = [name for name in names if name != "growth"]
    rounds, texels = (1, 16) if options.quick else (3, 64)
    count = dict.fromkeys(RUNS, 4) if options.quick else RUNS
    steps = _Steps(options.progress, names, settings, rounds, count)
    keys = ("raw", "errors", "means", "reference", "peak_bytes", "kernel_s", "floor_s", "values")
    result: Facts = {key: {} for key in keys}
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            job = {"mesostructure": name, "texels": texels, "reference": str(Path(folder) / f"{name}.npz")}
            with _Process(job | {"task": "reference"}) as process:
                result["reference"][name] = process.answer()["means"]
            steps.add("reference", 0)
            for key, value in _measured(job, rounds, count, steps).items():
                result[key][name] = value
    growth = []
    for setting in settings:
        with _Process(setting | {"task": "growth"}) as process:
            growth.append(setting | process.answer())
        steps.add("growth", setting)
    result["growth"] = growth
    parameters = {
        "texels": texels,
        "directions": "ubo81 × ubo81",
        "max_depth": MAX_DEPTH,
        "rounds": rounds,
        "runs": count,
        "pairs": PAIRS,
        "significance": SIGNIFICANCE,
        "z_limit": z_limit(),
        "reference_spp": REFERENCE_SPP,
        "naive_pairs": NAIVE_PAIRS,
        "path_views": PATH_VIEWS,
    }
    rows = summary(result)
    return {"suite": "synth", "parameters": parameters, "machine": machine(), "summary": rows, **result}


def methods(name: str) -> dict[str, tuple[str, int, int]]:
    """Label -> estimator, samples and class of equal error, for one mesostructure."""
    spp = {"naive": SAMPLES, "path": SAMPLES, "surface": POINTS[name]}
    return {f"{key} {n}": (key, n, level) for key, counts in spp.items() for level, n in enumerate(counts)}


def _measured(job: Facts, rounds: int, count: Mapping[str, int], steps: _Steps) -> dict[str, Facts]:
    """All methods of one mesostructure in turn: parts of the result by label."""
    lists = {"seconds": "raw", "errors": "errors", "kernel_s": "kernel_s", "floor_s": "floor_s"}
    parts: dict[str, Facts] = {key: {} for key in (*lists.values(), "means", "peak_bytes", "values")}
    with ExitStack() as stack:
        processes = {}
        for label, (task, spp, _) in methods(job["mesostructure"]).items():
            processes[label] = stack.enter_context(_Process(job | {"task": task, "spp": spp}))
            processes[label].answer()  # that it is ready
        for seed in range(max(count.values())):
            for label, (task, spp, _) in methods(job["mesostructure"]).items():
                if seed >= count[task]:
                    continue
                timed = seed < rounds
                answer = processes[label].answer({"seed": seed, "timed": timed})
                parts["means"].setdefault(label, []).append(answer["means"])
                if timed:
                    for key, part in lists.items():
                        if key in answer:
                            parts[part].setdefault(label, []).append(answer[key])
                    for key in ("peak_bytes", "values"):
                        if key in answer:
                            parts[key][label] = answer[key]
                steps.add(task, spp)
    return parts


class _Steps:
    """Steps done of all, weighed by what they take so that the time left can be told from them."""

    def __init__(
        self,
        progress: Progress | None,
        names: Sequence[str],
        settings: Sequence[Facts],
        rounds: int,
        count: Mapping[str, int],
    ) -> None:
        self.progress, self.done = progress, 0
        self.total = sum(_cost("reference", 0) for _ in names) + sum(_cost("growth", s) for s in settings)
        for name in names:
            self.total += sum(count[task] * _cost(task, spp) for task, spp, _ in methods(name).values())
        self.add(None, 0)

    def add(self, task: str | None, what: Any) -> None:
        """Count a step; the first call shows where it starts."""
        self.done += _cost(task, what) if task else 0
        if self.progress is not None:
            # One label throughout: the bar's clock starts anew with each.
            self.progress(self.done, self.total, "synthesis")


def _cost(task: str, what: Any) -> int:
    """Relative time of a step; ``what`` is a number of samples, or a setting of the growth."""
    if task == "reference":
        return 10 * COST["naive"]
    if task == "growth":
        return COST["surface"] * max(1, (what["texels"] // 64) ** 2)
    return max(1, COST[task] * what // 16)


def _growing(quick: bool) -> list[Facts]:
    """Settings of the growth of the cost."""
    base: Facts = BASE | ({"texels": 16} if quick else {})
    rows = [base | {"varied": name, name: value} for name, values in GROWTH.items() for value in values]
    return [row for row in rows if not quick or row["texels"] <= 32]


# --- what is made of the figures


def z_limit(significance: float = SIGNIFICANCE, n_tests: int = PAIRS) -> float:
    """|z| that the largest of some standard normals exceeds with a probability (Šidák 1967)."""
    from scipy import special

    from btfref.comparison.significance import sidak

    return float(-special.ndtri(sidak(significance, n_tests) / 2))


def bias(runs: ArrayLike, reference: ArrayLike) -> Facts:
    """Deviation of the images' means from the reference's.

    Parameters
    ----------
    runs, reference : array (n_runs, pairs), (n_rounds, pairs)
        Means of independent images, two runs or more.

    Returns
    -------
    dict
        ``z``: of the means of all runs, the largest |z| of the pairs (Welch's test, as the normal z of the same
        p-value); ``pairs_z``; ``limit``: see `z_limit`; ``seen``: relative deviations of the pairs' means that would
        reach the limit; ``bias``: that of all pairs' mean, and ``half_width`` of its 95 % interval.
    """
    from scipy import special

    from btfref.comparison.significance import interval, welch_test

    runs, reference = np.asarray(runs, np.float64), np.asarray(reference, np.float64)
    n, m = len(runs), len(reference)
    mine, theirs = runs.var(0, ddof=1) / n, reference.var(0, ddof=1) / m
    truth = reference.mean(0)
    _, p = welch_test(runs.mean(0), mine, truth, theirs, n_a=n, n_b=m)
    z = -special.ndtri(np.maximum(p, 1e-300) / 2)
    limit = z_limit(n_tests=runs.shape[1])
    # Pairs share points and walks: the spread of whole runs holds what goes together.
    whole, other = runs.mean(1), reference.mean(1)
    error = np.sqrt(whole.var(ddof=1) / n + other.var(ddof=1) / m) / truth.mean()
    found = interval(whole.mean() / truth.mean() - 1, error, confidence=0.95, freedom=n - 1)
    # As wide as Welch's test is: Student's quantile.
    freedom = (mine + theirs) ** 2 / (mine**2 / (n - 1) + theirs**2 / (m - 1))
    wide = special.stdtrit(freedom, special.ndtr(limit))
    return {
        "z": float(z.max()),
        "pairs_z": z.tolist(),
        "limit": limit,
        "seen": (wide * np.sqrt(mine + theirs) / truth).tolist(),
        "bias": found.estimate,
        "half_width": found.high - found.estimate,
    }


def summary(result: Facts) -> list[Facts]:
    """Figures of each mesostructure and method, computed from the raw ones.

    Parameters
    ----------
    result : dict
        Of `run`.

    Returns
    -------
    list of dict
        ``mesostructure``, ``method``; ``seconds``, and paired ratios to it of the naive loop (``naive``), of what its
        kernels take (``kernels``) and of paths (``path``), of the samples whose error is asked for, and of it to the
        floor of those (``floor``): ``[median, least, largest]`` each; ``rmse``, ``trimmed``, ``mae``: medians of the
        rounds; ``equal_error``: whether none of them is above the naive loop's; what `bias` tells; ``peak_bytes``.
    """
    rows = []
    for name, raw in result["raw"].items():
        labels = methods(name)
        levels = [{label for label in labels if labels[label][2] == level} for level in range(len(SAMPLES))]
        errors = {
            label: {key: statistics.median(e[key] for e in some) for key in ("rmse", "trimmed", "mae")}
            for label, some in result["errors"][name].items()
        }
        for label, seconds in raw.items():
            level = next(k for k, some in enumerate(levels) if label in some)
            naive = f"naive {SAMPLES[level]}"
            peers = {
                "naive": raw[naive],
                "kernels": result["kernel_s"][name][naive],
                "path": raw[f"path {SAMPLES[level]}"],
            }
            ratios = {key: [a / b for a, b in zip(some, seconds, strict=True)] for key, some in peers.items()}
            floor = result["floor_s"][name][f"surface {POINTS[name][level]}"]
            ratios["floor"] = [b / a for a, b in zip(floor, seconds, strict=True)]
            spread = {"seconds": seconds} | ratios
            rows.append(
                {"mesostructure": name, "method": label}
                | {key: [statistics.median(some), min(some), max(some)] for key, some in spread.items()}
                | errors[label]
                | {"equal_error": all(errors[label][key] <= e for key, e in errors[naive].items())}
                | bias(result["means"][name][label], result["reference"][name])
                | {"peak_bytes": result["peak_bytes"][name][label]}
            )
    return rows


def table(result: Facts) -> tuple[list[str], list[list[str]]]:
    """Header and rows for a reader; ratios and seconds are medians with the least and the largest round."""
    header = ["mesostructure", "method", "s", "RMSE", "RMSE w/o 1 %", "MAE"]
    header += [f"|z| ≤ {result['parameters']['z_limit']:.1f}?", "seen from %", "bias %"]
    header += ["naive / it", "its kernels / it", "paths / it", "it / floor", "MiB"]
    rows = []
    for row in result["summary"]:
        seen = statistics.median(row["seen"])
        cells = [row["mesostructure"], row["method"], _spread(row["seconds"], ".1f")]
        cells += [f"{row[key]:.4f}" for key in ("rmse", "trimmed", "mae")]
        cells += [f"{row['z']:.1f}", f"{100 * seen:.2f}"]
        cells += [f"{100 * row['bias']:+.2f} ± {100 * row['half_width']:.2f}"]
        cells += [_spread(row[key], ".3g") for key in ("naive", "kernels", "path", "floor")]
        rows.append([*cells, f"{row['peak_bytes'] / 2**20:.0f}"])
    for row in result["growth"]:
        setting = f"surface {row['spp']}, {row['texels']}², {row['n_directions']}², depth {row['max_depth']}"
        blank = [""] * (len(header) - 4)
        rows.append(
            [
                row["mesostructure"],
                setting,
                f"{row['seconds']:.1f}",
                *blank,
                f"{row['peak_bytes'] / 2**20:.0f}",
            ]
        )
    return header, rows


def _spread(values: Sequence[float], form: str) -> str:
    """Median (least … largest), or the one number that there is."""
    middle, low, high = (f"{value:{form}}" for value in values)
    return middle if low == high else f"{middle} ({low} … {high})"


class _Process:
    """A process that does the jobs of one method; see `btfref.bench.synth_methods`."""

    def __init__(self, job: Facts) -> None:
        self._errors = tempfile.TemporaryFile("w+")
        process = subprocess.Popen(
            [sys.executable, "-m", "btfref.bench.synth_methods", json.dumps(job)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        assert process.stdin is not None
        assert process.stdout is not None
        self._process, self._orders, self._answers = process, process.stdin, process.stdout

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._orders, self._answers, self._errors):
            with suppress(BrokenPipeError):  # of a process that failed, which `answer` tells
                stream.close()

    def answer(self, order: Facts | None = None) -> Facts:
        """Send an order, if any, and wait for the answer."""
        line = ""
        try:
            if order is not None:
                self._orders.write(json.dumps(order) + "\n")
                self._orders.flush()
            line = self._answers.readline()
        except BrokenPipeError:
            pass  # told below
        if not line:
            self._process.wait()
            self._errors.seek(0)
            lines = self._errors.read().strip().splitlines()
            raise RuntimeError(lines[-1] if lines else f"exit status {self._process.returncode}")
        return json.loads(line)
