"""Synthesis: the shared estimators against one render per pair, each method in a process of its own.

The naive loop is what people write: ``mi.render`` once per view-light pair, with the scene loaded once, one mesh
per material, and the light moved between renders; its time is extrapolated from a random subset of pairs. The
error of each method is measured at pairs for which a much longer reference is rendered.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from btfref.bench.data import MESOSTRUCTURES
from btfref.bench.timing import machine

#: Samples of the naive loop and of paths.
SAMPLES = (16, 64)

#: Surface points a texel for about the errors of these samples. Errors stand beside the times.
POINTS = {"checker": (10, 30), "rings": (25, 80), "tissue": (18, 60)}

#: Growth of the cost: what is varied -> its values. The others stay at `BASE`.
GROWTH = {
    "texels": (32, 64, 128, 256),
    "directions": ("5x5", "ubo81", "ubo151"),
    "max_depth": (2, 3, 4, 8),
}
BASE = {"mesostructure": "checker", "texels": 64, "directions": "ubo81", "max_depth": 8, "spp": 10}

#: Views of the slow shared-path estimator that stand for all of them in its time.
PATH_VIEWS = 8

PAIRS, SEEDS, MAX_DEPTH, REFERENCE_SPP = 12, 3, 8, 2048

#: Pairs that the naive loop is timed on.
NAIVE_PAIRS = 24


def run(*, quick=False, progress=None, only=None, btf=None):
    """Time and error of full 64² × 81² synthesis.

    Parameters
    ----------
    quick : bool
        The checker at 16² texels, one round.
    progress : callable, optional
    only : iterable of str, optional
        Mesostructures instead of all; "growth" for the growth of the cost alone.
    btf : SampledBTF, optional
        Not used.

    Returns
    -------
    dict
        ``raw``: seconds of every round per mesostructure and method; ``kernel_s``, those of the naive loop
        that its kernels take; ``errors``; ``peak_bytes``; ``growth``: one row per setting; ``parameters``;
        ``machine``.
    """
    names = list(only or (("checker",) if quick else (*MESOSTRUCTURES, "growth")))
    growing = "growth" in names
    names = [name for name in names if name != "growth"]
    rounds, texels = (1, 16) if quick else (3, 64)
    result = {"raw": {}, "errors": {}, "peak_bytes": {}, "kernel_s": {}}
    settings = _growing(quick) if growing else []
    total, done = len(names) * (1 + rounds * 3 * len(SAMPLES)) + len(settings), 0
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            reference = Path(folder) / f"{name}.npz"
            _child({"task": "reference", "mesostructure": name, "texels": texels, "out": str(reference)})
            done += 1
            raw, errors, peak, kernels = {}, {}, {}, {}
            for seed in range(rounds):
                for label, (method, spp) in methods(name).items():
                    job = {"task": method, "mesostructure": name, "texels": texels, "spp": spp, "seed": seed}
                    answer = _child(job | {"reference": str(reference)})
                    raw.setdefault(label, []).append(answer["seconds"])
                    errors.setdefault(label, []).append(answer["errors"])
                    if "kernel_s" in answer:
                        kernels.setdefault(label, []).append(answer["kernel_s"])
                    peak[label] = max(peak.get(label, 0), answer["peak_bytes"])
                    done += 1
                    if progress is not None:
                        progress(done, total, f"{name}, {label}")
            result["raw"][name], result["errors"][name], result["peak_bytes"][name] = raw, errors, peak
            result["kernel_s"][name] = kernels
    growth = []
    for setting in settings:
        growth.append(setting | _child({"task": "growth", **setting}))
        done += 1
        if progress is not None:
            progress(done, total, "growth of the cost")
    result["growth"] = growth
    parameters = {
        "texels": texels,
        "directions": "ubo81 × ubo81",
        "max_depth": MAX_DEPTH,
        "rounds": rounds,
        "pairs": PAIRS,
        "reference_spp": REFERENCE_SPP,
        "naive_pairs": NAIVE_PAIRS,
    }
    return {"suite": "synth", "parameters": parameters, "machine": machine(), **result}


def methods(name):
    """Label -> estimator and samples, for one mesostructure."""
    spp = {"naive": SAMPLES, "path": SAMPLES, "surface": POINTS[name]}
    return {f"{key} {count}": (key, count) for key, counts in spp.items() for count in counts}


def _growing(quick):
    """Settings of the growth of the cost."""
    base = BASE | ({"texels": 16} if quick else {})
    rows = [base | {"varied": name, name: value} for name, values in GROWTH.items() for value in values]
    return [row for row in rows if not quick or row["texels"] <= 32]


def table(result):
    """Header and rows for a reader."""
    header = [
        "mesostructure",
        "method",
        "s",
        "RMSE",
        "RMSE w/o 1 %",
        "MAE",
        "|z| of means",
        "× naive 16",
        "× its kernels",
        "MiB",
    ]
    rows = []
    for name, raw in result["raw"].items():
        naive = statistics.median(raw["naive 16"])
        kernels = statistics.median(result["kernel_s"][name]["naive 16"])
        for label, seconds in raw.items():
            errors = result["errors"][name][label]
            column = [statistics.median(e[key] for e in errors) for key in ("rmse", "trimmed", "mae")]
            z = max(e["z"] for e in errors)
            time = statistics.median(seconds)
            peak = result["peak_bytes"][name][label] / 2**20
            numbers = (*(f"{e:.4f}" for e in column), f"{z:.1f}", f"{naive / time:.1f}")
            rows.append([name, label, f"{time:.2f}", *numbers, f"{kernels / time:.1f}", f"{peak:.0f}"])
    for row in result["growth"]:
        setting = f"surface {row['spp']}, {row['texels']}², {row['n_directions']}², depth {row['max_depth']}"
        blank = [""] * 6
        rows.append(
            [
                row["mesostructure"],
                setting,
                f"{row['seconds']:.2f}",
                *blank,
                f"{row['peak_bytes'] / 2**20:.0f}",
            ]
        )
    return header, rows


def _child(job):
    """Run one job in a clean process; what else a process holds slows Mitsuba and would fake a ratio."""
    done = subprocess.run(
        [sys.executable, "-m", "btfref.bench.synth", json.dumps(job)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return json.loads(done.stdout.splitlines()[-1])


def pairs(n_views, n_lights):
    """The pairs at which errors are measured: random, but the same in every run."""
    rng = np.random.default_rng(2003)
    index = rng.choice(n_views * n_lights, PAIRS, replace=False)
    return np.stack([index // n_lights, index % n_lights], 1)


class Naive:
    """One `mi.render` per pair."""

    def __init__(self, mi, mesostructure, texels):
        from btfref.mesostructure import build

        self.mi, self.texels = mi, texels
        tile = build(mesostructure)
        # Far enough for shadows from 75 degrees.
        reach = 1 + int(np.ceil(-tile.height[0] * np.tan(np.radians(75))))
        light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
        self.scene = mi.load_dict({"type": "scene", "light": light, **_merged(mi, tile, reach)})
        self.parameters = mi.traverse(self.scene)
        self.integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})

    def __call__(self, view, light, spp, seed):
        """Render one pair: (texels, texels, 3) float32."""
        mi = self.mi
        up = [0, 1, 0] if abs(light[1]) < 0.9 else [1, 0, 0]
        self.parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], (-light).tolist(), up)
        self.parameters.update()
        image = mi.render(
            self.scene, sensor=_camera(mi, view, self.texels), integrator=self.integrator, spp=spp, seed=seed
        )
        return np.array(image)


def _merged(mi, tile, reach):
    """All copies of the tile as one mesh per material: the fastest that we know for a plain render."""
    shapes = {}
    offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), -1).reshape(-1, 2)
    for index, part in enumerate(tile.parts):
        n = len(part.vertices)
        uv = part.vertices[:, :2] if part.uv is None else part.uv
        properties = mi.Properties()
        properties["material"] = mi.load_dict(part.bsdf)
        mesh = mi.Mesh(
            f"part_{index}",
            n * len(offsets),
            len(part.faces) * len(offsets),
            has_vertex_normals=part.normals is not None,
            has_vertex_texcoords=True,
            props=properties,
        )
        values = mi.traverse(mesh)
        moved = np.concatenate([part.vertices + np.append(offset, 0) for offset in offsets])
        values["vertex_positions"] = moved.astype(np.float32).ravel()
        faces = np.concatenate([part.faces + np.uint32(n * copy) for copy in range(len(offsets))])
        values["faces"] = faces.astype(np.uint32).ravel()
        if part.normals is not None:
            values["vertex_normals"] = np.tile(part.normals, (len(offsets), 1)).astype(np.float32).ravel()
        values["vertex_texcoords"] = np.tile(uv, (len(offsets), 1)).astype(np.float32).ravel()
        values.update()
        shapes[f"part_{index}"] = mesh
    return shapes


def _camera(mi, view, texels):
    """An orthographic camera sheared so that pixels are the texels' squares on z = 0."""
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = [-0.5, 0, 0], [0, -0.5, 0], -view
    matrix[:3, 3] = np.array([0.5, 0.5, 0]) + 2 * view
    film = {
        "type": "hdrfilm",
        "width": texels,
        "height": texels,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    return mi.load_dict({"type": "orthographic", "to_world": mi.ScalarTransform4f(matrix), "film": film})


def _errors(values, data):
    """Errors at the reference pairs: (pairs, texels, texels, 3) against mean and variance."""
    reference, variance = data["mean"], data["variance"]
    square = (values - reference) ** 2 - variance  # the reference's own noise taken off
    flat = np.sort(((values - reference) ** 2).reshape(-1))
    kept = flat[: int(0.99 * len(flat))]
    image = values.mean((1, 2, 3)) - reference.mean((1, 2, 3))
    # The reference's noise and that of the values, whose texels are taken as independent.
    noise = np.sqrt(3 * (square.clip(0) + 2 * variance).sum((1, 2, 3))) / reference[0].size
    return {
        "rmse": float(np.sqrt(max(square.mean(), 0))),
        "trimmed": float(np.sqrt(kept.mean())),
        "mae": float(np.abs(values - reference).mean()),
        "z": float(np.abs(image / noise).max()),
        "bias": float(image.sum() / reference.mean((1, 2, 3)).sum()),
    }


def _task(job):
    """One job of `_child`."""
    import resource
    import time

    from btfref.numerics.directions import directions
    from btfref.sampling.synthesis import synthesize
    from btfref.sampling.variant import mitsuba_variant

    if job["task"] == "growth":
        return _growth(job)
    vectors, texels = directions("ubo81").vectors, job["texels"]
    kernel_s = None
    chosen = pairs(len(vectors), len(vectors))
    if job["task"] in ("naive", "reference"):
        with mitsuba_variant("llvm_ad_rgb") as mi:
            render = Naive(mi, job["mesostructure"], texels)
            if job["task"] == "reference":
                rounds = 16
                images = np.stack(
                    [
                        [
                            render(vectors[v], vectors[k], REFERENCE_SPP // rounds, 1000 * r + i)
                            for i, (v, k) in enumerate(chosen)
                        ]
                        for r in range(rounds)
                    ]
                ).astype(np.float64)
                np.savez(job["out"], mean=images.mean(0), variance=images.var(0, ddof=1) / rounds)
                return {}
            rng = np.random.default_rng(job["seed"])
            some = rng.integers(0, len(vectors), (NAIVE_PAIRS + 3, 2))
            import drjit as dr

            times, kernels = [], []
            for i, (v, k) in enumerate(some):
                start = time.perf_counter()
                render(vectors[v], vectors[k], job["spp"], i)
                times.append(time.perf_counter() - start)
            seconds = statistics.mean(times[3:]) * len(vectors) ** 2
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                for i, (v, k) in enumerate(some):
                    dr.kernel_history_clear()
                    render(vectors[v], vectors[k], job["spp"], i)
                    kernels.append(sum(entry["execution_time"] for entry in dr.kernel_history()))
            kernel_s = statistics.mean(kernels[3:]) / 1e3 * len(vectors) ** 2
            values = np.stack(
                [
                    render(vectors[v], vectors[k], job["spp"], 77 + job["seed"] * 100 + i)
                    for i, (v, k) in enumerate(chosen)
                ]
            )
    else:
        settings = {"texels": texels, "spp": job["spp"], "estimator": job["task"], "max_depth": MAX_DEPTH}
        # Warm kernels; a path takes long, its views cost about the same and its kernels are warm after some.
        path = job["task"] == "path"
        everything = np.unique(np.concatenate([chosen[:, 0], np.linspace(0, 80, PATH_VIEWS).astype(int)]))
        used = everything if path else np.arange(len(vectors))
        for warm in (True, False):
            # The warm-up's result is dropped first: memory is touched anew otherwise, and the peak is that of two.
            btf = None
            views = vectors[used[:4]] if warm and path else vectors[used]
            start = time.perf_counter()
            # Images alone, as the naive loop makes them.
            btf = synthesize(job["mesostructure"], views=views, lights=vectors, seed=job["seed"],
                             dtype="float32", variance=False, **settings)  # fmt: skip
            seconds = (time.perf_counter() - start) * len(vectors) / len(views)
        values = btf.values[np.searchsorted(used, chosen[:, 0]), chosen[:, 1]]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    with np.load(job["reference"]) as data:
        answer = {"seconds": seconds, "peak_bytes": peak, "errors": _errors(values.astype(np.float64), data)}
    return answer if kernel_s is None else answer | {"kernel_s": kernel_s}


def _growth(job):
    """Time and memory of one setting, results not kept: what a store would be given view by view."""
    import gc
    import resource
    import time

    from btfref.mesostructure import build
    from btfref.numerics.directions import directions
    from btfref.sampling.surface_estimator import SurfaceEstimator
    from btfref.sampling.variant import mitsuba_variant

    vectors = directions(job["directions"]).vectors
    tile = build(job["mesostructure"])
    with mitsuba_variant("llvm_ad_rgb"):
        for _ in range(2):
            # The first run compiles kernels, whose constants are those of this setting. Its BSDFs must be gone
            # before the second one starts: two scenes are other kernels.
            estimator = None
            gc.collect()
            start = time.perf_counter()
            estimator = SurfaceEstimator(
                tile, vectors, views=vectors, texels=(job["texels"],) * 2, spp=job["spp"], seed=0,
                max_depth=job["max_depth"], variance=False,
            )  # fmt: skip
            for _ in estimator.all_views(range(len(vectors))):
                pass
            seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"seconds": seconds, "peak_bytes": peak, "n_directions": len(vectors)}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_task(json.loads(sys.argv[1]))) + "\n")
