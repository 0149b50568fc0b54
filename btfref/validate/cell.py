"""One cell of the matrix: its pictures along the whole chain, the waterfall of their errors, the gates."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.comparison import compare, json_safe
from btfref.comparison.parts import part
from btfref.comparison.waterfall import Picture, waterfall
from btfref.conventions import PixelClass
from btfref.errors import BtfrefError
from btfref.gates.verdicts import GateResult, judged, missing_reference
from btfref.images.display import Display, fit_display
from btfref.numerics.colour import decode_srgb
from btfref.scene.shipped import scene_file
from btfref.validate.cache import key_of
from btfref.validate.matrix import ENVIRONMENTS
from btfref.validate.pictures import fitted, make_views, shared_settings, views_key
from btfref.validate.stages.browser import TITLE, browser_gates, browser_picture, draws, left_out
from btfref.validate.stages.drawn import code_of
from btfref.validate.stages.fits import fit_key

if TYPE_CHECKING:
    from btfref.comparison import Comparison
    from btfref.rendering import RenderResult
    from btfref.types import Facts
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings, Spec
    from btfref.validate.pictures import Views


#: Gates of a picture in real time against the reference under delta lights.
GATES = (
    "image.noise_free",
    "image.judged",
    "image.silhouette",
    "image.mesostructure",
    "image.background",
    "image.negative",
)

#: Under an environment, by the way in which it lights in real time.
ENVIRONMENT_GATES = {
    "lights": ("image.environment_lights", "image.judged", "image.background"),
    "prefiltered": ("image.environment", "image.environment_tiles", "image.judged", "image.background"),
}

#: Pixel classes that the waterfall counts: interior, and where the mesostructure's own silhouettes fall.
COUNTED = (PixelClass.INTERIOR, PixelClass.MESOSTRUCTURE)

#: Pixel classes that are judged strictly.
STRICT = (PixelClass.INTERIOR, PixelClass.EDGE)

#: Samples per pixel of a reference under an environment at most.
MOST = 1 << 15


#: Chain, reference, picture in real time, gates, facts, and parts of stages: ``(name, of, test, reference)``.
_Chain = tuple[
    "list[Picture]",
    "RenderResult",
    "RenderResult",
    tuple[str, ...],
    "Facts",
    "Sequence[tuple[str, str, np.ndarray, np.ndarray]]",
]


@dataclass(frozen=True, eq=False)
class CellResult:
    """What a cell of the matrix found.

    Parameters
    ----------
    facts : dict
        JSON-able: ``name``, the axes, ``waterfall``, ``gates``, ``seconds``, ``file``, ``notes``.
    images : dict of str to (H, W, 3) float32 array
        ``truth``, ``reference``, ``realtime``, and ``browser`` where one drew.
    classes : (H, W) uint8 array or None
    variance : (H, W, 3) float32 array or None
        Of the reference, where it has noise.
    measured : tuple of GateResult
        The gates of a cell that was computed just now, with what they were judged from.
    """

    facts: Facts
    images: dict[str, np.ndarray]
    classes: np.ndarray | None = None
    variance: np.ndarray | None = None
    measured: tuple[GateResult, ...] = ()

    @property
    def outcome(self) -> str:
        """``pass``, ``inconclusive`` or ``fail``."""
        outcomes = {gate["outcome"] for gate in self.facts["gates"]}
        if not outcomes or "fail" in outcomes:
            return "fail"
        return "inconclusive" if "inconclusive" in outcomes else "pass"

    @property
    def gates(self) -> tuple[GateResult, ...]:
        """The gates as `GateResult`."""
        return tuple(gate_from(facts) for facts in self.facts["gates"])

    def comparison(self) -> Comparison | None:
        """The comparison of both renderers once more, with its maps."""
        keys = self.facts.get("image_gates")
        if not self.images or keys is None:
            return None
        return compare(
            self.images["realtime"],
            self.images["reference"],
            classes=self.classes,
            gate=keys,
            variance=self.variance,
        )


def gate_from(facts: Facts) -> GateResult:
    """A `GateResult` from its JSON."""
    names = {"class": "pixel_class"}
    values = {names.get(key, key): value for key, value in facts.items()}
    for key in ("value", "limit"):
        values[key] = float(values[key]) if isinstance(values[key], str) else values[key]
    return GateResult(**values)


def cell_key(spec: Spec, settings: Settings) -> str:
    """Key of a cell: its fit, the pictures it shares, the code and the tolerances."""
    return key_of(
        {
            "cell": fit_key(spec.mesostructure, spec.method, settings),
            "views": views_key(spec.mesostructure, spec.scene, spec.lights, settings),
            "browser": draws(spec.lights, settings),
            "code": code_of(__name__, spec.method),
        }
    )


def make_cell(cache: Cache, spec: Spec, settings: Settings) -> CellResult:
    """Compute a cell, or read it.

    Returns
    -------
    CellResult
    """
    key = cell_key(spec, settings)
    try:
        path = cache.get(key, ".cell.npz", lambda path: _save(path, _cell(cache, spec, settings)))
    except BtfrefError as error:
        # Not kept: what is missing may be there the next time.
        return failed_cell(spec, str(error))
    return read_cell(path)


def failed_cell(spec: Spec, why: str) -> CellResult:
    """A cell whose reference, or whose picture, could not be made: a failure of every gate."""
    keys = GATES if spec.lights not in ENVIRONMENTS else ENVIRONMENT_GATES["lights"]
    gates = [g.to_dict() for key in keys for g in missing_reference(key, why)]
    facts = {"name": spec.name, **vars(spec), "gates": gates, "notes": why, "waterfall": None}
    return CellResult(json_safe(facts), {})


def read_cell(path: Path) -> CellResult:
    """A cell from its file, judged by the limits as they are now."""
    with np.load(path) as stored:
        images = {name[6:]: stored[name] for name in stored.files if name.startswith("image_")}
        variance = stored["variance"] if "variance" in stored.files else None
        facts = json.loads(str(stored["facts"]))
        gates = [judged(measurement) for measurement in facts.pop("measured")]
        facts["gates"] = [json_safe(gate.to_dict()) for gate in gates]
        if facts["waterfall"]:
            own = [gate for gate in gates if gate.gate == "waterfall.closure"]
            facts["waterfall"]["gates"] = [json_safe(gate.to_dict()) for gate in own]
            facts["waterfall"]["explained"] = all(gate.passed for gate in own)
        return CellResult(facts, images, stored["classes"], variance)


def _save(path: Path, result: CellResult) -> None:
    """Write a cell's pictures and measurements, without verdicts."""
    facts = {**result.facts, "measured": [gate.measurement() for gate in result.measured]}
    del facts["gates"]
    if facts["waterfall"]:
        facts["waterfall"] = {k: v for k, v in facts["waterfall"].items() if k not in ("gates", "explained")}
    parts: Facts = {f"image_{name}": image for name, image in result.images.items()}
    parts["classes"] = result.classes
    if result.variance is not None:
        parts["variance"] = result.variance
    np.savez_compressed(path, facts=json.dumps(facts), **parts)


def _cell(cache: Cache, spec: Spec, settings: Settings) -> CellResult:
    from btfref.rendering.offline.rounding import rounding_of
    from btfref.representations.file.container import read_info

    start = time.perf_counter()
    file, path = fitted(cache, spec, settings), scene_file(spec.scene)
    views = make_views(cache, spec.mesostructure, spec.scene, spec.lights, settings)
    shared = shared_settings(file, spec.lights, settings)
    under = _under_environment if spec.lights in ENVIRONMENTS else _under_deltas
    chain, reference, image, gates, facts, of_stages = under(path, spec, views, settings, shared)
    display = fit_display(views.truth.mean(0), views.classes != PixelClass.BACKGROUND)
    counts = np.isin(views.classes, COUNTED)
    chain = [
        Picture("geometry", views.truth),
        Picture("sampled BTF", views.sampled),
        *chain,
        Picture("8 bits", eight_bits(image.image, display)[None]),
    ]
    parts = [part(*each, display) for each in of_stages]
    classes, rounding = _classes(path, spec, views, shared), rounding_of(path, **shared)
    browser = browser_picture(path, spec.lights, settings, shared)
    in_browser: list[GateResult] = []
    if browser is not None:
        seen = browser.image[counts], reference.image[counts]
        parts.append(part(TITLE, "real time", *seen, display, beside=True))
        in_browser = browser_gates(browser.image, reference.image, classes, rounding)
    found = waterfall(chain, counts, display, parts=parts)
    comparison = compare(
        image.image,
        reference.image,
        classes=classes,
        gate=gates,
        variance=reference.variance,
        rounding=rounding,
    )
    facts = {
        "name": spec.name,
        **vars(spec),
        "image_gates": list(gates),
        "metrics": {name: comparison.metrics.get(name, {}) for name in (PixelClass.INTERIOR.label, "all")},
        "waterfall": {
            **found.to_dict(),
            "sampling": sampling_noise(views, counts),
            "display": display.to_dict(),
        },
        "bytes": read_info(file)["payload_bytes"],
        "seconds": {"reference": reference.meta["seconds"], "cell": time.perf_counter() - start},
        "frame_ms": image.meta["frame_ms"],
        "negative_fraction": image.meta["negative_fraction"],
        "gl_renderer": image.meta["gl_renderer"],
        "gl_version": image.meta["gl_version"],
        "webgl_renderer": None if browser is None else browser.meta["gl_renderer"],
        "notes": f"{found.explanation} All renderers read one file and one scene; none casts shadows."
        + left_out(spec.lights, settings),
        **facts,
    }
    images = {"truth": views.truth.mean(0), "reference": reference.image, "realtime": image.image}
    if browser is not None:
        images["browser"] = browser.image
    measured = (*comparison.gates, *in_browser, *found.gates)
    facts["gates"] = [gate.to_dict() for gate in measured]
    return CellResult(json_safe(facts), images, classes, reference.variance, measured)


def _classes(path: Path, spec: Spec, views: Views, shared: Facts) -> np.ndarray:
    """Pixel classes for the gates: those of all methods, but for one whose values lie on a geometry of its own.

    Under an environment that geometry has no borders of shadows, and its silhouettes blur.
    """
    from btfref.registry import method
    from btfref.scene.pixel_classes import pixel_classes
    from mitsuba_plugins import ready
    from mitsuba_plugins.protocol import Displaced

    ready()
    if spec.lights in ENVIRONMENTS or not isinstance(method(spec.method).evaluator, Displaced):
        return views.classes
    return pixel_classes(path, **shared)


def _under_deltas(path: Path, spec: Spec, views: Views, settings: Settings, shared: Facts) -> _Chain:
    """Chain, reference, picture in real time, gates, facts and parts of stages where nothing is random."""
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.approximate import approximate
    from btfref.rendering.offline.reference import render

    scene = {name: shared[name] for name in ("parameters", "size")}
    definition = approximate(path, **shared)
    reference = render(path, grid=shared["grid"], shadows=False, **scene)
    image = realtime(path, shadows=False, **shared)
    chain = [("fit", definition.image), ("port", reference.image), ("real time", image.image)]
    return [Picture(name, picture[None]) for name, picture in chain], reference, image, GATES, {}, ()


def _under_environment(path: Path, spec: Spec, views: Views, settings: Settings, shared: Facts) -> _Chain:
    """The same under an environment: the reference is traced until its noise decides nothing.

    Its four batches are the stage of the fit as well. Real time approximates here, and its port is a part of that
    stage: GLSL against the same approximation in float64, at pixels drawn at random.
    """
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.approximate import approximate
    from btfref.rendering.offline.converged import converged

    image = realtime(path, **shared)
    way = image.meta["environment_path"]
    gates = ENVIRONMENT_GATES[way]
    reference = converged(
        path, np.isin(views.classes, STRICT), gate=gates, shadows=False, most=MOST, **shared
    )
    some = np.zeros(views.classes.shape, bool)
    there = np.flatnonzero(np.isin(views.classes, COUNTED))
    rng = np.random.default_rng(settings.seed)
    some.flat[rng.choice(there, min(settings.port_pixels, len(there)), replace=False)] = True
    definition = approximate(path, pixels=some, **shared)
    chain = [Picture("fit", reference.batches), Picture("real time", image.image[None])]
    facts = {
        "environment_path": way,
        "reference_spp": reference.meta["spp"],
        "reference_noise": reference.meta["noise"],
    }
    parts = [("port", "real time", image.image[some], definition.image[some])]
    return chain, reference, image, gates, facts, parts


def eight_bits(image: np.ndarray, display: Display) -> np.ndarray:
    """What a display of 8 bits shows, as linear radiance: scaled, clipped, coded, decoded.

    Parameters
    ----------
    image : (..., 3) array
        Linear radiance.
    display : Display

    Returns
    -------
    (..., 3) float32 array
    """
    codes = np.rint(255 * display.encoded(image))
    return (decode_srgb(codes / 255) / 2.0**display.stops).astype(np.float32)


def sampling_noise(views: Views, mask: np.ndarray) -> dict[str, float] | None:
    """How much of the first stage is Monte Carlo noise of the sampled BTF, by its independent twin.

    Returns
    -------
    dict or None
        ``mse``: mean square without that noise, directions and texels alone; ``noise``: that of the noise. None without
        a twin.
    """
    if not views.twin.size:
        return None
    a, b = (views.sampled[0] - views.truth[0])[mask], (views.twin - views.truth[1])[mask]
    noise = 0.5 * np.mean((views.sampled[0] - views.twin)[mask].astype(float) ** 2)
    return {"mse": float(np.mean(a * b, dtype=float)), "noise": float(noise)}
