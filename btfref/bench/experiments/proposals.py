"""Importance sampling: variance times time of what can propose light directions, for every method with lobes.

1 / (variance · time) is the efficiency of an estimator (Pharr, Jakob, Humphreys, "Physically Based Rendering").
Pictures of the shipped sphere, direct light only: with emitter sampling and multiple importance sampling as users
render, and by samples of the BSDF alone, which shows the proposal itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import interleaved, machine, summary

if TYPE_CHECKING:
    from btfref.registry import Method
    from btfref.types import Facts, PathLike


#: What is compared; ratios are to the first, the guide that all methods share.
CHOICES = ("data", "lobes", "both", "cosine")

#: Tiles over the sphere: a texel covers several pixels, so that the variance is that of the directions and not of the
#: texture inside a pixel.
MAGNIFIED = 0.5

SAMPLES, SIZE = 64, 128

#: Pictures of independent seeds from which a variance is estimated.
PICTURES = 4


def run(options: Options) -> Facts:
    """Variance and time of each choice, in each light, with and without emitter sampling.

    Parameters
    ----------
    options : Options
        ``quick``: fewer rounds. ``btf``: default: a checker of 64² texels and 81² directions. ``only``: keys of the
        methods; default: all that have lobes of their own.

    Returns
    -------
    dict
        ``summary``: by "method, light, estimator" and choice ``variance`` (of a sample, relative to the squared mean
        radiance), times as in :func:`btfref.bench.timing.summary`, and ``inefficiency``: variance times time over that
        of the guide; ``raw``: seconds.
    """
    import mitsuba_plugins
    from btfref.bench.data import checker
    from btfref.registry import methods
    from btfref.representations import save

    options.demand(methods())
    btf = options.btf or checker(spp=8, progress=options.progress)
    mi = mitsuba_plugins.ready()
    raw, result = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for key, row in methods().items():
            if (key not in options.only) if options.only else not _has_lobes(row):
                continue
            path = Path(folder) / f"bench.{key}.exr"
            save(row.fit(btf), path)
            scenes = _scenes(mi)
            for i, (name, scene) in enumerate(scenes.items()):
                options.tell(i, len(scenes), key)
                cell = f"{key}, {name}"
                tasks = {choice: _task(mi, scene, path, choice) for choice in CHOICES}
                pictures = {choice: [task() for _ in range(PICTURES)] for choice, task in tasks.items()}
                raw[cell] = interleaved(tasks, 3 if options.quick else 7)
                result[cell] = _efficiency(pictures, summary(raw[cell], CHOICES[0]))
    parameters = {"spp": SAMPLES, "size": SIZE, "pictures": PICTURES, "shape": list(btf.values.shape)}
    return {
        "suite": "proposals",
        "parameters": parameters,
        "raw": raw,
        "summary": result,
        "machine": machine(),
    }


def _has_lobes(row: Method) -> bool:
    from importlib import import_module

    from mitsuba_plugins.protocol import Proposes

    return isinstance(import_module(row.plugin).Evaluator, Proposes)


def _efficiency(pictures: Mapping[str, Sequence[np.ndarray]], times: Mapping[str, Facts]) -> Facts:
    """Variance of a sample, and variance times time relative to the first choice."""
    result = {}
    mean = np.mean([image.mean() for image in pictures[CHOICES[0]]])
    for choice, images in pictures.items():
        variance = float(np.var(images, axis=0, ddof=1).mean()) * SAMPLES / float(mean) ** 2
        result[choice] = times[choice] | {"variance": variance, "mean": float(np.mean(images) / mean)}
    first = result[CHOICES[0]]["variance"]
    for own in result.values():
        own["inefficiency"] = own["variance"] / first * own["ratio"]
    return result


def _scenes(mi: ModuleType) -> dict[str, Facts]:
    """Scenes without material, by light and estimator."""
    from btfref.scene.environment import sunsky
    from btfref.scene.shipped import scene_file

    t = mi.ScalarTransform4f
    upright = t().rotate([1, 0, 0], 90)
    sky = sunsky(shape=(64, 128)).radiance
    lights = {
        "constant": {"type": "constant"},
        "sun and sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": upright},
        "large lamp": {
            "type": "rectangle",
            "to_world": t().look_at([2, -2, 3], [0, 0, 0], [0, 0, 1]).scale([1.5, 1.5, 1]),
            "emitter": {"type": "area", "radiance": 5.0},
        },
    }
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "component_format": "float32"}
    sensor = {
        "type": "perspective",
        "fov": 30,
        "to_world": t().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
    }
    estimators = {
        "direct": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 1},
        "BSDF alone": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
    }
    shape = {"type": "ply", "filename": str(scene_file("sphere").with_name("sphere.ply"))}
    return {
        f"{light}, {estimator}": {
            "type": "scene",
            "integrator": {**integrator, "hide_emitters": True},
            "sensor": sensor,
            "shape": shape,
            "light": emitter,
        }
        for light, emitter in lights.items()
        for estimator, integrator in estimators.items()
    }


def _task(mi: ModuleType, scene: Facts, path: PathLike, choice: str) -> Callable[[], np.ndarray]:
    import drjit as dr

    bsdf = {"type": "btf", "filename": str(path), "sampling": choice}
    bsdf["to_uv"] = mi.ScalarTransform4f().scale([MAGNIFIED, MAGNIFIED, 1])
    loaded = mi.load_dict(scene | {"shape": scene["shape"] | {"bsdf": bsdf}})
    seeds = iter(range(1 << 30))

    def picture() -> np.ndarray:
        # An opaque seed: a literal one would compile the kernel anew.
        return np.array(mi.render(loaded, spp=SAMPLES, seed=dr.opaque(mi.UInt32, next(seeds))))

    return picture


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: cell, then variance, time and their product relative to the guide."""
    header = ("method, light, estimator", "", *CHOICES)
    rows = []
    for cell, choices in result["summary"].items():
        first = choices[CHOICES[0]]["variance"]
        ratios = {
            "variance": [c["variance"] / first for c in choices.values()],
            "time": [c["ratio"] for c in choices.values()],
            "variance × time": [c["inefficiency"] for c in choices.values()],
        }
        rows += [(cell, name, *(f"{r:.2f}" for r in values)) for name, values in ratios.items()]
    return header, rows
