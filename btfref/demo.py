"""The whole chain on a small material: synthesis, compression, both renderers, comparison, report."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

SCENES = ("plane", "sphere", "cloth")
LIGHTS = ("directional1", "directional3", "points2")

#: What is fitted; the first is rendered in every scene, the others in one.
METHODS = ("lpca", "svd", "raw")

#: Synthesis: the size of the published examples, at a noise that the eye finds and the gates do not mind.
SYNTHESIS = {
    "mesostructure": "checker",
    "texels": 64,
    "views": "ubo81",
    "lights": "ubo81",
    "spp": 16,
    "seed": 0,
}

#: Sub-pixels per axis, the same in both renderers.
GRID = 4

#: Paths per pixel of the geometry truth.
GEOMETRY_SPP = 256

#: What each image is judged by, with the reasons in ``btfref/compare/tolerances.toml``.
GATES = ("image.finite", "image.background", "image.noise_free", "image.silhouette")


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

    cells: list
    report: Path
    seconds: dict

    @property
    def passed(self):
        """Whether every gate of every cell passed."""
        return all(cell.comparison.passed for cell in self.cells)


def demo(output="output/demo", *, progress=None):
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
    from btfref.report import write_report
    from btfref.sampling.synthesis import synthesize

    output = Path(output)
    output.mkdir(parents=True, exist_ok=True)
    clock = _Clock()
    store = output / "checker.btf.zarr"
    with clock("synthesis"):
        # The folder is the demo's own: a store that another version of it made is replaced.
        btf = synthesize(**SYNTHESIS, out=store, overwrite=True, progress=progress)
    files = {}
    for key in METHODS:
        with clock(f"fit {key}"):
            files[key] = _fit(key, btf, output, progress)
    cells = []
    jobs = [(key, scene, lights) for key in METHODS[:1] for scene in SCENES for lights in LIGHTS]
    jobs += [(key, SCENES[1], LIGHTS[0]) for key in METHODS[1:]]
    for done, (key, scene, lights) in enumerate(jobs):
        if progress:
            progress(done, len(jobs), "render")
        cells.append(_cell(key, scene, lights, files[key], clock))
    if progress:
        progress(len(jobs), len(jobs), "render")
    with clock("geometry"):
        cells.append(_geometry_cell(files[METHODS[-1]]))
    report = output / "report.html"
    with clock("report"):
        write_report(report, title="btfref demo", cells=cells, facts=_facts(files, clock))
    return DemoResult(cells, report, clock.seconds)


class _Clock:
    """Wall-clock time by stage."""

    def __init__(self):
        self.seconds = {}
        self.meta = {}

    def __call__(self, stage):
        self._stage = stage
        return self

    def __enter__(self):
        self._start = time.perf_counter()

    def __exit__(self, *_):
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + time.perf_counter() - self._start


def _fit(key, btf, output, progress):
    from btfref.registry import method
    from btfref.representations.container import save

    path = output / f"checker.{key}.exr"
    save(method(key).fit(btf, seed=SYNTHESIS["seed"], progress=progress), path)
    return path


def _cell(key, scene, lights, file, clock):
    """Reference and real-time image of one scene, and their comparison."""
    from btfref.commands._shared import scene_file
    from btfref.compare import compare
    from btfref.render.classes import pixel_classes
    from btfref.render.realtime import realtime
    from btfref.render.reference import render
    from btfref.report import Cell

    path, parameters = scene_file(scene), {"btf": str(file.resolve()), "lights": lights}
    with clock("reference"):
        reference = render(path, parameters=parameters, noise_free=GRID, shadows=False)
        classes = pixel_classes(path, parameters=parameters, grid=GRID)
    with clock("real time"):
        image = realtime(path, parameters=parameters, grid=GRID)
    clock.meta = {"reference": reference.meta, "real time": image.meta}
    comparison = compare(image.image, reference.image, classes=classes, gate=GATES)
    notes = f"{key}, {lights}. Both renderers read {file.name}; no cast shadows in either."
    images = {"reference": reference.image, "real-time": image.image}
    return Cell(f"{scene}, {lights}, {key}", images, comparison, notes)


def _geometry_cell(file):
    """The uncompressed BTF on a plane against the path-traced mesostructure."""
    from btfref.commands._shared import scene_file
    from btfref.compare import compare
    from btfref.render.geometry import render_geometry
    from btfref.render.reference import render
    from btfref.report import Cell

    path, parameters = scene_file("plane"), {"btf": str(file.resolve()), "lights": LIGHTS[0]}
    truth = render_geometry(path, parameters=parameters, spp=GEOMETRY_SPP, seed=1)
    reference = render(path, parameters=parameters, noise_free=GRID, shadows=False)
    comparison = compare(reference.image, truth.image, gate="geometry.image", variance=truth.variance)
    images = {"reference": truth.image, "real-time": reference.image}
    return Cell(
        "plane, geometry truth", images, comparison, "The mesostructure itself, path traced, against the BTF."
    )


def _facts(files, clock):
    from btfref.versions import versions

    return {
        "synthesis": SYNTHESIS,
        "sub-pixel grid": f"{GRID} × {GRID}",
        "versions": versions(),
        "seconds": {stage: round(seconds, 1) for stage, seconds in clock.seconds.items()},
        **clock.meta,
    }
