"""What loading a part of a fitted file costs: time and peak memory against the share of its bytes that is kept.

Each measurement is a process of its own, which has loaded its modules and read the file's header before. Rounds go
through all files and parts in turn, so that a part and the whole of the same round make a pair.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import material_name
from btfref.bench.options import Options
from btfref.bench.timing import machine, peak_memory, reset_peak

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import Facts

#: Methods whose files are laid out for it, each in its own way: by pairs, by clusters and views, by levels, by views.
METHODS = ("raw", "lpca", "laplacian", "rf_lobes")

#: Shares of the views that are kept; 1: the whole file, as it is read without a choice.
SHARES = (1.0, 0.02, 0.1, 0.3, 0.6)

#: Texels along a side, and rounds; of the quick run.
SIZE, ROUNDS = (64, 3), (16, 2)


def run(options: Options) -> Facts:
    """Time and peak of loading parts of files.

    Parameters
    ----------
    options : Options
        ``quick``: fewer texels, rounds and shares. ``only``: some of :data:`METHODS`. ``btf``: instead of the checker
        at 81² directions.

    Returns
    -------
    dict
        ``summary``: method → list of parts: ``views`` that are kept, ``share`` of the maps' bytes, ``bytes`` of the
        maps that are kept, ``cpu_s`` and ``peak_bytes`` (growth of the process), each with ``median``, ``least``,
        ``most`` and ``of_whole``, the median ratio of pairs; ``file_bytes``; ``parameters``; ``machine``.
    """
    from btfref.registry import method
    from btfref.representations import save

    options.demand(METHODS)
    methods = [key for key in METHODS if options.wants(key)]
    texels, rounds = ROUNDS if options.quick else SIZE
    shares = SHARES[:3] if options.quick else SHARES
    btf = options.btf if options.btf is not None else _checker(texels)
    counts = [None if share == 1 else max(1, round(share * len(btf.views))) for share in shares]
    total, done = len(methods) * (1 + rounds * len(counts)), 0
    found: dict[tuple[str, int | None], list[Facts]] = {}
    sizes = {}
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for key in methods:
            options.tell(done, total, f"fit {key}")
            files[key] = Path(folder) / f"x.{key}.exr"
            save(method(key).fit(btf), files[key])
            sizes[key] = files[key].stat().st_size
            done += 1
        for _ in range(rounds):
            for key in methods:
                for count in counts:
                    options.tell(done, total, f"load {key}")
                    measured = _alone(files[key], key, _views(len(btf.views), count))
                    found.setdefault((key, count), []).append(measured)
                    done += 1
    return {
        "suite": "loading",
        "parameters": {
            "material": material_name(btf),
            "texels": list(btf.texels),
            "views": len(btf.views),
            "lights": len(btf.lights),
            "rounds": rounds,
        },
        "file_bytes": sizes,
        "summary": {
            key: [_part(len(btf.views), count, found[key, count], found[key, None]) for count in counts]
            for key in methods
        },
        "machine": machine(),
    }


def _checker(texels: int) -> SampledBTF:
    from btfref.sampling.synthesis import synthesize

    return synthesize("checker", texels=texels, spp=2, estimator="surface")


def _views(n: int, count: int | None) -> list[int] | None:
    """Views that are kept: neighbours, as a camera asks for."""
    return None if count is None else list(range((n - count) // 2, (n - count) // 2 + count))


def _alone(path: Path, key: str, views: list[int] | None) -> Facts:
    """:func:`measured` by a process that does nothing else."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measured, str(path), key, views).result()


def measured(path: str, key: str, views: list[int] | None) -> Facts:
    """Load a file, or the maps of some views, and tell what that took.

    Parameters
    ----------
    path : str
    key : str
        Of its method.
    views : list of int or None
        None for the whole file.

    Returns
    -------
    dict
        ``cpu_s``, ``wall_s``; ``peak_bytes``: how far the process grew, None where the system does not tell;
        ``bytes`` of the maps that were kept.
    """
    import OpenEXR  # noqa: F401 - what loads with the first file is no part of what is measured

    from btfref.registry import method
    from btfref.representations.file.container import load, read_info

    assert method(key).representation
    read_info(path)
    before = reset_peak()
    start, wall = time.process_time(), time.perf_counter()
    made = load(path, views=None if views is None else np.array(views))
    cpu, wall = time.process_time() - start, time.perf_counter() - wall
    peak = peak_memory()
    return {
        "cpu_s": cpu,
        "wall_s": wall,
        "peak_bytes": None if before is None or peak is None else max(0, peak - before),
        "bytes": sum(array.nbytes for array in made.arrays().values()),
    }


def _part(n: int, count: int | None, rounds: list[Facts], wholes: list[Facts]) -> Facts:
    """What rounds of a part say, beside those of the whole file."""
    kept = rounds[0]["bytes"]
    return {
        "views": n if count is None else count,
        "share": kept / wholes[0]["bytes"],
        "bytes": kept,
        **{name: _summary(name, rounds, wholes) for name in ("cpu_s", "peak_bytes")},
    }


def _summary(name: str, rounds: list[Facts], wholes: list[Facts]) -> Facts | None:
    values = [one[name] for one in rounds]
    if None in values:
        return None
    pairs = [
        one / whole[name]
        for one, whole in zip(values, wholes, strict=True)
        if whole[name] is not None and whole[name] > 0
    ]
    return {
        "median": statistics.median(values),
        "least": min(values),
        "most": max(values),
        "of_whole": statistics.median(pairs) if pairs else None,
    }


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: a file and a part of it each."""
    rows = []
    for key, parts in result["summary"].items():
        for part in parts:
            cells = []
            for name, scale, form in (("cpu_s", 1e3, "{:.0f}"), ("peak_bytes", 2.0**-20, "{:.1f}")):
                found = part[name]
                if found is None:
                    cells += ["–", "–"]
                    continue
                low, middle, high = (form.format(scale * found[k]) for k in ("least", "median", "most"))
                ratio = found["of_whole"]
                cells += [f"{middle} ({low} … {high})", "–" if ratio is None else f"{100 * ratio:.0f}"]
            rows.append((key, str(part["views"]), f"{100 * part['share']:.1f}", *cells))
    return (
        "method",
        "views kept",
        "share of the maps, %",
        "processor time, ms",
        "% of the whole's",
        "peak, MiB",
        "% of the whole's",
    ), rows
