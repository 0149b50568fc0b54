"""Image-based light: GLSL against float64 (the implementation), and against the BSDF under the same environment."""

import subprocess
from importlib.resources import files

import numpy as np
import pytest
from probes import hemisphere

from btfref.cli import main
from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.conventions import PixelClass
from btfref.gates.tolerances import tolerance
from btfref.images import save_image
from btfref.platform import shader_directory
from btfref.registry import image_light, methods
from btfref.rendering.environment_light import lighting
from btfref.rendering.environment_light.image_light import radiance
from btfref.rendering.environment_light.lighting import Lighting
from btfref.rendering.gl import composer, device
from btfref.rendering.gl.probe import probe_environment
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.converged import converged
from btfref.scene.description import read_scene
from btfref.scene.environment import Environment, bright_texel, constant
from btfref.scene.environments import studio
from btfref.scene.pixel_classes import pixel_classes

pytestmark = pytest.mark.usefixtures("coarse_environments")

KEYS = [key for key, row in methods().items() if row.image_light]
SPHERE = files("btfref.scene.shipped").joinpath("sphere.xml")
SIZE = (48, 48)


@pytest.fixture(autouse=True)
def _gl(need):
    need("gl")


def smooth_sky():
    """A bright, broad cloud above a horizon that is darker on one side; in z-up coordinates of the shipped scenes."""
    v, u = np.meshgrid(np.arange(32) / 31, (np.arange(64) + 0.5) / 64, indexing="ij")
    glow = np.exp(-12 * ((v - 0.3) ** 2 + (u - 0.4) ** 2))
    ground = 0.2 + 0.1 * np.cos(2 * np.pi * u) + 0.5 * (v < 0.5)
    return Environment(
        (ground[..., None] * [0.5, 0.7, 1] + 3 * glow[..., None] * [1, 0.9, 0.7]).astype(np.float32)
    )


def lookups(rng, n=4000):
    frame = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    frame[:, :, 2] *= np.linalg.det(frame)[:, None]
    return rng.uniform(-1, 2, (n, 2)).astype(np.float32), hemisphere(rng, n), frame.astype(np.float32)


@pytest.fixture(scope="module")
def tables():
    """Environments by name, and each method's tables of what is filtered of each, made once and small."""
    environments = {
        "sky": smooth_sky(),
        "light": bright_texel([0.3, -0.5, 0.8]),
        "constant": constant(),
        "studio": studio(shape=(32, 64)),
    }
    made = {}

    def get(key, rep, name):
        kind = (getattr(image_light(key), "cosine", None), name)
        if kind not in made:
            rest = image_light(key).split(rep, environments[name]).rest
            made[kind] = image_light(key).tables(rep, rest, size=32)
        return environments[name], made[kind]

    return get


@pytest.mark.parametrize("name", ["sky", "light", "studio"])
@pytest.mark.parametrize("key", KEYS)
def test_shader_agrees_with_float64(fits, tables, monkeypatch, rng, key, name):
    rep = fits(key)
    environment, own = tables(key, rep, name)
    monkeypatch.setattr(image_light(key), "tables", classmethod(lambda *_: own))
    # The studio's lights then need several passes, of which one has the maps.
    monkeypatch.setattr(lighting, "PASS", 12)
    points, light = lookups(rng), Lighting(environment).prepared(rep)
    assert len(light.passes) > ((key, name) == ("rf_lobes", "studio"))
    exact = light.radiance(*points)
    found = agreement(probe_environment(rep, light, *points), exact, gate="environment.agreement")
    assert found.passed, [gate.line for gate in found.gates]
    assert np.abs(exact).max() > 0


FAULTS = {
    "one hemisphere for both": ("sky", "sphere_maps", "(w.z < 0.0 ? 1 : 0), size", "0, size"),
    "exponents not interpolated": (
        "sky",
        "environment",
        "float f = position - float(low);",
        "float f = 0.0;",
    ),
    "horizon forgotten": ("sky", "environment", "(n + 1.0) * lobe.x)", "(n + 1.0))"),
    "axis not moved": (
        "sky",
        "environment",
        "vec3(outwards * sqrt(max(1.0 - lobe.y * lobe.y, 0.0)), lobe.y)",
        "axis",
    ),
    "lobes not parted": ("sky", "environment", "vec3 aside = lobe.w *", "vec3 aside = 0.0 *"),
    "small lights lost": (
        "light",
        "split_environment",
        "environment_lit(uv, w_view, to_world, lod);",
        "vec3(0.0);",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_injected_faults_are_caught(fits, tables, monkeypatch, rng, tmp_path, name):
    sky, file, right, wrong = FAULTS[name]
    text = (shader_directory() / f"lib/light/{file}.glsl").read_text()
    assert text.count(right) == 1
    (tmp_path / "lib/light").mkdir(parents=True)
    (tmp_path / f"lib/light/{file}.glsl").write_text(text.replace(right, wrong))
    rep = fits("rf_lobes")
    environment, own = tables("rf_lobes", rep, sky)
    monkeypatch.setattr(image_light("rf_lobes"), "tables", classmethod(lambda *_: own))
    shipped = device.shader_file(rep)
    monkeypatch.setattr(device, "shader_file", lambda rep: (shipped[0], [tmp_path, *shipped[1]]))
    points, light = lookups(rng), Lighting(environment).prepared(rep)
    found = agreement(
        probe_environment(rep, light, *points), light.radiance(*points), gate="environment.agreement"
    )
    assert not found.passed


@pytest.mark.parametrize("key", KEYS)
def test_a_constant_environment_is_the_albedo(fits, tables, rng, key):
    """The share of a lobe above the horizon is exact there: the integral of B over the hemisphere comes out."""
    from btfref.numerics.sphere.quadrature import gauss_hemisphere

    rep = fits(key)
    _, own = tables(key, rep, "constant")
    uv, w_view, frame = (a[:24] for a in lookups(rng))
    w, weight = gauss_hemisphere(96, 192)
    expected = np.einsum("l,nlc->nc", weight, rep.evaluate(uv[:, None], w, w_view[:, None]))
    difference = radiance(rep, own, uv, w_view, frame) - expected
    assert np.abs(difference).max() <= tolerance("environment.albedo.max") * expected.max()


@pytest.fixture
def under_sky(need, fits, tmp_path):
    """``under_sky(key)``: parameters of a sphere under the smooth sky."""
    need("llvm")
    save_image(tmp_path / "sky.exr", smooth_sky().radiance)
    lit = {"lights": "envmap", "environment": str(tmp_path / "sky.exr"), "tiling": "4"}
    return lambda key: {"btf": str(fits.path(key)), **lit}


@pytest.mark.parametrize("key", KEYS)
def test_pictures_equal_float64(under_sky, fits, tables, monkeypatch, key):
    """The same approximation, at the same rays."""
    parameters = under_sky(key)
    _, own = tables(key, fits(key), "sky")
    monkeypatch.setattr(image_light(key), "tables", classmethod(lambda *_: own))
    # Smaller maps must not be remembered for other tests.
    monkeypatch.setattr(lighting, "_LIGHTINGS", {})
    classes = pixel_classes(SPHERE, parameters=parameters, grid=1, size=SIZE)
    image = realtime(read_scene(SPHERE, parameters, size=SIZE), grid=1)
    assert image.meta["environment"] == "envmap"
    assert image.meta["environment_path"] == "prefiltered"
    assert (
        image.image[classes == PixelClass.INTERIOR].max(-1) > tolerance("rendered.subject.min_radiance")
    ).all()
    exact = approximate(SPHERE, parameters=parameters, grid=1, size=SIZE)
    found = compare(image, exact, classes=classes, gate="image.float64", flip=False)
    assert found.passed, [gate.line for gate in found.gates]


@pytest.mark.long
@pytest.mark.parametrize("key", KEYS)
def test_pictures_are_near_the_path_tracer(under_sky, key):
    """The approximation's own error; the reference's noise must not decide. By default: test_environment_images."""
    parameters = under_sky(key)
    image = realtime(read_scene(SPHERE, parameters, size=SIZE), grid=4)
    classes = pixel_classes(SPHERE, parameters=parameters, grid=4, size=SIZE)
    strict = np.isin(classes, (PixelClass.INTERIOR, PixelClass.EDGE))
    shared = {"parameters": parameters, "size": SIZE, "shadows": False, "grid": 4}
    reference = converged(SPHERE, strict, gate="image.environment", **shared)
    assert reference.meta["noise_ratio"] <= 1
    found = compare(image, reference, classes=classes, gate="image.environment", flip=False)
    assert found.passed, [gate.line for gate in found.gates]


def test_a_method_without_a_prefiltered_path_is_refused_in_one_line(fits, tmp_path, capsys):
    arguments = ["realtime", "sphere", "-o", str(tmp_path / "x.exr"), "-D", "lights=constant"]
    arguments += ["--environment", "prefiltered"]
    assert main([*arguments, "-D", f"btf={fits.path('lpca')}"]) == 2
    error = capsys.readouterr().err.strip()
    assert "prefiltered" in error
    assert "rf_lobes" in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "x.exr").exists()


def test_lights_and_environment_add_up(fits, tables, monkeypatch, llvm):
    """A sun and a constant sky in one scene give the sum of their pictures."""
    _, own = tables("rf_lobes", fits("rf_lobes"), "constant")
    monkeypatch.setattr(image_light("rf_lobes"), "tables", classmethod(lambda *_: own))
    monkeypatch.setattr(lighting, "_LIGHTINGS", {})
    llvm.set_variant("scalar_rgb")
    look = llvm.ScalarTransform4f().look_at([0.5, -2, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 24}
    camera = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    bsdf = {"type": "twosided", "inside": {"type": "btf", "filename": str(fits.path("rf_lobes"))}}
    below = llvm.ScalarTransform4f().rotate([1, 0, 0], 180)
    plane = {"type": "rectangle", "bsdf": bsdf, "to_world": below}
    sky = {"type": "constant", "radiance": 0.5}
    sun = {"type": "directional", "direction": [-0.3, 0.6, -1.0]}
    scenes = [
        {"type": "scene", "camera": camera, "plane": plane, **lights}
        for lights in ({"sky": sky}, {"sun": sun}, {"sky": sky, "sun": sun})
    ]
    first, second, both = (realtime(scene, grid=1).image for scene in scenes)
    np.testing.assert_allclose(both, first + second, rtol=tolerance("rendered.sum.rtol"))
    assert first.max() > 0
    # Seen from behind through twosided, a constant sky looks as from the front of the mirrored plane.
    assert (first.max(-1) > 0).any()


@pytest.mark.parametrize("target", composer.TARGETS)
@pytest.mark.parametrize("key", KEYS)
def test_glslang_accepts_the_environment_shaders(need, fits, tmp_path, key, target):
    validator = need("glslang")
    rep, light = fits(key), image_light(key)
    own = light.tables(rep, constant(), size=8)
    own["environment_lights"] = np.zeros((1, 2, 4), np.float32)
    for host, n_lights in (
        ("hosts/mesh.frag", 0),
        ("hosts/mesh.frag", 2),
        ("hosts/probe_environment.vert", 0),
    ):
        defines = {**device.shader_defines(rep), **device.light_defines(own), "N_LIGHTS": n_lights}
        shader, directories = device.shader_file(rep)
        settings = {"representation": shader, "environment": light.SHADER, "directories": directories}
        source = composer.compose(host, defines, target=target, **settings)
        path = tmp_path / host.replace("/", "_")
        path.write_text(source, encoding="utf-8")
        done = subprocess.run([validator, str(path)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, source.explain(done.stdout)
