"""Where known faults are looked for: one small material, fitted and rendered when needed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.comparison.waterfall import Picture, waterfall
from btfref.conventions import PixelClass
from btfref.gates.verdicts import GateResult, Measured, judge
from btfref.images.display import fit_display
from btfref.scene.shipped import scene_file
from btfref.stress.between_samples import between_gates
from btfref.stress.data import bumpy
from btfref.stress.evaluators import DEFINITION, PORTS, DrJit, evaluator
from btfref.stress.judging import port_agreement
from btfref.stress.lookups import USUAL, hard_lookups, hemisphere
from btfref.types import Facts
from btfref.validate.cell import ENVIRONMENT_GATES, GATES, STRICT
from btfref.validate.matrix import QUICK
from btfref.validate.method_gates import sampling_gates
from btfref.validate.own_renderer import EIGHT_BIT, NOISY

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.comparison.picture_gates import Rounding
    from btfref.rendering import RenderResult
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import JitArray
    from btfref.validate.injected.faults import Fault, Subject


#: The picture of the faults of the host: a curved surface seen from both sides, and more than one light.
SCENE, LIGHTS = "cloth", "directional3"
SETTINGS: Facts = {"grid": 4, "size": (48, 48)}

#: Method → environment: few lights for the one, the maps alone for the other.
ENVIRONMENTS = {"lpca": "bright-texel", "rf_lobes": "constant"}

#: Of real time that draws views.
FRAMES = 64

#: Samples of each of the six tests.
CHI2_SAMPLES = 200_000


#: What a look at a fault returns.
Gates = Sequence[GateResult]


#: Factors that a representation's values are off by.
OFF = {"dark": 0.5, "negative": -1.0}


class Off:
    """A representation whose values are off by a factor."""

    def __init__(self, inner: Representation, factor: float) -> None:
        self._inner, self._factor = inner, factor

    def evaluate(self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike) -> np.ndarray:
        """The other's value times the factor."""
        return self._factor * self._inner.evaluate(uv, w_light, w_view)


def _rough(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Values with a texture over directions that no product follows."""
    return values * np.exp(rng.normal(size=values.shape))


class Altered:
    """A plugin whose sampling is wrong in one way: ``density``, ``weight`` or ``pdf``."""

    def __init__(self, plugin: JitArray, change: str) -> None:
        self._plugin, self._change = plugin, change
        self.eval = plugin.eval

    def pdf(self, context: JitArray, si: JitArray, w: JitArray, active: JitArray = True) -> JitArray:
        """The density, or that of a view that is turned by half a circle."""
        if self._change == "density":
            si = type(si)(si)
            si.wi.x, si.wi.y = -si.wi.x, -si.wi.y
        return self._plugin.pdf(context, si, w, active)

    def sample(self, context: JitArray, si: JitArray, *numbers: JitArray) -> tuple[JitArray, JitArray]:
        """A sample whose weight, or whose density, is a hundredth too large."""
        bs, weight = self._plugin.sample(context, si, *numbers)
        if self._change == "pdf":
            bs.pdf *= 1.01
        return bs, weight * (1.01 if self._change == "weight" else 1.0)


class _BrighterPort:
    """A Dr.Jit port whose values are a hundredth too large."""

    def __init__(self, port: JitArray) -> None:
        self._port = port

    def __getattr__(self, name: str) -> JitArray:
        return getattr(self._port, name)

    def evaluate(self, *arguments: JitArray, **settings: JitArray) -> JitArray:
        return 1.01 * self._port.evaluate(*arguments, **settings)


def _brighter(representation: Representation) -> Representation:
    """A representation whose definition is a hundredth too bright, and nothing else of it."""

    def evaluate(self: Representation, *arguments: JitArray, **settings: JitArray) -> np.ndarray:
        return 1.01 * kind.evaluate(self, *arguments, **settings)

    kind = type(representation)
    brighter: Any = type(kind.__name__, (kind,), {"evaluate": evaluate})
    return brighter.from_arrays(representation.arrays(), representation.meta)


def _carved(gbrdf: Representation) -> Representation:
    """A g-BRDF with blocks for heights: those of the formula hide nothing, and no pixel would see an edge of them."""
    from btfref.representations.gbrdf.definition import field_constants

    maps = gbrdf.arrays()
    blocks = np.indices(maps["height"].shape[:2]).sum(0) // 4 % 2
    maps = {**maps, "height": blocks[..., None].astype(np.float32)}
    constants = field_constants(maps, {"height_min": -0.15, "height_max": 0.0})
    return gbrdf.from_arrays(maps, {**gbrdf.meta, "constants": constants})


class Bench:
    """Where faults are looked for: one small material, fitted when needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._fits: dict[Subject, tuple[Representation, Path]] = {}
        self._clean: dict[tuple[str, Subject], Gates] = {}
        self._references: dict[Subject, tuple[Path, dict[str, str], np.ndarray, np.ndarray]] = {}
        self._converged: dict[Subject, tuple[RenderResult, np.ndarray]] = {}
        self._shadowed: dict[Subject, tuple[np.ndarray, np.ndarray]] = {}

    @cached_property
    def btf(self) -> SampledBTF:
        """The material: a formula with bumps, 16² texels and 81² directions."""
        return bumpy(shape=(16, 16))

    def fit(self, subject: Subject) -> tuple[Representation, Path]:
        """The representation and its file."""
        from btfref.registry import method as row
        from btfref.representations import load, save

        if subject not in self._fits:
            key, parameters = subject
            path = self.folder / f"formula{len(self._fits)}.{key}.exr"
            fitted = row(key).fit(self.btf, **dict(parameters))
            save(_carved(fitted) if key == "gbrdf" else fitted, path)
            self._fits[subject] = load(path), path
        return self._fits[subject]

    def clean(self, fault: Fault) -> Gates:
        """The gates without the fault, looked at once."""
        key = fault.look, fault.subject
        if key not in self._clean:
            self._clean[key] = getattr(self, fault.look)(fault.subject)
        return self._clean[key]

    def reference(self, subject: Subject) -> tuple[Path, dict[str, str], np.ndarray, np.ndarray]:
        """Scene, parameters, reference picture and pixel classes."""
        from btfref.rendering.offline.reference import render
        from btfref.scene.pixel_classes import pixel_classes

        if subject not in self._references:
            scene, size, grid = scene_file(SCENE), SETTINGS["size"], SETTINGS["grid"]
            parameters = {"btf": str(self.fit(subject)[1]), "lights": LIGHTS, "tiling": "4"}
            image = render(scene, parameters=parameters, grid=grid, shadows=False, size=size).image
            classes = pixel_classes(scene, parameters=parameters, grid=grid, size=size)
            self._references[subject] = scene, parameters, image, classes
        return self._references[subject]

    def rounding(self, subject: Subject) -> Rounding:
        """What the rounding of texture coordinates may move, as cells of the matrix ask for it."""
        from btfref.rendering.offline.rounding import rounding_of

        scene, parameters, _, _ = self.reference(subject)
        return rounding_of(scene, parameters=parameters, **SETTINGS)

    def picture(self, subject: Subject, change: str = "") -> Gates:
        """Real time against the reference; the fault without a shader is light where nothing is."""
        from btfref.rendering.gl.realtime import realtime

        scene, parameters, expected, classes = self.reference(subject)
        image = realtime(scene, parameters=parameters, shadows=False, **SETTINGS).image
        if change == "silhouettes":
            classes = np.where(np.indices(classes.shape).sum(0) % 4 == 0, PixelClass.SILHOUETTE, classes)
        if change == "background":
            image = np.where(classes[..., None] == PixelClass.BACKGROUND, image + 0.01, image)
        rounding = self.rounding(subject)
        return compare(image, expected, classes=classes, gate=GATES, flip=False, rounding=rounding).gates

    def shadows(self, subject: Subject) -> Gates:
        """Real time with cast shadows against the reference with its own."""
        from btfref.rendering.gl.realtime import realtime
        from btfref.rendering.offline.reference import render
        from btfref.scene.pixel_classes import pixel_classes

        parameters = {"btf": str(self.fit(subject)[1]), "lights": LIGHTS, "tiling": "4"}
        scene, shared = scene_file(SCENE), {"parameters": parameters, **SETTINGS}
        if subject not in self._shadowed:
            classes = pixel_classes(scene, shadows=True, **shared)
            self._shadowed[subject] = render(scene, shadows=True, **shared).image, classes
        expected, classes = self._shadowed[subject]
        image = realtime(scene, shadows=True, **shared).image
        gates = (*GATES, "image.shadow_border")
        return compare(image, expected, classes=classes, gate=gates, flip=False).gates

    def browser(self, subject: Subject) -> Gates:
        """Real time in a browser against the reference."""
        from btfref.rendering.web.context import webgl
        from btfref.validate.stages.browser import browser_gates

        scene, parameters, expected, classes = self.reference(subject)
        image = webgl(scene, parameters=parameters, shadows=False, **SETTINGS).image
        return browser_gates(image, expected, classes, self.rounding(subject))

    def browser_environment(self, subject: Subject) -> Gates:
        """Real time under an environment in a browser against float64."""
        from btfref.validate.stages.browser import environment_gates

        return environment_gates(self.fit(subject)[1], QUICK.browser_ways)

    def environment(self, subject: Subject, change: str = "") -> Gates:
        """Real time under an environment against a converged reference."""
        from btfref.rendering.gl.realtime import realtime
        from btfref.rendering.offline.converged import converged
        from btfref.scene.pixel_classes import pixel_classes

        parameters = {"btf": str(self.fit(subject)[1]), "lights": "envmap", "tiling": "4"}
        parameters["environment"] = ENVIRONMENTS[subject[0]]
        scene = scene_file("sphere")
        shared: Facts = {"parameters": parameters, "grid": 2, "size": (24, 24)}
        made = realtime(scene, **shared)
        gates = ENVIRONMENT_GATES[made.meta["environment_path"]]
        if subject not in self._converged:
            classes = pixel_classes(scene, **shared)
            found = converged(scene, np.isin(classes, STRICT), gate=gates, shadows=False, **shared)
            self._converged[subject] = found, classes
        (reference, classes), image = self._converged[subject], made.image.copy()
        if change == "tile":
            image[8:16, 8:16] *= 1.1
        return compare(image, reference, classes=classes, gate=gates, flip=False).gates

    def sampling(self, subject: Subject, change: str = "") -> Gates:
        """Samples of the plugin against its density and its values."""
        altered = (lambda plugin: Altered(plugin, change)) if change else None
        return sampling_gates(self.fit(subject)[1], samples=CHI2_SAMPLES, altered=altered)

    def batches(self, subject: Subject, change: str = "") -> Gates:
        """A waterfall of one stage from noisy batches; the fault is a batch that is another once more."""
        _, _, expected, classes = self.reference(subject)
        rng, scale = np.random.default_rng(14), float(expected[classes == PixelClass.INTERIOR].mean())
        noise = 0.2 * scale * rng.normal(size=(4, *expected.shape))
        if change == "shared":
            noise[1] = noise[0]
        chain = [Picture("truth", expected + noise), Picture("stage", 1.02 * expected[None])]
        return waterfall(
            chain, classes == PixelClass.INTERIOR, fit_display(expected, classes != PixelClass.BACKGROUND)
        ).gates

    def noisy(self, subject: Subject, change: str = "") -> Gates:
        """A picture against a reference with known noise."""
        _, _, expected, classes = self.reference(subject)
        rng, scale = np.random.default_rng(15), float(expected[classes == PixelClass.INTERIOR].mean())
        sigma = 0.01 * scale
        reference = expected + sigma * rng.normal(size=expected.shape)
        image = 1.05 * expected if change == "bright" else expected
        variance = np.full(expected.shape, sigma**2)
        return compare(image, reference, classes=classes, gate=NOISY, variance=variance, flip=False).gates

    def drawn(self, subject: Subject) -> Gates:
        """Real time that draws views, many frames of it, against real time that blends them."""
        from btfref.rendering.gl.realtime import realtime

        scene, parameters, _, classes = self.reference(subject)
        shared: Facts = {"parameters": parameters, "shadows": False, "size": SETTINGS["size"], "grid": 2}
        blended = realtime(scene, **shared).image
        noisy = realtime(scene, interpolation="drawn", frames=FRAMES, **shared)
        found = compare(
            blended, noisy.image, classes=classes, gate=NOISY, variance=noisy.variance, flip=False
        )
        return found.gates

    def witness(self, subject: Subject, change: str = "") -> Gates:
        """Both renderers against the witness, and against each other; the fault is the same in both."""
        import mitsuba_plugins.base as plugin
        from btfref.validate.self_test import edited_shader
        from btfref.validate.witness.gates import testify

        right, wrong = "dot(side, normal) < 0.0 ? -1.0 : 1.0", "1.0"
        with ExitStack() as faults:
            if change == "hand":
                faults.enter_context(patch.object(plugin, "hand_of", lambda si: 1.0))
                folder = self.folder / "hand"
                faults.enter_context(edited_shader(folder, "lib/surface/frame.glsl", right, wrong))
            found = testify(self.fit(subject)[1])
        return [*found.gates(), *found.between()]

    def between(self, subject: Subject, change: str = "") -> Gates:
        """A fit between its samples; the fault is one that is free there, too dark, or below zero."""
        from btfref.registry import method as row
        from btfref.representations import between

        key, parameters = subject
        rough = bumpy(shape=(2, 2), views="10x5", lights="10x5", change=_rough)
        free: Facts = {"between": 0.0, "sweeps": 60} if change == "free" else {}
        fitted = row(key).fit(rough, **dict(parameters), **free)
        off = Off(fitted, OFF.get(change, 1.0))
        return between_gates(key, between.measure(off, rough))

    def probes(self, subject: Subject) -> Gates:
        """The shader against the definition, at all levels of detail where there are any."""
        representation, _ = self.fit(subject)
        lookups = hard_lookups(np.random.default_rng(11), representation, 4000, USUAL)
        value = evaluator("glsl", representation).evaluate(*lookups.points, lod=lookups.lod)
        return [
            *port_agreement(value, representation, lookups.points, lookups.lod).gates,
            *judge("probe.finite", {"nonfinite": int(np.count_nonzero(~np.isfinite(value)))}),
        ]

    def evaluators(self, subject: Subject, change: str = "") -> Gates:
        """Both ports against the definition; the fault is a hundredth more of one of them."""
        representation, path = self.fit(subject)
        lookups = hard_lookups(np.random.default_rng(16), representation, 4000, USUAL)
        made = {name: evaluator(name, representation, path) for name in PORTS}
        if change == DEFINITION:
            representation = _brighter(representation)
        brighter = made.get(change)
        if isinstance(brighter, DrJit):
            brighter.plugin.evaluator = _BrighterPort(brighter.plugin.evaluator)
        found: list[GateResult] = []
        reference = representation.evaluate(*lookups.points, lod=lookups.lod)
        for port in made.values():
            value = port.evaluate(*lookups.points, lod=lookups.lod)
            agreed = port_agreement(value, representation, lookups.points, lookups.lod, reference=reference)
            found += agreed.gates
        return found

    def harmonics(self, subject: Subject) -> Gates:
        """The shader under an environment in spherical harmonics against float64."""
        from btfref.rendering.environment_light.lighting import Lighting
        from btfref.rendering.gl.probe import probe_environment
        from btfref.scene.environments import shipped

        rng = np.random.default_rng(12)
        frame = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
        frame[:, :, 2] *= np.linalg.det(frame)[:, None]
        points = (
            rng.uniform(-1, 2, (500, 2)).astype(np.float32),
            hemisphere(rng, 500),
            frame.astype(np.float32),
        )
        representation, _ = self.fit(subject)
        light = Lighting(shipped("studio"), "sh", order=5).prepared(representation)
        value = probe_environment(representation, light, *points)
        return agreement(value, light.radiance(*points), gate="environment.agreement").gates

    def eight_bits(self, subject: Subject, change: str = "") -> Gates:
        """A picture that went through an 8-bit file; the faults are codes taken for radiance, and a pixel's shift."""
        from btfref.numerics.colour import decode_srgb, encode_srgb

        _, _, expected, classes = self.reference(subject)
        shown = np.clip(expected, 0, 1)
        codes = np.rint(255 * encode_srgb(shown)) / 255
        image = codes if change == "linear" else decode_srgb(codes)
        if change == "shifted":
            image = np.roll(image, 1, axis=1)
        return compare(image, shown, classes=classes, gate=EIGHT_BIT, flip=False).gates

    def overflow(self, subject: Subject, change: str = "") -> Gates:
        """Maps as halves on their way to the shader; the fault scales them beyond 65504 and lets it happen."""
        representation, _ = self.fit(subject)
        if change:
            maps = representation.arrays()
            name = max(maps, key=lambda n: maps[n].size)
            with np.errstate(over="ignore"):
                large = (maps[name].astype(np.float32) * 1e6).astype(np.float16)
            representation = representation.from_arrays({**maps, name: large}, representation.meta)
        lookups = hard_lookups(np.random.default_rng(13), representation, 2000, USUAL)
        value = evaluator("glsl", representation).evaluate(*lookups.points)
        bad = int(np.count_nonzero(~np.isfinite(value)))
        return judge("probe.finite", {"nonfinite": Measured(bad)})
