"""Demand: what skipping saves. Synthesis of what one scene needs against the whole, and shares of the shipped scenes.

A synthesis of a part costs a constant (kernels, geometry) and its share of the whole. Both are measured in one process
with warm kernels, in turn; the constant is what a part of a single pair costs. Paths from a texel serve all lights, so
that a few lights save less than a few views: views with all their lights are measured as well.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from btfref.bench.timing import interleaved, machine, peak_memory, reset_peak, summary

#: Scene with one camera and one light, for which the BTF is traced.
ONE_LIGHT = ("plane", {"lights": "directional1"})

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

#: Methods whose maps are loaded in part.
METHODS = ("raw", "lpca", "laplacian", "rf_lobes", "gbrdf")

BASELINE = "whole"


def run(*, quick=False, progress=None, btf=None, only=None):
    """Costs of parts and shares of scenes.

    Parameters
    ----------
    quick : bool
        16² texels at 2 samples and one scene's size instead of 64² at 16.
    progress : callable, optional
    btf : SampledBTF, optional
        What the methods are fitted to; default: a checker.
    only : iterable of str, optional
        Among "synthesis" and "scenes".

    Returns
    -------
    dict
        ``synthesis``: seconds and bytes of whole, needed part and single pair, shares, whether the pictures are equal;
        ``scenes``: by scene, shares needed, and by method those of bytes of maps, bytes read, loading time, peak memory
        of it, and frame time; ``raw``;
        ``parameters``; ``machine``.
    """
    tell = progress or (lambda *_: None)
    result = {"suite": "demand", "parameters": {"quick": quick}, "machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        if only is None or "synthesis" in only:
            result["synthesis"] = synthesis(Path(folder), quick, tell)
        if only is None or "scenes" in only:
            result["scenes"] = scenes(Path(folder), btf, quick, tell)
    return result


def synthesis(folder, quick, progress):
    """One camera and one light before a plane: the part that they need against the whole."""
    from btfref.demand import demand
    from btfref.numerics.directions import directions
    from btfref.render.reference import render
    from btfref.representations import raw, save
    from btfref.sampling import SampledBTF, open_store
    from btfref.sampling.part import Part
    from btfref.sampling.synthesis import synthesize_store
    from btfref.scenes import scene_file

    texels, spp = (16, 2) if quick else (64, 16)
    scene, parameters = ONE_LIGHT
    parameters = parameters | {"tiling": "4"}
    ubo = directions("ubo81")
    start = time.perf_counter()
    (needed,) = demand(
        scene_file(scene), parameters=parameters, shape=(ubo, ubo, (texels, texels)), grid=4
    ).values()
    seconds_demand = time.perf_counter() - start
    views = needed.part().views
    parts = {
        BASELINE: None,
        "needed": needed.part(),
        "its views, all lights": Part(views),
        "single pair": Part((0,), (0,)),
    }

    def task(name, part):
        def synthesize():
            path = folder / f"{name}.btf.zarr"
            shutil.rmtree(path, ignore_errors=True)
            settings = {"texels": texels, "spp": spp, "views": "ubo81", "lights": "ubo81"}
            synthesize_store(path, "checker", only=part, **settings)

        return synthesize

    progress(0, 2, "synthesis")
    # Two views of all lights, and the small parts, warm all kernels up: the whole once more would take minutes.
    for part in (Part(views[:2]), parts["needed"], parts["single pair"]):
        task("warm-up", part)()
    seconds = {}
    for name, part in parts.items():
        start = time.perf_counter()
        task(name, part)()
        seconds[name] = [time.perf_counter() - start]
    size = {name: _bytes(folder / f"{name}.btf.zarr") for name in parts}
    progress(1, 2, "pictures")
    images, maps = {}, {}
    for name, made in (
        ("needed", raw.fit_partial(open_store(folder / "needed.btf.zarr"))),
        (BASELINE, raw.fit(SampledBTF.load(folder / f"{BASELINE}.btf.zarr", variance=False))),
    ):
        path = folder / f"{name}.raw.exr"
        save(made, path)
        maps[name] = made.maps["values"].nbytes
        images[name] = render(
            scene_file(scene), parameters=parameters | {"btf": str(path)}, noise_free=4
        ).image
    found = summary(seconds, BASELINE)
    count = {
        "needed": int(needed.views.sum() * needed.lights.sum()),
        BASELINE: needed.pairs.size,
        "single pair": 1,
    }
    constant = found["single pair"]["ratio"]
    share, share_of_views = count["needed"] / count[BASELINE], len(views) / len(needed.views)
    return {
        "texels": texels,
        "spp": spp,
        "raw": seconds,
        "summary": found,
        "seconds_demand": seconds_demand,
        "views": int(needed.views.sum()),
        "lights": int(needed.lights.sum()),
        "share_of_samples": share,
        "share_of_time": found["needed"]["ratio"],
        "constant_of_time": constant,
        "slope": (found["needed"]["ratio"] - constant) / share,
        "share_of_views": share_of_views,
        "slope_of_views": (found["its views, all lights"]["ratio"] - constant) / share_of_views,
        "bytes": size,
        "share_of_bytes": size["needed"] / size[BASELINE],
        "share_of_map_bytes": maps["needed"] / maps[BASELINE],
        "equal_pictures": bool(np.array_equal(images["needed"], images[BASELINE])),
    }


def scenes(folder, btf, quick, progress):
    """What each shipped scene needs, and what its maps then cost to keep, to load and to look up."""
    from btfref.bench.data import checker
    from btfref.demand import choice, demand, maps_needed
    from btfref.registry import method
    from btfref.representations import load, save
    from btfref.scenes import scene_file

    btf = btf or checker(texels=16 if quick else 64, spp=2, progress=progress)
    paths = {key: folder / f"scenes.{key}.exr" for key in METHODS}
    for key, path in paths.items():
        save(method(key).fit(btf), path)
    whole = {key: load(path) for key, path in paths.items()}
    size, rounds = ((64, 64), 1) if quick else ((256, 256), 5)
    found = {}
    for number, (name, (scene, fixed, frames)) in enumerate(SCENES.items()):
        progress(number, len(SCENES), name)
        file = scene_file(scene)
        steps = [{key: str(v)} for key, values in frames.items() for v in values] or [{}]
        entry = {"methods": {}}
        for key, path in paths.items():
            one, kept = None, None
            for step in steps:
                parameters = fixed | step | {"btf": str(path)}
                (some,) = demand(file, parameters=parameters, grid=2, size=size).values()
                one = some if one is None else one | some
            kept = choice(one)
            entry["shares"] = {what: n / m for what, (n, m) in one.shares().items()}
            times = interleaved(
                {
                    "all": lambda path=path: load(path),
                    "needed": lambda path=path, kept=kept: load(path, **kept),
                },
                rounds,
            )
            entry["methods"][key] = {
                "bytes": _payload(load(path, **kept)) / _payload(whole[key]),
                "read": _bytes_read(path, kept) / path.stat().st_size,
                "load": summary(times, "all")["needed"],
                "memory": _memory(
                    lambda path=path, kept=kept: load(path, **kept), lambda path=path: load(path)
                ),
                "frame": _frames(file, parameters, kept, size, rounds),
                "raw": times,
                "maps": {what: n / m for what, (n, m) in maps_needed(one, whole[key]).maps.items()},
            }
        found[name] = entry
    return found


def _frames(file, parameters, kept, size, rounds):
    """Times of real-time frames with the needed maps alone over those with all, in turn.

    None with an environment, whose light comes from tables that are made of all maps.
    """
    from btfref.render.realtime import Renderer
    from btfref.render.scene import read_scene
    from btfref.representations import load

    scene = read_scene(file, parameters, size=size)
    if scene.environment is not None:
        return None
    with Renderer(scene) as whole, Renderer(scene, lambda path: load(path, **kept)) as some:
        times = {"all": [], "needed": []}
        for number in range(rounds + 1):
            for name, renderer in (("all", whole), ("needed", some)):
                seconds = 1e-3 * renderer.draw()
                if number:
                    times[name].append(seconds)
    return summary(times, "all")["needed"]


def _memory(needed, whole):
    """Peak memory of a loading over that of the other one; None where the system does not tell."""
    peaks = []
    for task in (needed, whole):
        before = reset_peak()
        held = task()
        after = peak_memory()
        del held
        peaks.append(None if before is None or after is None else max(after - before, 0))
    return peaks[0] / peaks[1] if all(peaks) else None


def _bytes_read(path, kept):
    """Bytes of a file that loading a choice reads: all where rows and parts of their own are not worth it."""
    from btfref.representations.container import bytes_of_choice

    return bytes_of_choice(path, kept)


def _payload(representation):
    """Bytes of the maps without direction tables."""
    return sum(
        a.nbytes for name, a in representation.arrays().items() if not name.startswith(("view_", "light_"))
    )


def _bytes(path):
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())


def _spread(entry):
    """Median ratio with its extremes, in percent."""
    return " ".join(
        [
            f"{100 * entry['ratio']:.0f} %",
            f"({100 * entry['ratio_min']:.0f} … {100 * entry['ratio_max']:.0f})",
        ]
    )


def table(result):
    """Rows for people: what is needed of what, and what it costs."""
    rows = []
    if one := result.get("synthesis"):
        name = "synthesis for one camera, one light"
        rows += [
            (name, "samples", f"{100 * one['share_of_samples']:.2f} %"),
            (name, "time", f"{100 * one['share_of_time']:.2f} %"),
            (name, "time of a single pair (the constant)", f"{100 * one['constant_of_time']:.2f} %"),
            (name, "(time − constant) / samples", f"{one['slope']:.2f}"),
            (name, "views", f"{100 * one['share_of_views']:.2f} %"),
            (name, "(time of its views with all lights − constant) / views", f"{one['slope_of_views']:.2f}"),
            (name, "bytes of the store", f"{100 * one['share_of_bytes']:.2f} %"),
            (name, "bytes of the table", f"{100 * one['share_of_map_bytes']:.2f} %"),
            (name, "pictures equal bit by bit", str(one["equal_pictures"])),
        ]
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
