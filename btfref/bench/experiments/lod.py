"""Level of detail: what it takes off the error of one sample a pixel, off flicker, and off the cost of far surfaces.

The truth is the same representation without levels of detail at 1024 samples a pixel, by the reference renderer.
Flicker is the RMS over pixels of what changes between consecutive frames beyond what changes in the truth, relative to
the truth's mean.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import interleaved, machine, summary

if TYPE_CHECKING:
    from btfref.gates import GateResult
    from btfref.report import Cell
    from btfref.types import Facts, JitArray, Progress


#: Scene: the parameter that moves, and its step between frames.
MOVES = {"horizon": ("advance", 0.04), "turning": ("turn", 0.5)}

#: n of the n × n samples of the truth.
TRUTH = 32

FRAMES = 2

#: Tiles along the plane of the cost: texels of several pixels, and a texture of far less than one.
NEAR, FAR = 1, 4096

SIZE = (256, 256)

#: Of the reference renderer's pictures: it records a kernel in Python for each, which small ones would measure.
LARGE = (1024, 1024)


def run(options: Options) -> Facts:
    """Errors, flicker, fetches and times.

    Parameters
    ----------
    options : Options
        ``quick``: two frames, 144 samples. ``btf``: default: a checker of 64² texels. ``only``: among "horizon",
        "turning", "cost". ``report``: HTML page with the pictures.

    Returns
    -------
    dict
        ``summary``: by scene, ``error`` and ``flicker`` without and with level of detail, of each renderer, and their
        ``ratio``; ``cost``: near and far, fetches of GLSL and times; ``raw``: seconds.
    """
    from btfref.bench.data import checker
    from btfref.registry import method
    from btfref.representations import save

    options.demand((*MOVES, "cost"))
    btf = options.btf or checker(spp=16, progress=options.progress)
    tell = options.tell
    frames, grid = (2, 12) if options.quick else (FRAMES, TRUTH)
    found: Facts = {}
    raw: Facts = {}
    cells = []
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "bench.laplacian.exr")
        save(method("laplacian").fit(btf, progress=options.progress), path)
        for scene in [s for s in MOVES if options.wants(s)]:
            found[scene], pictures = _moving(scene, path, frames, grid, tell)
            cells.append(_cell(scene, pictures, found[scene]))
        if options.wants("cost"):
            found["cost"], raw = _cost(path, 5 if options.quick else 9, tell)
    result = {
        "suite": "lod",
        "parameters": {"frames": frames, "samples": grid**2, "size": SIZE, "large": LARGE},
        "raw": raw,
        "summary": found,
        "machine": machine(),
    }
    if options.report is not None:
        from btfref.report import write_report

        facts = {"machine": result["machine"], "found": found}
        write_report(options.report, title="Level of detail", cells=cells, facts=facts)
    return result


def _moving(
    scene: str, path: str, frames: int, grid: int, tell: Progress
) -> tuple[Facts, dict[str, np.ndarray]]:
    """Error and flicker of a scene, and the pictures of its first frame."""
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.reference import render
    from btfref.scene.shipped import scene_file

    file, (moved, step) = scene_file(scene), MOVES[scene]
    kinds = ("none", "auto")
    pictures: dict[tuple[str, str], list[np.ndarray]] = {
        (kind, r): [] for kind in kinds for r in ("GLSL", "Mitsuba")
    }
    truths = []
    for frame in range(frames):
        tell(frame, frames, scene)
        parameters = {"btf": path, moved: str(frame * step)}
        truths.append(render(file, parameters=parameters | {"lod": "none"}, grid=grid, shadows=False).image)
        for kind in kinds:
            own = parameters | {"lod": kind}
            pictures[kind, "GLSL"].append(realtime(file, parameters=own, grid=1, shadows=False).image)
            pictures[kind, "Mitsuba"].append(render(file, parameters=own, grid=1, shadows=False).image)
    truth = np.stack(truths).astype(float)
    seen = (truth != 0).any(-1)
    mean = truth[seen].mean()
    # A silhouette that moves changes a pixel wholly, with and without levels: only what is seen in both frames counts.
    both = seen[1:] & seen[:-1]
    result: Facts = {"error": {}, "flicker": {}}
    for (kind, renderer), frames_of in pictures.items():
        images = np.stack(frames_of).astype(float)
        result["error"].setdefault(renderer, {})[kind] = _rms((images - truth)[seen]) / mean
        change = np.diff(images, axis=0) - np.diff(truth, axis=0)
        result["flicker"].setdefault(renderer, {})[kind] = _rms(change[both]) / mean
    for figure in ("error", "flicker"):
        for values in result[figure].values():
            values["ratio"] = values["none"] / values["auto"]
    shown = {"reference": truth[0].astype(np.float32), "1 sample, with levels": pictures["auto", "GLSL"][0]}
    return result, shown | {"1 sample, without": pictures["none", "GLSL"][0]}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _cell(scene: str, pictures: dict[str, np.ndarray], found: Facts) -> Cell:
    """The scene's part of the report."""
    from btfref.comparison import compare
    from btfref.gates import Measured, judge
    from btfref.report import Cell

    comparison = compare(pictures["1 sample, with levels"], pictures["reference"], flip=False)
    gates: list[GateResult] = []
    if scene == "horizon":
        gates = judge("lod.antialiasing", {"error_ratio": Measured(found["error"]["GLSL"]["ratio"])})
    notes = "; ".join(
        f"{figure} {values['none']:.4f} without, {values['auto']:.4f} with levels ({renderer})"
        for figure in ("error", "flicker")
        for renderer, values in found[figure].items()
    )
    return Cell(f"{scene}, one sample a pixel", pictures, comparison, notes, tuple(gates))


def _cost(path: str, rounds: int, tell: Progress) -> tuple[Facts, dict[str, dict[str, list[float]]]]:
    """Fetches and times of a plane that fills the picture, near and far."""
    import drjit as dr

    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.gl.renderer import Renderer
    from btfref.rendering.offline import reference
    from btfref.scene import camera, loading
    from btfref.scene.description import read_scene
    from btfref.scene.shipped import scene_file

    file = scene_file("plane")
    parameters = {k: {"btf": path, "tiling": str(n)} for k, n in (("near", NEAR), ("far", FAR))}
    fetches = {
        k: realtime(file, parameters=p, grid=1, shadows=False, size=SIZE, count_fetches=True).meta["fetches"]
        for k, p in parameters.items()
    }
    tell(1, 3, "GLSL")
    renderers = {k: Renderer(read_scene(file, p, size=SIZE)) for k, p in parameters.items()}
    try:
        raw = {"GLSL": interleaved({k: r.draw for k, r in renderers.items()}, rounds)}
    finally:
        for renderer in renderers.values():
            renderer.release()
    tell(2, 3, "Mitsuba")
    with contextlib.ExitStack() as stack:
        tasks = {}
        for k, p in parameters.items():
            made = stack.enter_context(loading.loaded(file, p, size=LARGE))
            camera.tell_camera(made, 1.0)
            tasks[k] = _reference_task(camera, reference, dr, made)
        raw["Mitsuba"] = interleaved(tasks, rounds)
    times = {name: summary(t, "near") for name, t in raw.items()}
    return {"fetches": fetches | {"ratio": fetches["far"] / fetches["near"]}, "times": times}, raw


def _reference_task(
    camera: ModuleType, reference: ModuleType, dr: ModuleType, scene: JitArray
) -> Callable[[], None]:
    """Noise-free shading, one sample a pixel."""

    def task() -> None:
        ray, _ = camera.film_rays(scene.sensors()[0], (0.5, 0.5))
        dr.eval(reference.direct(scene, ray, False))
        dr.sync_thread()

    return task


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people."""
    header = ("scene", "figure", "renderer", "without / near", "with / far", "ratio")
    rows: list[tuple[str, ...]] = []
    for scene, found in result["summary"].items():
        if scene == "cost":
            f = found["fetches"]
            rows.append(
                (scene, "fetches", "GLSL", f"{f['near']:.1f}", f"{f['far']:.1f}", f"{f['ratio']:.3f}")
            )
            for renderer, t in found["times"].items():
                near, far = (1e3 * t[k]["median_s"] for k in ("near", "far"))
                rows.append((scene, "ms", renderer, f"{near:.1f}", f"{far:.1f}", f"{t['far']['ratio']:.3f}"))
            continue
        for figure in ("error", "flicker"):
            for renderer, v in found[figure].items():
                values = (f"{v[k]:.4f}" for k in ("none", "auto"))
                rows.append((scene, figure, renderer, *values, f"{v['ratio']:.2f}"))
    return header, rows
