"""Demand: what skipping saves. Synthesis of what scenes need against the whole, and shares of the shipped scenes.

A synthesis costs a constant (kernels, geometry), something per view, whose paths serve all its lights, and something
per pair, whose shadow rays are its own. All three are fitted to the times of parts that have few and many of both;
parts and whole are measured in turn, in one process with warm kernels.
"""

from __future__ import annotations

import itertools
import operator
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import interleaved, machine, peak_memory, reset_peak, summary

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.scene.demand import Demand
    from btfref.types import Facts, PathLike, Progress


#: Scenes for which the BTF is traced: one camera and one light each.
TRACED = {
    "plane, 1 light": ("plane", {"lights": "directional1", "tiling": "4"}),
    "sphere, 1 light": ("sphere", {"lights": "directional1"}),
}

#: Shipped scenes, and the parameters of their frames where there are several.
SCENES = {
    "plane, 1 light": ("plane", {"lights": "directional1"}, {}),
    "plane, 3 lights": ("plane", {"lights": "directional3"}, {}),
    "sphere, 1 light": ("sphere", {"lights": "directional1"}, {}),
    "cloth, 2 points": ("cloth", {"lights": "points2"}, {}),
    "cloth, sky": ("cloth", {"lights": "constant"}, {}),
    "horizon": ("horizon", {}, {}),
    "turning, 8 frames": ("turning", {}, {"turn": [45 * i for i in range(8)]}),
}

#: Those of a quick run.
QUICK_SCENES = ("plane, 1 light", "cloth, sky", "horizon")

#: Methods whose maps are loaded in part.
METHODS = ("raw", "lpca", "laplacian", "rf_lobes", "gbrdf")

BASELINE = "whole"

#: Part of the result -> the estimator that it is about.
ESTIMATORS = {"synthesis": "path", "surface": "surface"}


def run(options: Options) -> Facts:
    """Costs of parts and shares of scenes.

    Parameters
    ----------
    options : Options
        ``quick``: texels, samples, pictures, rounds and methods as few as a test has time for. ``btf``: what the
        methods are fitted to; default: a checker. ``only``: among "synthesis", "surface" and "scenes".

    Returns
    -------
    dict
        ``synthesis``: seconds, samples and bytes of parts and whole by paths, the law of the cost, whether pictures are
        equal; ``surface``: the same of the surface estimator;
        ``scenes``: by scene, shares needed, and by method those of bytes of maps, bytes read, loading time, peak memory
        of it, and frame time; ``raw``;
        ``parameters``; ``machine``.
    """
    options.demand((*ESTIMATORS, "scenes"))
    tell = options.tell
    result = {"suite": "demand", "parameters": {"quick": options.quick}, "machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        for part, estimator in ESTIMATORS.items():
            if options.wants(part):
                result[part] = synthesis(Path(folder), estimator, options.quick, tell)
        if options.wants("scenes"):
            result["scenes"] = scenes(Path(folder), options.btf, options.quick, tell)
    return result


def synthesis(folder: Path, estimator: str, quick: bool, progress: Progress) -> Facts:
    """Parts that scenes need against the whole: times, their law, bytes, pictures."""
    from btfref.numerics.sphere.directions import directions
    from btfref.sampling.settings import SynthesisSettings
    from btfref.sampling.store.selection import Selection
    from btfref.sampling.synthesis import synthesize_store
    from btfref.scene.demand import demand
    from btfref.scene.shipped import scene_file

    texels, spp, rounds = (8, 2, 1) if quick else (64, 8, 3)
    size = (32, 32) if quick else (256, 256)
    directions_name = "3x6" if quick else "ubo81"
    known = directions(directions_name)
    needed: dict[str, Demand] = {}
    seconds_demand = {}
    for name, (scene, parameters) in TRACED.items():
        progress(len(needed), len(TRACED), "first hits")
        start = time.perf_counter()
        (needed[name],) = demand(
            scene_file(scene),
            parameters=parameters,
            shape=(known, known, (texels, texels)),
            grid=2,
            size=size,
        ).values()
        seconds_demand[name] = time.perf_counter() - start
    few = needed["plane, 1 light"]
    views, lights = (tuple(np.flatnonzero(mask).tolist()) for mask in (few.views, few.lights))
    parts = {BASELINE: None} | {name: one.part() for name, one in needed.items()}
    parts |= {
        "its views, all lights": Selection(views),
        "its lights, all views": Selection(None, lights),
        "its views, one light": Selection(views, lights[:1]),
        "single pair": Selection(views[:1], lights[:1]),
    }
    settings = SynthesisSettings(
        texels=texels, spp=spp, views=directions_name, lights=directions_name, estimator=estimator
    )
    seconds: dict[str, list[float]] = {name: [] for name in parts}
    pairs = {}
    # Parts warm all kernels up: the whole once more would take a minute.
    warm_up = [] if quick else [(name, False) for name in parts if name != BASELINE]
    turns = warm_up + [(name, True) for _ in range(rounds) for name in parts]
    for number, (name, counted) in enumerate(turns):
        progress(number, len(turns), "synthesis")
        path = folder / f"{name}.btf.zarr"
        shutil.rmtree(path, ignore_errors=True)
        start = time.perf_counter()
        store = synthesize_store(path, "checker", settings, only=parts[name])
        if counted:
            seconds[name].append(time.perf_counter() - start)
        pairs[name] = np.asarray(store.coverage.all((2, 3)))
    found = summary(seconds, BASELINE)
    counts = {name: (int(mask.any(1).sum()), int(mask.sum())) for name, mask in pairs.items()}
    law = cost_law({name: (*counts[name], found[name]["median_s"]) for name in parts})
    whole = found[BASELINE]["median_s"]
    rows = {}
    for name, (n_views, n_pairs) in counts.items():
        share = n_pairs / counts[BASELINE][1]
        rows[name] = {
            "views": n_views,
            "pairs": n_pairs,
            "share_of_samples": share,
            "seconds": found[name],
            "slope": (found[name]["median_s"] - law["constant_s"]) / whole / share,
            "law_s": law["constant_s"] + law["view_s"] * n_views + law["pair_s"] * n_pairs,
            "share_of_bytes": _bytes(folder / f"{name}.btf.zarr") / _bytes(folder / f"{BASELINE}.btf.zarr"),
        }
    pictures = {}
    for number, name in enumerate(TRACED):
        progress(number, len(TRACED), "pictures")
        pictures[name] = _pictures(folder, name, size)
        rows[name] |= pictures[name] | {"seconds_demand": seconds_demand[name]}
    return {
        "texels": texels,
        "spp": spp,
        "rounds": rounds,
        "raw": seconds,
        "parts": rows,
        "law": law,
        "equal_pictures": all(one["equal_picture"] for one in pictures.values()),
    }


def cost_law(parts: Mapping[str, tuple[int, int, float]]) -> Facts:
    """Constant, seconds per view and per pair from the times of parts: t = a + b views + c pairs, none below 0.

    Parameters
    ----------
    parts : dict of str to (int, int, float)
        Views, pairs and seconds; at least four.

    Returns
    -------
    dict
        ``constant_s``, ``view_s``, ``pair_s``; ``lights_per_view``: lights that cost as much as the view they belong
        to; ``largest_residual``: of a part's time, relative.
    """
    from scipy.optimize import nnls

    n_views, n_pairs, seconds = np.array(list(parts.values()), float).T
    # Relative errors: short parts count as much as the whole.
    columns = np.stack([np.ones(len(seconds)), n_views, n_pairs], 1) / seconds[:, None]
    law, _ = nnls(columns, np.ones(len(seconds)))
    return {
        "constant_s": float(law[0]),
        "view_s": float(law[1]),
        "pair_s": float(law[2]),
        "lights_per_view": float(law[1] / law[2]) if law[2] > 0 else None,
        "largest_residual": float(np.abs(columns @ law - 1).max()),
    }


def _pictures(folder: Path, name: str, size: tuple[int, int]) -> Facts:
    """The scene's picture from what was traced for it and from the whole: whether equal, and shares of the table."""
    from btfref.rendering.offline.reference import render
    from btfref.representations import save
    from btfref.representations.tabulated import raw
    from btfref.sampling import SampledBTF, open_store
    from btfref.scene.shipped import scene_file

    scene, parameters = TRACED[name]
    images, maps, files = [], [], []
    for label, made in (
        ("part", raw.fit_partial(open_store(folder / f"{name}.btf.zarr"))),
        (BASELINE, raw.fit(SampledBTF.load(folder / f"{BASELINE}.btf.zarr", variance=False))),
    ):
        path = folder / f"{label}.raw.exr"
        save(made, path)
        maps.append(made.maps["values"].nbytes)
        files.append(path.stat().st_size)
        shown = render(scene_file(scene), parameters=parameters | {"btf": str(path)}, grid=2, size=size)
        images.append(shown.image)
    return {
        "share_of_map_bytes": maps[0] / maps[1],
        "share_of_file_bytes": files[0] / files[1],
        "equal_picture": bool(np.array_equal(images[0], images[1])),
    }


def scenes(folder: Path, btf: SampledBTF | None, quick: bool, progress: Progress) -> Facts:
    """What each shipped scene needs, and what its maps then cost to keep, to load and to look up."""
    from btfref.bench.data import checker
    from btfref.registry import method
    from btfref.representations import load, save
    from btfref.representations.protocol import SeesTexels
    from btfref.scene.demand import choice, demand, maps_needed
    from btfref.scene.shipped import scene_file

    btf = btf or checker(texels=16 if quick else 64, spp=2, progress=progress)
    methods = METHODS[1:2] if quick else METHODS
    paths = {key: folder / f"scenes.{key}.exr" for key in methods}
    for number, (key, path) in enumerate(paths.items()):
        progress(number, len(paths), "fits")
        save(method(key).fit(btf), path)
    whole = {key: load(path) for key, path in paths.items()}
    size, rounds = ((32, 32), 1) if quick else ((256, 256), 5)
    shown = [name for name in SCENES if not quick or name in QUICK_SCENES]
    found: Facts = {}
    shared: Demand | None = None
    turns = list(itertools.product(shown, paths))
    for number, (name, key) in enumerate(turns):
        progress(number, len(turns), name)
        scene, fixed, frames = SCENES[name]
        file, path = scene_file(scene), paths[key]
        steps = [{k: str(v)} for k, values in frames.items() for v in values] or [{}]
        steps = steps[:1] if quick else steps
        if key == next(iter(paths)):
            shared, found[name] = None, {"methods": {}}
        # What a scene needs depends on the method only where lookups leave their texture coordinates.
        elsewhere = isinstance(whole[key], SeesTexels)
        if shared is None or elsewhere:
            own = [
                next(iter(demand(file, parameters=settings, grid=1 if quick else 2, size=size).values()))
                for settings in (fixed | step | {"btf": str(path)} for step in steps)
            ]
            one = reduce(operator.or_, own)
            shared = shared if elsewhere else one
        else:
            one = shared
        one = replace(one, file=str(path))
        kept, entry = choice(one), found[name]
        entry.setdefault("shares", {what: n / m for what, (n, m) in one.shares().items()})
        load_all, load_needed = partial(load, path), partial(load, path, **kept)
        times = interleaved({"all": load_all, "needed": load_needed}, rounds)
        some = load_needed()
        parameters = fixed | steps[-1] | {"btf": str(path)}
        entry["methods"][key] = {
            "bytes": _payload(some) / _payload(whole[key]),
            "read": _bytes_read(path, kept) / path.stat().st_size,
            "load": summary(times, "all")["needed"],
            "memory": _memory(load_needed, load_all),
            "frame": _frames(file, parameters, whole[key], some, size, rounds),
            "raw": times,
            "maps": {what: n / m for what, (n, m) in maps_needed(one, whole[key]).maps.items()},
        }
    return found


def _frames(
    file: PathLike,
    parameters: Facts,
    whole: Representation,
    some: Representation,
    size: tuple[int, int],
    rounds: int,
) -> dict[str, float] | None:
    """Times of real-time frames with the needed maps alone over those with all, in turn.

    None with an environment, whose light comes from tables that are made of all maps.
    """
    from btfref.rendering.gl.renderer import Renderer
    from btfref.scene.description import read_scene

    scene = read_scene(file, parameters, size=size)
    if scene.environment is not None:
        return None
    with Renderer(scene, lambda path: whole) as first, Renderer(scene, lambda path: some) as second:
        times: dict[str, list[float]] = {"all": [], "needed": []}
        for number in range(rounds + 1):
            for name, renderer in (("all", first), ("needed", second)):
                seconds = 1e-3 * renderer.draw()
                if number:
                    times[name].append(seconds)
    return summary(times, "all")["needed"]


def _memory(needed: Callable[[], object], whole: Callable[[], object]) -> float | None:
    """Peak memory of a loading over that of the other one; None where the system does not tell."""
    peaks = []
    for task in (needed, whole):
        before = reset_peak()
        held = task()
        after = peak_memory()
        del held
        peaks.append(None if before is None or after is None else max(after - before, 0))
    part, all_of_it = peaks
    return part / all_of_it if part and all_of_it else None


def _bytes_read(path: Path, kept: Facts) -> int:
    """Bytes of a file that loading a choice reads: all where rows and parts of their own are not worth it."""
    from btfref.representations.file.container import bytes_of_choice

    return bytes_of_choice(path, kept)


def _payload(representation: Representation) -> int:
    """Bytes of the maps without direction tables."""
    return sum(
        a.nbytes for name, a in representation.arrays().items() if not name.startswith(("view_", "light_"))
    )


def _bytes(path: Path) -> int:
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())


def _spread(entry: Mapping[str, float], digits: int = 0) -> str:
    """Median ratio with its extremes, in percent."""
    middle, least, most = (f"{100 * entry[name]:.{digits}f}" for name in ("ratio", "ratio_min", "ratio_max"))
    return f"{middle} % ({least} … {most})"


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: what is needed of what, and what it costs."""
    rows: list[tuple[str, ...]] = []
    for kind in ESTIMATORS:
        if (one := result.get(kind)) is None:
            continue
        for name, part in one["parts"].items():
            what = f"{kind}: " + (f"of what {name} needs" if name in TRACED else name)
            text = f"{part['views']} views, {part['pairs']} pairs: {100 * part['share_of_samples']:.2f} % of samples, "
            text += f"{part['seconds']['median_s']:.2f} s, {_spread(part['seconds'], 2)} of the time, "
            text += f"law {part['law_s']:.2f} s, (time − constant) / samples {part['slope']:.2f}, "
            text += f"{100 * part['share_of_bytes']:.2f} % of the bytes"
            if "equal_picture" in part:
                table_share, file_share = part["share_of_map_bytes"], part["share_of_file_bytes"]
                text += f", table {100 * table_share:.1f} %, its file {100 * file_share:.1f} %"
                text += f", pictures equal bit by bit: {part['equal_picture']}, found in {part['seconds_demand']:.1f} s"
            rows.append((what, "", text))
        law = one["law"]
        text = f"{law['constant_s']:.2f} s + {1e3 * law['view_s']:.1f} ms per view"
        text += f" + {1e3 * law['pair_s']:.2f} ms per pair"
        if law["lights_per_view"] is not None:
            text += f"; a view costs as much as {law['lights_per_view']:.1f} lights"
        rows.append((f"{kind}: law", "", f"{text}; off by {100 * law['largest_residual']:.0f} % at most"))
    for scene, entry in result.get("scenes", {}).items():
        rows += [(scene, what, f"{100 * share:.1f} %") for what, share in entry["shares"].items()]
        for key, costs in entry["methods"].items():
            further = "".join(f", {what} {100 * share:.0f} %" for what, share in costs["maps"].items())
            memory, frame = costs["memory"], costs["frame"]
            text = f"maps {100 * costs['bytes']:.1f} %, read {100 * costs['read']:.0f} %, load {_spread(costs['load'])}"
            text += "" if memory is None else f", peak {100 * memory:.0f} %"
            text += f", frame {_spread(frame) if frame else '–'}{further}"
            rows.append((scene, key, text))
    return ("what", "needed", "share"), rows
