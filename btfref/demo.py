"""The whole chain on a small material: synthesis, compression, both renderers, comparison, report."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.scene.shipped import scene_file
from btfref.types import Facts, PathLike, Progress

if TYPE_CHECKING:
    import numpy as np

    from btfref.rendering import RenderResult
    from btfref.report import Cell

SCENES = ("plane", "sphere", "cloth")
LIGHTS = {
    "directional1": "1 directional light",
    "directional3": "3 directional lights",
    "points2": "2 point lights",
}

#: What is fitted. The first is rendered in every scene under all lights, the others once, on the sphere.
METHODS = ("lpca", "svd", "raw")

#: The scene that `btfref.rendering.offline.geometry` can replace by the mesostructure itself.
FLAT = "plane"

#: What is synthesized: 64 × 64 texels and 81 × 81 directions, the default. 10 points a texel leave the noise of 16
#: paths, which the eye finds and the gates do not mind, since every renderer shows the same noisy material.
MESOSTRUCTURE, SPP = "checker", 10

#: Sub-pixels per axis, the same in both renderers.
GRID = 4

#: Paths per pixel of the geometry truth, and its seed (not the synthesis's: their noise must be independent).
GEOMETRY: Facts = {"spp": 64, "seed": 1}

#: What the two renderers are judged by; the reasons are in ``btfref/gates/tolerances.toml``.
GATES = ("image.noise_free", "image.silhouette", "image.background")


@dataclass(frozen=True)
class DemoResult:
    """What `demo` made.

    Parameters
    ----------
    cells : list of btfref.report.Cell
    report : pathlib.Path
        The HTML file.
    seconds : dict of str to float
        Wall-clock time of each stage.
    """

    cells: list[Cell]
    report: Path
    seconds: dict[str, float]

    @property
    def passed(self) -> bool:
        """Whether every gate of every cell passed."""
        return all(cell.outcome == "pass" for cell in self.cells)


def demo(output: PathLike = "output/demo", *, progress: Progress | None = None) -> DemoResult:
    """Run the whole chain and write a report.

    Parameters
    ----------
    output : path-like
        Folder for everything that is made; a finished store in it with the same parameters is used again.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    DemoResult
    """
    from btfref.images import save_image
    from btfref.report import write_report

    chain = _Chain(Path(output), progress or (lambda done, total, label: None))
    chain.output.mkdir(parents=True, exist_ok=True)
    chain.make_material()
    jobs = [(METHODS[0], scene, lights) for scene in SCENES for lights in LIGHTS]
    jobs += [(method, "sphere", "directional1") for method in METHODS[1:]]
    rendered, against = {}, {}
    for done, job in enumerate(jobs):
        chain.progress(done, len(jobs), "rendering")
        rendered[job] = chain.renderers_cell(*job)
    chain.progress(len(jobs), len(jobs), "rendering")
    for method in (METHODS[-1], METHODS[0]):
        against[method] = chain.geometry_cell(method, "directional1")
    cells = [*rendered.values(), *against.values()]
    report = chain.output / "report.html"
    with chain.timed("report"):
        save_image(chain.output / "demo.png", overview(rendered, against))
        write_report(report, title="btfref demo", cells=cells, facts=chain.facts())
    return DemoResult(cells, report, chain.seconds)


def overview(rendered: Mapping[tuple[str, str, str], Cell], against: Mapping[str, Cell]) -> np.ndarray:
    """Eight pictures in two rows, for the README.

    Parameters
    ----------
    rendered : dict of (method, scene, lights) to Cell
    against : dict of method to Cell

    Returns
    -------
    ndarray, shape (2 H, 4 W, 3)
        Above, the plane: geometry truth, uncompressed, compressed, that in real time. Below, compressed:
        sphere and cloth, each reference and real time. Linear radiance.
    """
    import numpy as np

    best, raw = METHODS[0], METHODS[-1]
    plane = rendered[best, FLAT, "directional1"].images
    flat = [plane["truth"], against[raw].images["representation"], plane["reference"], plane["realtime"]]
    curved = [
        rendered[best, scene, "directional3"].images[side]
        for scene in ("sphere", "cloth")
        for side in ("reference", "realtime")
    ]
    return np.concatenate([np.concatenate(row, axis=1) for row in (flat, curved)])


@dataclass
class _Chain:
    """The stages, with what they share: files, pixel classes, truths, times, facts about renderers."""

    output: Path
    progress: Progress
    files: dict[str, Path] = field(default_factory=dict)
    classes: dict[str, np.ndarray] = field(default_factory=dict)
    truths: dict[str, tuple[RenderResult, np.ndarray]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    renderers: dict[str, Facts] = field(default_factory=dict)
    synthesis: dict = field(default_factory=dict)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def make_material(self) -> None:
        """Sampled BTF and representations."""
        from btfref.registry import method
        from btfref.representations.file.container import save
        from btfref.sampling.settings import SynthesisSettings
        from btfref.sampling.synthesis import synthesize

        with self.timed("synthesis"):
            # The folder is the demo's own: a store that another version of it made is replaced.
            store = self.output / "checker.btf.zarr"
            settings = SynthesisSettings(spp=SPP)
            btf = synthesize(MESOSTRUCTURE, settings, out=store, overwrite=True, progress=self.progress)
            told = ("texels", "views", "lights", "spp", "seed")
            self.synthesis = {"mesostructure": MESOSTRUCTURE} | {k: getattr(settings, k) for k in told}
            self.synthesis["estimator"] = btf.attributes["estimator"]
        for key in METHODS:
            with self.timed(f"fit {key}"):
                self.files[key] = (self.output / f"checker.{key}.exr").resolve()
                save(method(key).fit(btf, seed=settings.seed, progress=self.progress), self.files[key])

    def arguments(self, method: str, scene: str, lights: str) -> tuple[Path, dict[str, str]]:
        """What every renderer is called with."""
        return scene_file(scene), {"btf": str(self.files[method]), "lights": lights}

    def reference(self, method: str, scene: str, lights: str) -> RenderResult:
        """The noise-free reference, and the pixel classes of the scene."""
        from btfref.rendering.offline.reference import render
        from btfref.scene.pixel_classes import pixel_classes

        path, parameters = self.arguments(method, scene, lights)
        with self.timed("reference"):
            result = render(path, parameters=parameters, grid=GRID, shadows=False)
            if scene not in self.classes:
                self.classes[scene] = pixel_classes(path, parameters=parameters, grid=GRID)
        self.renderers["reference"] = result.meta
        return result

    def truth(self, lights: str) -> tuple[RenderResult, np.ndarray]:
        """The mesostructure itself, path traced, and the pixels where it may be compared."""
        from btfref.rendering.offline.geometry import geometry_classes, render_geometry

        if lights not in self.truths:
            path, parameters = self.arguments(METHODS[0], FLAT, lights)
            with self.timed("geometry truth"):
                result = render_geometry(path, parameters=parameters, **GEOMETRY)
                self.truths[lights] = result, geometry_classes(path, parameters=parameters, grid=GRID)
            self.renderers["geometry truth"] = result.meta
        return self.truths[lights]

    def renderers_cell(self, method: str, scene: str, lights: str) -> Cell:
        """Real-time image against the reference, both reading one file and one scene."""
        from btfref.comparison import compare
        from btfref.rendering.gl.realtime import realtime
        from btfref.report import Cell

        reference = self.reference(method, scene, lights)
        path, parameters = self.arguments(method, scene, lights)
        with self.timed("real time"):
            image = realtime(path, parameters=parameters, grid=GRID, shadows=False)
        self.renderers["real time"] = image.meta
        images = {"reference": reference.image, "realtime": image.image}
        if scene == FLAT:
            images["truth"] = self.truth(lights)[0].image
        with self.timed("comparison"):
            comparison = compare(image.image, reference.image, classes=self.classes[scene], gate=GATES)
        notes = f"Both renderers read {self.files[method].name} and {path.name}. Neither casts shadows."
        return Cell(f"{method} · {scene} · {LIGHTS[lights]}", images, comparison, notes)

    def geometry_cell(self, method: str, lights: str) -> Cell:
        """A representation on the plane against the path-traced mesostructure."""
        from btfref.comparison import compare
        from btfref.report import Cell

        truth, classes = self.truth(lights)
        reference = self.reference(method, FLAT, lights)
        with self.timed("comparison"):
            comparison = compare(
                reference.image, truth.image, classes=classes, gate="geometry.image", variance=truth.variance
            )
        images = {"truth": truth.image, "representation": reference.image}
        notes = (
            "The representation (B) against the mesostructure itself, path traced (A): what sampling 81 × 81 "
            "directions on 64 × 64 texels and compression lose. Pixels near the border, where the geometry "
            "shows its edge, are left out."
        )
        return Cell(f"{method} against geometry · {FLAT} · {LIGHTS[lights]}", images, comparison, notes)

    def facts(self) -> Facts:
        """What the report says about how it was made."""
        from btfref.representations.file.container import read_info

        sizes = {key: read_info(file) for key, file in self.files.items()}
        return {
            "synthesis": self.synthesis,
            "representations": {
                key: f"{info['payload_bytes']} bytes, 1:{info['ratio']:.4g}" for key, info in sizes.items()
            },
            "sub-pixel grid": f"{GRID} × {GRID}",
            "renderers": self.renderers,
            "seconds": {stage: round(seconds, 1) for stage, seconds in self.seconds.items()},
            "command": "btfref demo",
        }
