"""Images of every registered method: real time against the noise-free reference, and faults that must not pass."""

from importlib.resources import files

import pytest
from oracle import oracle_btf

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.platform import shader_directory
from btfref.registry import methods
from btfref.rendering.gl import device
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.rendering.web.context import webgl
from btfref.representations import save
from btfref.scene.pixel_classes import pixel_classes
from btfref.validate.stages.browser import browser_classes

pytestmark = pytest.mark.usefixtures("renderers")

GATES = ("image.noise_free", "image.silhouette", "image.mesostructure", "image.background")

SCENES = ("plane", "sphere", "cloth")
LIGHTS = ("directional1", "directional3", "points2")

#: One picture a method in the default run: a curved surface seen from both sides, and more than one light. Its grid and
#: size are for quickness; the long matrix has the demo's grid.
ONE = ("cloth", "directional3")
QUICK = {"grid": 2, "size": (72, 72)}
LONG = {"grid": 4, "size": (96, 96)}

#: The method whose pictures are all made in the default run; those of the others are in the long one.
FIRST = "lpca"
OTHERS = [key for key in methods() if key != FIRST]

#: Smaller than the defaults, which are made for more texels.
SETTINGS = {
    "lpca": {"clusters": 8, "components": 4},
    "lafortune": {"lobes": 2},
    "lafortune_lut": {"lobes": 2},
    "cmf": {"clusters": 32, "half_step": 10.0},
    "hf": {"clusters": 32, "smoothness": 1.0},
    "gbrdf": {"pairs": 32, "layers": 16, "materials": 2},
    "neural": {"hidden": 16, "passes": 2.0},
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """``saved(key) -> path`` of the method's fit to the oracle, made once."""
    folder, made = tmp_path_factory.mktemp("methods"), {}
    btf = oracle_btf((16, 16))

    def get(key):
        if key not in made:
            made[key] = str(folder / f"oracle.{key}.exr")
            save(methods()[key].fit(btf, **SETTINGS.get(key, {})), made[key])
        return made[key]

    return get


@pytest.fixture(scope="module")
def classes_of():
    """Pixel classes of a scene; they do not depend on the method."""
    made = {}

    def get(name, path, parameters, grid, size):
        if (name, grid, size) not in made:
            made[name, grid, size] = pixel_classes(path, parameters=parameters, grid=grid, size=size)
        return made[name, grid, size]

    return get


@pytest.fixture(scope="module")
def reference(saved, classes_of):
    """``reference(key, scene, lights, grid, size) -> (path, parameters, image, classes)``, rendered once."""
    made = {}

    def get(key, name, lights, *, grid, size):
        case = key, name, lights, grid, size
        if case not in made:
            path = files("btfref.scene.shipped").joinpath(f"{name}.xml")
            parameters = {"btf": saved(key), "lights": lights, "tiling": "4"}
            image = render(path, parameters=parameters, grid=grid, shadows=False, size=size)
            made[case] = path, parameters, image, classes_of(name, path, parameters, grid, size)
        return made[case]

    return get


#: Its rasterizer is coarser.
IN_BROWSER = {"draw": webgl, "gate": ("image.browser", "image.browser_edges", "image.background")}


def assert_same_picture(reference, key, name, lights, settings, draw=realtime, gate=GATES):
    path, parameters, expected, classes = reference(key, name, lights, **settings)
    image = draw(path, parameters=parameters, shadows=False, **settings)
    judged = browser_classes(classes) if draw is webgl else classes
    comparison = compare(image, expected, classes=judged, gate=gate, flip=False)
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]
    # The scene fills the picture and is lit: the gates saw something.
    assert (classes == PixelClass.INTERIOR).mean() > tolerance("rendered.subject.min_covered_full")
    assert (expected.image[classes == PixelClass.INTERIOR].max(-1) > 0).mean() > tolerance(
        "rendered.subject.min_lit"
    )
    assert image.meta["not_finite"] == 0


@pytest.mark.parametrize("key", OTHERS)
def test_one_picture_of_each_method(reference, key):
    assert_same_picture(reference, key, *ONE, QUICK)


#: Methods whose picture the browser draws in the default run: a table, levels of detail, a geometry of its own.
DRAWN = (FIRST, "laplacian", "gbrdf")


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in DRAWN else pytest.mark.long) for key in methods()]
)
def test_one_picture_of_each_method_in_the_browser(reference, need, key):
    need("chromium")
    assert_same_picture(reference, key, *ONE, QUICK, **IN_BROWSER)


@pytest.mark.long
@pytest.mark.parametrize("lights", LIGHTS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("key", methods())
def test_every_scene_of_each_method_in_the_browser(reference, need, key, name, lights):
    need("chromium")
    assert_same_picture(reference, key, name, lights, LONG, **IN_BROWSER)


@pytest.mark.parametrize("lights", LIGHTS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("key", [FIRST, *(pytest.param(key, marks=pytest.mark.long) for key in OTHERS)])
def test_every_scene_of_each_method(reference, key, name, lights):
    assert_same_picture(reference, key, name, lights, LONG)


FAULTS = {
    "cosine dropped": ("hosts/mesh.frag", "irradiance * btf", "irradiance / max(w_light.z, 1e-4) * btf"),
    "light and view swapped": (
        "hosts/mesh.frag",
        "btf_eval(uv, w_light, w_view",
        "btf_eval(uv, w_view, w_light",
    ),
    "v flipped": ("hosts/mesh.frag", "btf_eval(uv,", "btf_eval(vec2(uv.x, -uv.y),"),
    "half-texel shift": ("lib/lookup/texels.glsl", "float(columns), 0.5)", "float(columns), 0.0)"),
    "wrong gamma": ("hosts/mesh.frag", "vec4(scale * sum, 1.0)", "vec4(pow(max(sum, 0.0), vec3(2.2)), 1.0)"),
    "tangent frame transposed": ("lib/surface/frame.glsl", "return transpose(mat3(", "return (mat3("),
}


#: The faults that a method's own shader could hide or share, by what it does with the directions and the texels.
WITHIN_REACH = ("light and view swapped", "half-texel shift")

CAUGHT = [
    pytest.param(key, fault, marks=[] if key == FIRST or fault in WITHIN_REACH else pytest.mark.long)
    for key in methods()
    for fault in FAULTS
]


@pytest.mark.parametrize(("key", "fault"), CAUGHT)
def test_injected_faults_are_caught_by_the_noise_free_gate(reference, tmp_path, monkeypatch, key, fault):
    file, right, wrong = FAULTS[fault]
    text = (shader_directory() / file).read_text()
    assert text.count(right) == 1
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(text.replace(right, wrong))
    shipped = device.shader_file

    def faulty(rep):
        shader, directories = shipped(rep)
        return shader, [tmp_path, *directories]

    monkeypatch.setattr(device, "shader_file", faulty)
    path, parameters, expected, classes = reference(key, *ONE, **QUICK)
    image = realtime(path, parameters=parameters, shadows=False, **QUICK)
    comparison = compare(image, expected, classes=classes, gate="image.noise_free", flip=False)
    failed = {gate.name for gate in comparison.gates if not gate.passed}
    assert "image.noise_free.p999" in failed
    # The fault is in what is shown, not in what is seen: the image stays finite.
    assert "image.finite.nonfinite" not in failed
