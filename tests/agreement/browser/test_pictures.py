"""Environments, shadows and faults in the browser: the renderer's own code and shaders, drawn by WebGL 2."""

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.errors import BtfrefError
from btfref.rendering.environment_light.transfer import TransferSettings
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.web import chromium
from btfref.rendering.web.context import WebContext, drawing, webgl
from btfref.rendering.web.probe import Device
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("renderers")

SIZE = (32, 32)

#: Way → a method that has it, the environment, further settings.
WAYS = {
    "lights": ("svd", "harmonics", {"lights": 24}),
    "prefiltered": ("rf_lobes", "harmonics", {}),
    "sh": ("lpca", "harmonics", {"order": 3}),
    "transfer": (
        "lpca",
        "harmonics",
        {"order": 3, "transfer": TransferSettings(clusters=6, components=3, bits=8)},
    ),
}


@pytest.fixture(autouse=True)
def _browser(need):
    need("chromium")


@pytest.mark.parametrize(
    "way",
    ["lights", "sh", *(pytest.param(way, marks=pytest.mark.long) for way in ("prefiltered", "transfer"))],
)
def test_environments_equal_float64(fits, way):
    key, environment, settings = WAYS[way]
    parameters = {"btf": str(fits.path(key)), "lights": "envmap", "environment": environment}
    options = {"parameters": parameters, "grid": 1, "size": SIZE}
    image = webgl(scene_file("cloth"), environment=way, **options, **settings)
    exact = approximate(scene_file("cloth"), path=way, **options, **settings)
    classes = pixel_classes(scene_file("cloth"), **options)
    found = compare(image, exact, classes=classes, gate="image.float64", flip=False)
    assert found.passed, [gate.line for gate in found.gates]
    assert image.meta["renderer"] == "webgl"
    assert "SwiftShader" in image.meta["gl_renderer"]


def test_shadows_are_those_of_opengl(fits):
    parameters = {"btf": str(fits.path("lpca")), "lights": "points2"}
    options = {"parameters": parameters, "grid": 2, "size": SIZE, "shadows": True}
    image, expected = webgl(scene_file("bowl"), **options), realtime(scene_file("bowl"), **options)
    bare = realtime(scene_file("bowl"), **{**options, "shadows": False})
    classes = pixel_classes(scene_file("bowl"), **options)
    found = compare(image, expected, classes=classes, gate="image.browser", flip=False)
    assert found.passed, [gate.line for gate in found.gates]
    assert not compare(image, bare, classes=classes, gate="image.browser", flip=False).passed


PROTOTYPE = "WebGL2RenderingContext.prototype"
EXTENSIONS = (
    f"const real = {PROTOTYPE}.getExtension; {PROTOTYPE}.getExtension = function (name)"
    " { return name.startsWith('EXT') ? null : real.call(this, name); }"
)

#: What is broken → JavaScript that breaks it, and what is said then.
BROKEN = {
    "a blank frame": (f"{PROTOTYPE}.drawArrays = () => {{}}", "the browser drew a blank frame"),
    "a lost device": (
        f"{PROTOTYPE}.drawArrays = function () {{ this.getExtension('WEBGL_lose_context').loseContext(); }}",
        "the device was lost",
    ),
    "a missing extension": (EXTENSIONS, "WebGL 2 lacks the extension EXT_color_buffer_float"),
    "an error of the driver": (
        f"{PROTOTYPE}.drawArrays = function () {{ this.enable(1); }}",
        "WebGL error 0x500",
    ),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_what_is_broken_is_said(fits, broken):
    before, said = BROKEN[broken]
    parameters = {"btf": str(fits.path("rf_poly")), "lights": "directional1"}
    with (
        Device(chromium.shared(), f"{before}; 0") as where,
        pytest.raises(BtfrefError, match=said),
        drawing(where),
    ):
        realtime(scene_file("plane"), parameters=parameters, grid=1, size=(8, 8))


def test_opengl_draws_again_afterwards(fits):
    from btfref.rendering.gl import device

    with drawing() as context:
        assert device.context() is context
        assert isinstance(context, WebContext)
    assert not isinstance(device.context(), WebContext)
    parameters = {"btf": str(fits.path("rf_poly")), "lights": "directional1"}
    image = realtime(scene_file("plane"), parameters=parameters, grid=1, size=(8, 8))
    assert np.isfinite(image.image).all()
    assert "SwiftShader" not in image.meta["gl_renderer"]
