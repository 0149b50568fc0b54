"""Can the gates fail? Known faults, each to be caught by the gate that is meant for it.

A fault is put where such a fault would be: into a copy of a shader, into maps on their way to the GPU, into a picture
on its way to the comparison. What has no fault must pass all the same gates first.
"""

from __future__ import annotations

import dataclasses
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from btfref.compare import compare
from btfref.compare.comparison import agreement
from btfref.compare.gates import Measured, judge
from btfref.errors import BtfrefError
from btfref.platform import shader_directory
from btfref.scenes import scene_file
from btfref.validate.probes import hemisphere, probe_points

#: The picture of the faults of the host: a curved surface seen from both sides, and more than one light.
SCENE, LIGHTS = "cloth", "directional3"
SETTINGS = {"grid": 2, "size": (64, 64)}
PICTURE_GATES = ("image.noise_free", "image.negative", "image.background")


@dataclass(frozen=True)
class Fault:
    """A fault and what is to catch it.

    Parameters
    ----------
    name : str
    meant : str
        The limit that must fail: gate and entry.
    look : str
        Method of `_Bench` that looks for faults of this kind and returns gates.
    method : str
        Registry key of what is looked at.
    edit : tuple of str, optional
        Shader file, right text, wrong text.
    parameters : tuple of (str, value), optional
        Of the fit.
    """

    name: str
    meant: str
    look: str
    method: str = "lpca"
    edit: tuple = ()
    parameters: tuple = ()

    @property
    def subject(self):
        """What is fitted: method and parameters."""
        return self.method, self.parameters


HOST = "hosts/mesh.frag"
SUM = "vec4(scale * sum, 1.0)"
NOISE_FREE, PROBE = "image.noise_free.p999", "probe.agreement.p999"

FAULTS = (
    Fault(
        "cosine dropped",
        NOISE_FREE,
        "picture",
        edit=(HOST, "irradiance * btf", "irradiance / max(w_light.z, 1e-4) * btf"),
    ),
    Fault(
        "light and view swapped",
        NOISE_FREE,
        "picture",
        edit=(HOST, "btf_eval(uv, w_light, w_view", "btf_eval(uv, w_view, w_light"),
    ),
    Fault("v flipped", NOISE_FREE, "picture", edit=(HOST, "btf_eval(uv,", "btf_eval(vec2(uv.x, -uv.y),")),
    Fault(
        "half-texel shift",
        PROBE,
        "probes",
        edit=("lib/texels.glsl", "float(columns), 0.5)", "float(columns), 0.0)"),
    ),
    Fault("wrong gamma", NOISE_FREE, "picture", edit=(HOST, SUM, "vec4(pow(max(sum, 0.0), vec3(2.2)), 1.0)")),
    Fault(
        "tangent frame transposed",
        NOISE_FREE,
        "picture",
        edit=("lib/frame.glsl", "return transpose(mat3(", "return (mat3("),
    ),
    Fault(
        "wrong sign in spherical harmonics",
        "environment.agreement.p999",
        "harmonics",
        edit=("lib/harmonics.glsl", "turn.x * q - turn.y * p;", "turn.x * q + turn.y * p;"),
    ),
    Fault(
        "cluster index off by one",
        PROBE,
        "probes",
        edit=(
            "representations/lpca.glsl",
            "int first = int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) * BASIS_DIM1;",
            "int first = max(int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) - 1, 0) * BASIS_DIM1;",
        ),
    ),
    Fault(
        "stale table of levels of detail",
        PROBE,
        "probes",
        "laplacian",
        (
            "representations/laplacian.glsl",
            "int at = (LEVEL_FIRST_TABLE[level] + texels.index[x])",
            "int at = (LEVEL_FIRST_TABLE[max(level - 1, 0)] + texels.index[x])",
        ),
    ),
    Fault("sRGB read as linear", "image.eight_bit.code_p999", "eight_bits"),
    Fault("float16 overflow", "probe.finite.nonfinite", "overflow", "svd"),
    Fault(
        "negative values clamped",
        "image.negative.lost_negative",
        "picture",
        "svd",
        (HOST, SUM, "vec4(scale * max(sum, 0.0), 1.0)"),
        (("components", 4),),  # few enough to undershoot
    ),
)


@dataclass(frozen=True)
class Caught:
    """What became of a fault.

    Parameters
    ----------
    name, meant : str
    caught : bool
        The limit that is meant for it failed, and had passed without the fault.
    failed : tuple of str
        All limits that failed.
    clean : tuple of str
        Limits that failed without the fault: there should be none.
    """

    name: str
    meant: str
    caught: bool
    failed: tuple
    clean: tuple

    def to_dict(self):
        """JSON-able form."""
        return {**vars(self), "failed": list(self.failed), "clean": list(self.clean)}


def self_test(*, progress=None):
    """Inject every fault.

    Parameters
    ----------
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    list of Caught
        In the order of `FAULTS`.

    Raises
    ------
    BtfrefError
        When a shader no longer holds the text that a fault replaces.
    MissingDependencyError
        Without LLVM or OpenGL.
    """
    report, results = progress or (lambda *_: None), []
    with tempfile.TemporaryDirectory() as folder:
        bench = _Bench(Path(folder))
        for done, fault in enumerate(FAULTS):
            report(done, len(FAULTS), "injecting faults")
            results.append(_inject(bench, fault))
    report(len(FAULTS), len(FAULTS), "injecting faults")
    return results


def _inject(bench, fault):
    clean = _failed(bench.clean(fault))
    if fault.edit:
        with edited_shader(bench.folder / fault.name.replace(" ", "_"), *fault.edit):
            failed = _failed(getattr(bench, fault.look)(fault.subject))
    else:
        failed = _failed(getattr(bench, fault.look)(fault.subject, faulty=True))
    caught = fault.meant in failed and not clean
    return Caught(fault.name, fault.meant, caught, failed, clean)


def _failed(gates):
    return tuple(sorted({gate.name for gate in gates if not gate.passed}))


@contextmanager
def edited_shader(folder, file, right, wrong):
    """All representations with a copy of one shader file in which a text is replaced.

    Parameters
    ----------
    folder : path-like
        For the copy.
    file : str
        Relative to the shaders' directory.
    right, wrong : str
        Text that stands there once, and what replaces it.

    Raises
    ------
    BtfrefError
        The text is not there, or there more than once.
    """
    from btfref.render import gl

    text = (shader_directory() / file).read_text("utf-8")
    if text.count(right) != 1:
        raise BtfrefError(f"{file}: the text of a fault must stand there once, not {text.count(right)} times")
    target = Path(folder) / file
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text.replace(right, wrong), "utf-8")
    shipped = gl.shader_file

    def faulty(rep):
        shader, directories = shipped(rep)
        return shader, [Path(folder), *directories]

    gl.shader_file = faulty
    try:
        yield
    finally:
        gl.shader_file = shipped


class _Bench:
    """Where faults are looked for: one small material, fitted when needed."""

    def __init__(self, folder):
        self.folder = folder
        self._fits, self._clean, self._references = {}, {}, {}

    @cached_property
    def btf(self):
        from btfref.numerics.directions import directions
        from btfref.sampling import SampledBTF
        from btfref.stress.data import bumpy_values

        views = directions("ubo81")
        values = bumpy_values((16, 16), views, views).astype(np.float16)
        return SampledBTF(values, views, views, attributes={"mesostructure": "formula"})

    def fit(self, subject):
        """The representation and its file."""
        from btfref.registry import method as row
        from btfref.representations import load, save

        if subject not in self._fits:
            key, parameters = subject
            path = self.folder / f"formula{len(self._fits)}.{key}.exr"
            save(row(key).fit(self.btf, **dict(parameters)), path)
            self._fits[subject] = load(path), path
        return self._fits[subject]

    def clean(self, fault):
        """The gates without the fault, looked at once."""
        key = fault.look, fault.subject
        if key not in self._clean:
            self._clean[key] = getattr(self, fault.look)(fault.subject)
        return self._clean[key]

    def reference(self, subject):
        """Scene, parameters, reference picture and pixel classes."""
        from btfref.render.classes import pixel_classes
        from btfref.render.reference import render

        if subject not in self._references:
            scene, size, grid = scene_file(SCENE), SETTINGS["size"], SETTINGS["grid"]
            parameters = {"btf": str(self.fit(subject)[1]), "lights": LIGHTS, "tiling": "4"}
            image = render(scene, parameters=parameters, noise_free=grid, shadows=False, size=size).image
            classes = pixel_classes(scene, parameters=parameters, grid=grid, size=size)
            self._references[subject] = scene, parameters, image, classes
        return self._references[subject]

    def picture(self, subject):
        """Real time against the reference."""
        from btfref.render.realtime import realtime

        scene, parameters, expected, classes = self.reference(subject)
        image = realtime(scene, parameters=parameters, **SETTINGS)
        return compare(image, expected, classes=classes, gate=PICTURE_GATES, flip=False).gates

    def probes(self, subject):
        """The shader against the definition, at all levels of detail where there are any."""
        from btfref.render.probe import probe

        representation, _ = self.fit(subject)
        rng = np.random.default_rng(11)
        points = probe_points(rng, 4000, self.btf.views, self.btf.lights)
        lod = rng.uniform(0, getattr(representation, "max_lod", 0), len(points[0])).astype(np.float32)
        value = probe(representation, *points, lod)
        return [
            *agreement(value, representation.evaluate(*points, lod=lod)).gates,
            *judge("probe.finite", {"nonfinite": int(np.count_nonzero(~np.isfinite(value)))}),
        ]

    def harmonics(self, subject):
        """The shader under an environment in spherical harmonics against float64."""
        from btfref.render.environments import shipped
        from btfref.render.lighting import Lighting
        from btfref.render.probe import probe_environment

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

    def eight_bits(self, subject, *, faulty=False):
        """A picture that went through an 8-bit file, the fault being codes that are taken for radiance."""
        from btfref.compare.colour import decode_srgb, encode_srgb

        _, _, expected, classes = self.reference(subject)
        shown = np.clip(expected, 0, 1)
        codes = np.rint(255 * encode_srgb(shown)) / 255
        image = codes if faulty else decode_srgb(codes)
        return compare(image, shown, classes=classes, gate="image.eight_bit", flip=False).gates

    def overflow(self, subject, *, faulty=False):
        """Maps as halves on their way to the shader; the fault scales them beyond 65504 and lets it happen."""
        from btfref.render.probe import probe

        representation, _ = self.fit(subject)
        if faulty:
            name = max(representation.maps, key=lambda n: representation.maps[n].size)
            with np.errstate(over="ignore"):
                large = (representation.maps[name].astype(np.float32) * 1e6).astype(np.float16)
            representation = dataclasses.replace(representation, maps={**representation.maps, name: large})
        points = probe_points(np.random.default_rng(13), 2000, self.btf.views, self.btf.lights)
        bad = int(np.count_nonzero(~np.isfinite(probe(representation, *points))))
        return judge("probe.finite", {"nonfinite": Measured(bad)})
