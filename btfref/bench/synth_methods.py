"""What the synthesis benchmark times: each method in a process of its own that answers orders, one line of JSON each.

What else a process holds slows Mitsuba and would fake a ratio. The process of a method lives on between rounds, so that
its kernels are compiled once and methods take turns.
"""

from __future__ import annotations

import gc
import json
import os
import statistics
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.numerics.sphere.directions import directions

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.sampling.paths.estimator import Piece
    from btfref.sampling.paths.texels import TexelPaths
    from btfref.types import Facts, JitArray


#: Pairs at which errors are measured.
PAIRS = 12

#: As in Mitsuba's path integrator, of all methods.
MAX_DEPTH = 8

#: Samples and rounds of the reference; the rounds tell its noise.
REFERENCE_SPP, REFERENCE_ROUNDS = 2048, 16

#: Pairs that the naive loop is timed on, after some that warm up.
NAIVE_PAIRS, NAIVE_WARM = 24, 3

#: Views of the slow shared-path estimator that stand for all of them in its time.
PATH_VIEWS = 8


def pairs(n_views: int, n_lights: int) -> np.ndarray:
    """The pairs at which errors are measured: random, but the same in every run."""
    rng = np.random.default_rng(2003)
    index = rng.choice(n_views * n_lights, PAIRS, replace=False)
    return np.stack([index // n_lights, index % n_lights], 1)


class Naive:
    """One `mi.render` per pair."""

    def __init__(self, mi: ModuleType, mesostructure: str, texels: int) -> None:
        from btfref.mesostructure import build

        self.mi, self.texels = mi, texels
        tile = build(mesostructure)
        # Far enough for shadows from 75 degrees.
        reach = 1 + int(np.ceil(-tile.height[0] * np.tan(np.radians(75))))
        light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
        self.scene = mi.load_dict({"type": "scene", "light": light, **merged(mi, tile, reach)})
        self.parameters = mi.traverse(self.scene)
        self.integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})

    def __call__(self, view: np.ndarray, light: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Render one pair: (texels, texels, 3) float32."""
        mi = self.mi
        up = [0, 1, 0] if abs(light[1]) < 0.9 else [1, 0, 0]
        self.parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], (-light).tolist(), up)
        self.parameters.update()
        image = mi.render(
            self.scene,
            sensor=texel_camera(mi, view, self.texels),
            integrator=self.integrator,
            spp=spp,
            seed=seed,
        )
        return np.array(image)


def merged(mi: ModuleType, tile: Mesostructure, reach: int) -> dict[str, JitArray]:
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


def texel_camera(mi: ModuleType, view: np.ndarray, texels: int) -> JitArray:
    """An orthographic camera, sheared so that pixel (row, column) sees exactly that texel's square on z = 0.

    Mitsuba's orthographic film spans [−1, 1]² in camera space with +x to the left and +y up, rays along +z. The columns
    of the matrix are the images of these axes: pixel column → x, pixel row → y, ray → −view.
    """
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = [-0.5, 0, 0], [0, -0.5, 0], -view
    # The corner (0, 0) of the tile is pixel (0, 0); the camera stands two units up the view direction.
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


def errors(values: np.ndarray, reference: np.ndarray, variance: np.ndarray) -> dict[str, float]:
    """Errors of images (pairs, texels, texels, 3) against a reference with its variance of the same shape."""
    square = (values - reference) ** 2
    kept = np.sort(square.reshape(-1))[: int(0.99 * square.size)]
    return {
        "rmse": float(np.sqrt(max((square - variance).mean(), 0))),  # the reference's own noise taken off
        "trimmed": float(np.sqrt(kept.mean())),
        "mae": float(np.abs(values - reference).mean()),
    }


class _Subject(ABC):
    """A method: ``time(seed)`` tells seconds of a whole BTF, ``images(seed)`` makes the images of the pairs."""

    def __init__(self, mi: ModuleType, job: Facts) -> None:
        from btfref.mesostructure import build

        self.mi, self.job, self.texels, self.spp = mi, job, job["texels"], job.get("spp", 0)
        self.vectors = directions("ubo81").vectors
        self.tile = build(job["mesostructure"])
        self.pairs = pairs(len(self.vectors), len(self.vectors))
        self.views, self.view = np.unique(self.pairs[:, 0], return_inverse=True)
        self.lights, self.light = np.unique(self.pairs[:, 1], return_inverse=True)
        self.settings = {"texels": (self.texels,) * 2, "spp": self.spp, "max_depth": MAX_DEPTH}

    @abstractmethod
    def time(self, seed: int) -> dict[str, float]:
        """Seconds of a whole BTF, by what takes them."""

    @abstractmethod
    def images(self, seed: int) -> np.ndarray:
        """Images of the pairs."""

    def _chosen(self, estimator: Any) -> np.ndarray:
        """Images of the pairs from an estimator of their lights."""
        found = {view: mean for view, mean, _ in estimator.all_views(self.views.tolist())}
        return np.stack(
            [found[int(view)][light] for view, light in zip(self.pairs[:, 0], self.light, strict=True)]
        )


class NaiveLoop(_Subject):
    """One `mi.render` per pair; its time is extrapolated from random pairs."""

    def __init__(self, mi: ModuleType, job: Facts) -> None:
        super().__init__(mi, job)
        self.render = Naive(mi, job["mesostructure"], self.texels)

    def _some(self, seed: int) -> np.ndarray:
        return np.random.default_rng(seed).integers(0, len(self.vectors), (NAIVE_WARM + NAIVE_PAIRS, 2))

    def time(self, seed: int) -> dict[str, float]:
        """Seconds of the loop, and of its kernels alone."""
        import drjit as dr

        vectors, times, kernels = self.vectors, [], []
        for i, (v, k) in enumerate(self._some(seed)):
            start = time.perf_counter()
            self.render(vectors[v], vectors[k], self.spp, i)
            times.append(time.perf_counter() - start)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for i, (v, k) in enumerate(self._some(seed)):
                dr.kernel_history_clear()
                self.render(vectors[v], vectors[k], self.spp, i)
                kernels.append(sum(entry["execution_time"] for entry in dr.kernel_history()) / 1e3)
        every = len(vectors) ** 2
        parts = {"seconds": times, "kernel_s": kernels}
        return {name: statistics.mean(some[NAIVE_WARM:]) * every for name, some in parts.items()}

    def images(self, seed: int) -> np.ndarray:
        """Images of the pairs, with random numbers that neither the reference nor another seed has."""
        first = 100_000 + 100 * seed
        return np.stack(
            [
                self.render(self.vectors[v], self.vectors[k], self.spp, first + i)
                for i, (v, k) in enumerate(self.pairs)
            ]
        )


class Reference(NaiveLoop):
    """The same loop with many samples, in rounds whose spread tells its noise."""

    def __init__(self, mi: ModuleType, job: Facts) -> None:
        super().__init__(mi, job)
        self.spp = REFERENCE_SPP // REFERENCE_ROUNDS

    def save(self) -> Facts:
        """Write mean and variance of the mean; means of the images of every round."""
        total = squares = np.zeros(())
        means = []
        for seed in range(-REFERENCE_ROUNDS, 0):
            images = self.images(seed).astype(np.float64)
            total, squares = total + images, squares + images**2
            means.append(images.mean((1, 2, 3)).tolist())
        n = REFERENCE_ROUNDS
        variance = np.maximum(squares - total**2 / n, 0) / (n * (n - 1))
        np.savez(self.job["reference"], mean=total / n, variance=variance)
        return {"means": means}


class SharedPaths(_Subject):
    """`TexelPaths`, its variances left out; its time is that of some views."""

    def __init__(self, mi: ModuleType, job: Facts) -> None:
        super().__init__(mi, job)
        self.time(0, 2)

    def _made(self, lights: Sequence[int] | np.ndarray, seed: int) -> TexelPaths:
        from btfref.sampling.paths.texels import TexelPaths

        class Images(TexelPaths):
            def _statistics(self, pieces: Sequence[Piece]) -> list[tuple[np.ndarray, ...]]:
                import drjit as dr

                mean = (dr.block_sum(self._buffer, self.spp) / self.spp).numpy()
                ends = np.cumsum([piece.size // self.spp for piece in pieces])[:-1]
                return [
                    (part.reshape(len(piece.lights), 3, -1).transpose(0, 2, 1), np.zeros(()))
                    for piece, part in zip(pieces, np.split(mean, ends), strict=True)
                ]

        gc.collect()  # the materials of the scene before would make other kernels
        return Images(self.tile, self.vectors[lights], views=self.vectors, seed=seed, **self.settings)

    def time(self, seed: int, n_views: int = PATH_VIEWS) -> dict[str, float]:
        """Seconds: those of what is done once, and those of some views times what they stand for."""
        n = len(self.vectors)
        start = time.perf_counter()
        estimator = self._made(range(n), seed)
        made = time.perf_counter()
        for _ in estimator.all_views(np.linspace(0, n - 1, n_views).astype(int).tolist()):
            pass
        return {"seconds": made - start + (time.perf_counter() - made) * n / n_views}

    def images(self, seed: int) -> np.ndarray:
        """Images of the pairs: what a view gets does not depend on which lights there are."""
        return self._chosen(self._made(self.lights, seed))


class SharedPoints(_Subject):
    """The surface estimator, timed as a whole."""

    def __init__(self, mi: ModuleType, job: Facts) -> None:
        super().__init__(mi, job)
        self.full: dict[int, np.ndarray] = {}
        self.time(0)

    def time(self, seed: int) -> dict[str, float]:
        """Seconds of a whole BTF in memory: images alone, as the naive loop makes them."""
        from btfref.bench import floor
        from btfref.sampling.surface.estimator import SurfaceEstimator

        gc.collect()
        every, n = range(len(self.vectors)), len(self.vectors)
        start = time.perf_counter()
        values = np.zeros((n, n, self.texels, self.texels, 3), np.float32)
        made = SurfaceEstimator(
            self.tile, self.vectors, views=self.vectors, variance=False, seed=seed, **self.settings
        )
        for view, mean, _ in made.all_views(every):
            values[view] = mean
        seconds = time.perf_counter() - start
        self.full[seed] = values[self.pairs[:, 0], self.pairs[:, 1]]
        count, seen = floor.values_of(made)
        return {"seconds": seconds, "floor_s": floor.seconds(count, seen, self.vectors), "values": count}

    def images(self, seed: int) -> np.ndarray:
        """Images of the pairs, of the whole BTF where it was made; else points and walks of their directions alone."""
        import drjit as dr

        from btfref.sampling.surface.estimator import SurfaceEstimator

        if seed in self.full:
            return self.full[seed]
        gc.collect()
        # What whole BTFs left for reuse is of other sizes, and other methods' processes wait beside this one.
        dr.flush_malloc_cache()
        settings = self.settings | {"wanted": self.views, "variance": False, "seed": seed}
        return self._chosen(
            SurfaceEstimator(self.tile, self.vectors[self.lights], views=self.vectors, **settings)
        )


SUBJECTS: dict[str, type[_Subject]] = {"naive": NaiveLoop, "path": SharedPaths, "surface": SharedPoints}


def _answers(mi: ModuleType, job: Facts) -> Iterator[Facts]:
    """What a method's process answers: a word when it is ready, then one dict for each order that comes in."""
    subject = SUBJECTS[job["task"]](mi, job)
    with np.load(job["reference"]) as data:
        reference, variance = data["mean"], data["variance"]
    # Warming up takes both cores: nobody is timed before all are through with it.
    yield {"ready": True}
    for order in map(json.loads, sys.stdin):
        answer: Facts = subject.time(order["seed"]) if order["timed"] else {}
        peak = _peak()
        values = subject.images(order["seed"]).astype(np.float64)
        if order["timed"]:
            answer |= {"errors": errors(values, reference, variance), "peak_bytes": peak}
        yield answer | {"means": values.mean((1, 2, 3)).tolist()}


def _peak() -> int:
    """Largest amount of memory that this process had so far, bytes."""
    from btfref.sampling.memory import peak

    return peak()


def _growth(job: Facts) -> Facts:
    """Time and memory of one setting, results not kept: what a store would be given view by view."""
    from btfref.mesostructure import build
    from btfref.sampling.surface.estimator import SurfaceEstimator

    vectors = directions(job["directions"]).vectors
    tile = build(job["mesostructure"])
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
    return {"seconds": seconds, "peak_bytes": _peak(), "n_directions": len(vectors)}


def main(job: Facts) -> None:
    """Carry out a job, with answers on standard output and everything else on standard error."""
    from btfref.sampling.variant import mitsuba_variant

    with os.fdopen(os.dup(1), "w") as out, mitsuba_variant("llvm_ad_rgb") as mi:
        os.dup2(2, 1)
        if job["task"] == "growth":
            answers = iter([_growth(job)])
        elif job["task"] == "reference":
            answers = iter([Reference(mi, job).save()])
        else:
            answers = _answers(mi, job)
        for answer in answers:
            out.write(json.dumps(answer) + "\n")
            out.flush()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
