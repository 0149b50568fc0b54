"""What a plan measures of what it built: each measure yields raw records, from which all metrics are computed later.

A record is a dictionary for one line of JSON. Times are in seconds: ``cold_s`` the first call, kernels compiled and
caches filled, ``warm_s`` one item a round. Rounds of one record and of others of the same measure and material took
turns, so that item i of each makes a pair.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from btfref.bench import scenes
from btfref.bench.data import source_of
from btfref.bench.timing import interleaved, kernels, peak_memory, reset_peak
from btfref.querying import off_grid
from btfref.stress.evaluators import DEFINITION, EVALUATORS, evaluator
from btfref.stress.lookups import hemisphere

if TYPE_CHECKING:
    from btfref.bench.plan import Entry, Plan
    from btfref.bench.subjects import Built
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, JitArray, PathLike


def timed_builds(
    makes: Mapping[str, Callable[[dict[str, Built]], Built]],
    rounds: int,
    report: Callable[[str], object] = lambda name: None,
) -> tuple[dict[str, Built], dict[str, Facts]]:
    """Build every entry in each round, in turn.

    Parameters
    ----------
    makes : dict of str to callable
        ``built -> Built``: gets what is built already, by name.
    rounds : int
        The first holds the cold times.
    report : callable, optional
        Called with a name before it is built.

    Returns
    -------
    built : dict of str to Built
    records : dict of str to dict
        ``peak_bytes``: how far the process grew beyond what it held before; None where the system does not tell.
    """
    built: dict[str, Built] = {}
    records: dict[str, Facts] = {}
    for i in range(rounds):
        for name, make in makes.items():
            report(name)
            built.pop(name, None)
            before = reset_peak()
            start = time.perf_counter()
            built[name] = make(built)
            seconds = time.perf_counter() - start
            peak = peak_memory()
            if i:
                records[name]["warm_s"].append(seconds)
                continue
            records[name] = {
                "cold_s": seconds,
                "warm_s": [],
                "payload": built[name].payload,
                "peak_bytes": None if before is None or peak is None else max(0, peak - before),
            }
    return built, records


def sample_queries(btf: SampledBTF, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Random measured entries of a BTF, to be asked of every representation.

    Parameters
    ----------
    btf : SampledBTF
    n : int
    rng : numpy.random.Generator

    Returns
    -------
    dict of str to ndarray
        ``uv``, ``w_light``, ``w_view`` (texel centres and measured directions, float64); ``expected`` (n, 3).
    """
    shape = btf.values.shape
    view, light, row, column = (rng.integers(0, k, n) for k in shape[:4])
    return {
        "uv": (np.stack([column / shape[3], row / shape[2]], 1) + 0.5 / np.array([shape[3], shape[2]])),
        "w_light": btf.lights.vectors[light],
        "w_view": btf.views.vectors[view],
        "expected": btf.values[view, light, row, column].astype(np.float32),
    }


def off_grid_rows(btf: SampledBTF, plan: Plan) -> dict[str, dict[str, np.ndarray]] | None:
    """Path-traced rows at directions that nobody fitted: see `btfref.querying.off_grid`.

    Parameters
    ----------
    btf : SampledBTF
        What is fitted.
    plan : Plan

    Returns
    -------
    dict of dict, or None
        Footprint → columns; None without the geometry that the BTF is of.
    """
    source = source_of(btf)
    if source is None:
        return None
    n, spp = (plan.settings[f"off_grid_{name}"] for name in ("rows", "spp"))
    return off_grid.true_rows(source, n, spp, max(btf.values.shape[2:4]))


def off_grid_answers(built: Built, truth: off_grid.Truth) -> np.ndarray:
    """Answers to those rows: (footprints, 2, n, 3) float32, B and the variance of its mean over the footprint."""
    # A peer is asked for values alone.
    found = off_grid.answers(cast("Representation", built.representation or built), truth)
    return np.array(list(found.values()), np.float32)


def measure_eval(
    built: Built, path: PathLike | None, plan: Plan, entry: Entry, rng: np.random.Generator
) -> Iterator[Facts]:
    """Evaluations by all evaluators that the plan has points for, each on its own number of them.

    Yields
    ------
    dict
        ``largest_difference`` from NumPy's values at the first points, over the largest of these.
    """
    # What is no method of ours has no port.
    known = [name for name in EVALUATORS if name in plan.settings["points"]]
    known = known if built.representation is not None else [DEFINITION]
    points = {name: random_points(plan.settings["points"][name], rng) for name in known}
    for query in entry.query:
        reference = None
        for name in known:
            # A peer is asked for values alone.
            subject = evaluator(name, cast("Representation", built.representation or built), path, **query)
            with subject.prepare(*points[name]) as evaluation:
                cold, facts = _cold(evaluation.run, EVALUATORS[name].compiles)
                times = interleaved({name: evaluation.run}, plan.rounds["eval"])[name]
                found = evaluation.values()
                if facts:
                    facts["kernels"]["warm_execution_s"] = kernels(evaluation.run)["execution_s"]
            if reference is None:
                reference, some = found, points[name]
            else:
                # The same points again, by this evaluator.
                found = subject.evaluate(*some)
            largest = float(np.abs(reference).max())
            difference = float(np.abs(found - reference).max()) / largest if largest else 0.0
            yield {
                "query": query,
                "evaluator": name,
                "points": len(points[name][0]),
                "cold_s": cold,
                "warm_s": times,
                **facts,
                "largest_difference": difference,
            }


def random_points(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texture coordinates and directions, uniform over the tile and over the hemispheres.

    Parameters
    ----------
    n : int
    rng : numpy.random.Generator

    Returns
    -------
    uv : ndarray of float32, shape (n, 2)
    w_light, w_view : ndarray of float32, shape (n, 3)
    """
    return rng.random((n, 2), np.float32), hemisphere(rng, n), hemisphere(rng, n)


def measure_render(
    subjects: Sequence[tuple[Entry, PathLike]], btf: SampledBTF, plan: Plan
) -> Iterator[tuple[Entry | None, Facts]]:
    """Pictures of equal samples: every build in turn with the baseline, and the first with the other plain materials.

    A kernel calls the materials that are alive, whether its scene shows them or not: with all methods alive, each
    compiled for as long as all of them together. So there are no more than one of them and the plain ones at a time.

    Parameters
    ----------
    subjects : list of (Entry, path)
    btf : SampledBTF
    plan : Plan

    Yields
    ------
    entry or None, dict
        None for a plain material; ``variance`` is the mean over the pixels of the squared noise of one picture, by
        half the squared difference of two, ``mean`` that of the radiance; ``baseline_s`` of an entry are the
        baseline's times in its rounds.
    """
    plain: dict[str, tuple[Entry | None, Facts, Facts]] = {
        name: (None, {}, bsdf) for name, bsdf in scenes.plain_materials(btf).items()
    }
    groups = [(entry, path, query) for entry, path in subjects for query in entry.query]
    for scene in plan.settings["scenes"]:
        for number, (entry, path, query) in enumerate(groups):
            name = " ".join([entry.name, *map(str, query.values())])
            chosen = plain if number == 0 else {scenes.BASELINE: plain[scenes.BASELINE]}
            materials = {**chosen, name: (entry, query, scenes.btf_material(path, query))}
            records = _rendered(materials, scene, plan)
            for key, (own, _, _) in materials.items():
                if own is not None:
                    records[key]["baseline_s"] = records[scenes.BASELINE]["warm_s"]
                if own is not None or number == 0:
                    yield own, records[key]


def _rendered(
    materials: Mapping[str, tuple[Entry | None, Facts, Facts]], scene: str, plan: Plan
) -> dict[str, Facts]:
    """Records of materials in one scene, in turn."""
    import mitsuba as mi

    tasks, cold = {}, {}
    pictures: dict[str, list[np.ndarray]] = {}
    for name, (_, _, bsdf) in materials.items():
        loaded = mi.load_dict(scenes.scene(scene, bsdf, size=plan.settings["render_size"]))
        render = scenes.render_task(loaded, plan.settings["render_spp"])
        pictures[name] = []
        tasks[name] = _keeping(render, pictures[name])
    # After all are loaded: another material changes every kernel.
    for name, task in tasks.items():
        cold[name] = _cold(task, True)
    times = interleaved(tasks, plan.rounds["render"])
    result = {}
    for name, (_, query, _) in materials.items():
        one, other = pictures[name]
        result[name] = {
            "name": name,
            "query": query,
            "scene": scene,
            "spp": plan.settings["render_spp"],
            "cold_s": cold[name][0],
            "warm_s": times[name],
            **cold[name][1],
            "variance": float(((one - other) ** 2).mean() / 2),
            "mean": float(one.mean()),
        }
    # Materials are in cycles with their scenes: the next kernels would call them too.
    tasks.clear()
    del loaded, render
    gc.collect()
    return result


def measure_sampling(entry: Entry, path: PathLike, plan: Plan) -> Iterator[Facts]:
    """Light directions by the data against cosine-distributed ones: variance and time of the same picture.

    A sphere in a constant sky, light from the material's samples alone.

    Yields
    ------
    dict
        For each way, ``variance`` (mean over pixels of the noise's squares, from ``repeats`` independent pictures),
        ``warm_s`` in rounds that took turns.
    """
    import mitsuba as mi

    integrator = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
    settings = plan.settings
    for query in entry.query:
        tasks, pictures = {}, {}
        for way in ("data", "cosine"):
            bsdf = scenes.btf_material(path, query, sampling=way)
            made = scenes.scene("sphere, sky", bsdf, size=settings["sampling_size"], integrator=integrator)
            render = scenes.render_task(mi.load_dict(made), settings["sampling_spp"])
            pictures[way] = [np.array(render()) for _ in range(settings["sampling_repeats"])]
            tasks[way] = render
        times = interleaved(tasks, plan.rounds["sampling"])
        for way, found in pictures.items():
            stack = np.stack(found)
            yield {
                "query": query,
                "way": way,
                "repeats": len(found),
                "warm_s": times[way],
                "variance": float(stack.var(0, ddof=1).mean()),
                "mean": float(stack.mean()),
            }


def measure_realtime(entry: Entry, path: PathLike, plan: Plan) -> Iterator[Facts]:
    """Frame times of the shipped cloth in GLSL: timer or wall clock, whichever is longer.

    Yields
    ------
    dict
        ``variance`` is the mean over the pixels of the squared noise of one frame, by half the squared difference of
        two, ``mean`` that of the radiance.
    """
    from btfref.rendering.frames import interpolated
    from btfref.rendering.gl.renderer import Renderer
    from btfref.scene.description import read_scene
    from btfref.scene.shipped import scene_file

    for query in entry.query:
        for size in plan.settings["frames"]:
            parameters = {"btf": str(path), "lights": "directional3"}
            if "filter_type" in query:
                parameters["filter"] = query["filter_type"]
            scene = read_scene(scene_file("cloth"), parameters, size=tuple(size))
            with Renderer(interpolated(scene, query.get("interpolation"))) as renderer:
                cold = 1e-3 * renderer.draw()
                one = renderer.read()
                times = [1e-3 * renderer.draw(frame=k) for k in range(1, plan.rounds["realtime"] + 2)][1:]
                other = renderer.read()
            yield {
                "query": query,
                "size": list(size),
                "cold_s": cold,
                "warm_s": times,
                "variance": float(((one - other) ** 2).mean() / 2),
                "mean": float(one.mean()),
            }


def saved(built: Built, entry: Entry, folder: PathLike) -> Path | None:
    """File of a build, or None for a peer."""
    if built.representation is None:
        return None
    from btfref.representations import save

    handle = tempfile.NamedTemporaryFile(dir=folder, suffix=f".{entry.method}.exr", delete=False)
    handle.close()
    save(built.representation, handle.name)
    return Path(handle.name)


def _cold(task: Callable[[], object], jit: bool) -> tuple[float, Facts]:
    """Seconds of the first call, and what its kernels took where there are any."""
    facts = []
    start = time.perf_counter()
    if jit:
        facts.append(kernels(task))
    else:
        task()
    seconds = time.perf_counter() - start
    return seconds, {"kernels": facts[0]} if facts else {}


def _keeping(render: Callable[[], JitArray], pictures: list[np.ndarray]) -> Callable[[], None]:
    def task() -> None:
        image = render()
        if len(pictures) < 2:
            pictures.append(np.array(image))

    return task
