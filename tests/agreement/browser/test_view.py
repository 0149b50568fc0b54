"""The page of `btfref view` in a real browser: its picture against NumPy, what people do, what may be missing."""

import numpy as np
import pytest

from btfref.cli import main
from btfref.gates import tolerance
from btfref.registry import methods
from btfref.rendering.web import chromium
from btfref.view import Material, mesh_shape, shipped_shapes, write_page

#: A quad whose texture is mirrored: the v of OBJ files is turned over, as Mitsuba does it, so that it falls along y.
MIRRORED = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
f 1/1/1 2/2/1 3/3/1
f 1/1/1 3/3/1 4/4/1
"""

#: Waits for a picture, drawn in full, that shows what was last asked for.
SETTLED = """new Promise((done, fail) => {
  const look = () => {
    const { stage, failed } = document.documentElement.dataset, { painter, canvas } = globalThis.viewer ?? {};
    const shown = painter && canvas.width === canvas.clientWidth && painter.drawn === painter.version;
    if (failed) fail(new Error(failed));
    else if (shown && stage !== "rough") done(stage);
    else setTimeout(look, 10);
  };
  requestAnimationFrame(() => requestAnimationFrame(look)); // what was asked for has been laid out
})"""


def until(condition):
    """Waits for the page's own word."""
    return f"new Promise((done) => {{ const look = () => {condition} ? done(0) : setTimeout(look, 10); look(); }})"


#: What the page says of itself.
SAID = "document.documentElement.dataset"


class Visit:
    """A page in the browser, and what a visitor does there."""

    def __init__(self, page):
        self.page, self.see = page, page.evaluate

    def size(self, width, height, mobile=False):
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.page.send("Emulation.setDeviceMetricsOverride", metrics)
        self.page.send("Emulation.setTouchEmulationEnabled", {"enabled": mobile})

    def settle(self):
        return self.see(SETTLED)

    def view(self, what):
        return self.see(f"viewer.view.{what}")

    def mouse(self, kind, x, y, button="left", modifiers=0):
        down = {"left": 1, "right": 2}[button] if kind != "mouseReleased" else 0
        event = {"type": kind, "x": x, "y": y, "button": button, "buttons": down, "modifiers": modifiers}
        self.page.send("Input.dispatchMouseEvent", event | {"clickCount": 1})

    def drag(self, start, change, **options):
        x, y = start
        self.mouse("mousePressed", x, y, **options)
        for part in (1, 2, 3):
            self.mouse("mouseMoved", x + change[0] * part / 3, y + change[1] * part / 3, **options)
        self.mouse("mouseReleased", x + change[0], y + change[1], **options)

    def click(self, x, y):
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def key(self, key):
        text = {"text": key} if len(key) == 1 else {}
        self.page.send("Input.dispatchKeyEvent", {"type": "keyDown", "key": key, **text})
        self.page.send("Input.dispatchKeyEvent", {"type": "keyUp", "key": key})

    def touch(self, kind, *points):
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self.page.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory):
    """A mesh file of ours."""
    path = tmp_path_factory.mktemp("view") / "mirrored.obj"
    path.write_text(MIRRORED)
    return path


@pytest.fixture(scope="module")
def written(fits, mirrored):
    """The page of two representations."""
    page = mirrored.with_name("page.html")
    files = [str(fits.path(key)) for key in ("lpca", "rf_poly")]
    assert main(["view", *files, "--mesh", str(mirrored), "-o", str(page)]) == 0
    return page


@pytest.fixture(scope="module")
def opened(need, written):
    """The page, opened from disk; one for all tests of a file."""
    need("chromium")
    with chromium.shared().page() as page:
        page.send("Network.enable")
        visit = Visit(page)
        visit.size(860, 300)
        page.go(written.as_uri())
        visit.settle()
        yield visit


@pytest.fixture
def visit(opened):
    """The page as it is first seen, in a small window; nothing may be complained about, nothing else loaded."""
    opened.size(860, 300)
    opened.see(
        "(viewer.act.forget(), viewer.act.set('shape', 'mirrored.obj'), viewer.act.reset(),"
        " viewer.act.set('mode', 'one'), viewer.act.set('a', 0), viewer.act.set('b', 1),"
        " viewer.act.set('samples', 1), viewer.act.set('held', 'camera'))"
    )
    yield opened
    page = opened.page
    assert page.complaints() == []
    asked = [
        event["params"]["request"]["url"]
        for event in page.browser.events
        if event["method"] == "Network.requestWillBeSent" and event.get("sessionId") == page.session
    ]
    assert asked
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


# --- the picture --------------------------------------------------------------------------------------------------


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def seen(shape, pixel, size):
    """What a ray meets of a shape in float64: texture coordinates, rows of the frame, direction to the viewer."""
    forward = unit(shape.target - shape.origin)
    left = unit(np.cross([0.0, 0.0, 1.0], forward))
    up = np.cross(forward, left)
    across = 2 * np.tan(np.radians(shape.fov) / 2) / min(size)
    x, y = (np.array(pixel) + 0.5 - np.array(size) / 2) * across
    ray = forward - x * left - y * up
    p, normals, uv, dp_du = shape.mesh.corners()
    edges = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], np.broadcast_to(-ray, p[:, 0].shape)], -1)
    regular = np.abs(np.linalg.det(edges)) > np.finfo(float).eps
    at = np.linalg.solve(edges[regular], (shape.origin - p[regular, 0])[..., None])[..., 0]
    weights = np.concatenate([1 - at[:, :1] - at[:, 1:2], at[:, :2]], 1)
    distance = np.where((weights >= 0).all(1) & (at[:, 2] > 0), at[:, 2], np.inf)
    hit = int(np.argmin(distance))
    assert np.isfinite(distance[hit]), "the pixel sees nothing"
    number, weight = np.flatnonzero(regular)[hit], weights[hit]
    n = unit(weight @ normals[number])
    s = unit(dp_du[number] - n * (n @ dp_du[number]))
    side = np.cross(p[number, 1] - p[number, 0], p[number, 2] - p[number, 0]) * shape.mesh.uv_sides()[number]
    t = np.cross(n, s) * np.sign(side @ n)
    return shape.tiling * (weight @ uv[number]), np.stack([s, t, n]), unit(-ray)


def radiance(rep, shape, pixel, size, lights, lod=0.0):
    """Radiance of a pixel by the definition; lights are (azimuth, elevation, irradiance)."""
    uv, frame, towards = seen(shape, pixel, size)
    w_view, total = frame @ towards, 0.0
    side = np.array([1.0, 1.0, np.sign(w_view[2])])
    for azimuth, elevation, power in lights:
        a, e = np.radians([azimuth, elevation])
        light = frame @ [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
        total = total + np.array(power) * rep.evaluate(uv, side * light, side * w_view, lod=lod)
    return total


def test_the_picture_is_what_numpy_says(visit, fits, mirrored):
    shapes = {shape.name: shape for shape in (*shipped_shapes(), mesh_shape(mirrored))}
    colour = [(code / 255 + 0.055) / 1.055 for code in (0xFF, 0xD9, 0xB0)]
    lights = [(-35, 50, [np.pi] * 3), (150, 25, [np.pi / 2 * c**2.4 for c in colour])]
    visit.see("(viewer.view.lights[1].on = true, viewer.act.lit())")
    compared = 0
    for shape in shapes.values():
        visit.see(f"viewer.act.set('shape', '{shape.name}')")
        size = visit.see("viewer.painter.size")
        found, expected = [], []
        for part in ((0.5, 0.5), (0.41, 0.53), (0.56, 0.45), (0.48, 0.61)):
            pixel = [int(part[i] * size[i]) for i in (0, 1)]
            picked = visit.see(f"viewer.painter.pick({pixel[0]}, {pixel[1]}, [0, 1])")
            for rep, value in zip((fits("lpca"), fits("rf_poly")), picked["radiance"], strict=True):
                found.append(value[:3])
                expected.append(radiance(rep, shape, pixel, size, lights))
        error = np.abs(np.array(found) - expected) / np.max(expected)
        assert error.max() <= tolerance("view.picture.max_abs"), f"{shape.name}: {error.max()}"
        compared += len(found)
    assert compared == 32
    frame = np.array(visit.see("viewer.pick(0.5, 0.5).at.frame"))  # of the mirrored quad
    assert np.abs(frame - np.diag([1.0, -1.0, 1.0])).max() <= tolerance("view.frame.max_abs")


@pytest.mark.long
def test_every_method_is_drawn_as_numpy_says(need, fits, tmp_path):
    """Without derivatives: the level of detail is the page's own, and the definition is asked at it."""
    need("chromium")
    keys, (plane, *_) = list(methods()), shipped_shapes()
    page = write_page(tmp_path / "all.html", [Material(key, fits(key)) for key in keys], [plane])
    with chromium.shared().page() as opened:
        visit = Visit(opened)
        visit.size(860, 300)
        opened.go(page.as_uri())
        visit.settle()
        visit.see("viewer.act.set('mode', 'one')")
        size = visit.see("viewer.painter.size")
        pixel = [int(0.5 * size[0]), int(0.5 * size[1])]
        found = visit.see(f"viewer.painter.pick({pixel[0]}, {pixel[1]}, [...viewer.data.materials.keys()])")
        lod, lights = found["at"]["lod"], [(-35, 50, [np.pi] * 3)]
        for key, value in zip(keys, found["radiance"], strict=True):
            # Lookups along the footprint are the shaders' own: the pixel sees one texel of a plane from near.
            expected = radiance(fits(key), plane, pixel, size, lights, lod=lod)
            error = np.abs(np.array(value[:3]) - expected).max() / np.abs(expected).max()
            assert error <= tolerance("view.methods.max_rel"), f"{key}: {error}"
        assert opened.complaints() == []


# --- what people do -----------------------------------------------------------------------------------------------


def test_mouse_and_keys(visit):
    rtol = tolerance("view.turns.rtol")
    azimuth, elevation = visit.view("camera.azimuth"), visit.view("camera.elevation")
    visit.drag((100, 200), (60, 30))
    assert visit.view("camera.azimuth") == pytest.approx(azimuth - 0.35 * 60, rel=rtol)
    assert visit.view("camera.elevation") == pytest.approx(elevation + 0.35 * 30, rel=rtol)
    for number, options in ((0, {"button": "right"}), (0, {"modifiers": 8}), (1, {"modifiers": 2})):
        before = visit.view(f"lights[{number}].azimuth")
        visit.drag((100, 200), (60, 0), **options)
        assert visit.view(f"lights[{number}].azimuth") != before
    assert visit.view("lights[1].on") is True
    visit.key("w")
    visit.settle()
    width = visit.see("viewer.canvas.clientWidth")
    visit.drag((width / 2, 150), (width / 4, 0))
    assert visit.view("split") == pytest.approx(0.75, rel=rtol)
    first, second = visit.view("a"), visit.view("b")
    visit.key(" ")
    assert (visit.view("a"), visit.view("b")) == (second, first)
    visit.key("d")
    visit.settle()
    assert "% of the mean" in visit.see("document.getElementById('difference').textContent")
    for key, what, value in (
        ("]", "stops", 0.5),
        ("t", "tone", "reinhard"),
        ("m", "shape.name", "plane"),
        ("2", "held", 0),
    ):
        visit.key(key)
        assert visit.view(what) == value
    before = visit.view("lights[0].azimuth")
    visit.key("ArrowLeft")
    assert visit.view("lights[0].azimuth") != before
    visit.key("?")
    assert visit.see("!document.getElementById('help').hidden")
    visit.key("r")
    assert visit.view("camera.azimuth") == visit.see(
        "new viewer.view.camera.constructor(viewer.view.shape).azimuth"
    )


def test_a_click_shows_the_texel(visit, fits):
    visit.settle()
    visit.click(visit.see("viewer.canvas.clientWidth / 2"), visit.see("viewer.canvas.clientHeight / 2"))
    assert "row" in visit.see("document.getElementById('texel').innerText")
    found = visit.see(
        "(() => { const { at, plots } = viewer.texel, { w_view, w_lights } = viewer.texel.directions();"
        " return { uv: at.uv, w_view, light: w_lights[0], n: plots[0].canvas.width,"
        " lights: [...plots[0].values], views: [...plots[1].values] }; })()"
    )
    n, uv = found["n"], np.array(found["uv"])
    at = 2 * (np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1) + 0.5) / n - 1
    radius = np.linalg.norm(at, axis=-1)
    some = np.flatnonzero(radius.ravel() < 1)[:: int(n)]
    polar = np.pi / 2 * radius.ravel()[some, None]
    w = np.concatenate(
        [at.reshape(-1, 2)[some] * np.sin(polar) / radius.ravel()[some, None], np.cos(polar)], 1
    )
    rep = fits("lpca")
    for name, expected in (
        ("lights", rep.evaluate(uv, w, np.array(found["w_view"]))),
        ("views", rep.evaluate(uv, np.array(found["light"]), w)),
    ):
        value = np.reshape(found[name], (-1, 4))[some, :3]
        assert np.abs(value - expected).max() <= tolerance("view.plot.max_abs") * np.abs(expected).max()
    visit.see("viewer.act.set('samples', 4)")
    visit.see(until(f"{SAID}.stage === 'summed'"))
    visit.key("Escape")
    assert visit.see("document.getElementById('texel').parentElement.hidden")


def test_small_and_large_screens_and_fingers(visit):
    for width in (2560, 1280, 390):
        # A short window: what is asked is whether anything stands out, and software draws it.
        visit.size(width, 300 if width > 390 else 700, mobile=width == 390)
        visit.settle()
        assert visit.see("document.documentElement.scrollWidth") == width
        outside = visit.see(
            "[...document.querySelectorAll('aside *')]"
            ".filter((one) => one.getBoundingClientRect().right > innerWidth + 1).map((one) => one.tagName)"
        )
        assert [name for name in outside if name != "PRE"] == []
    before = visit.view("camera.azimuth"), visit.view("camera.distance")
    visit.touch("touchStart", (100, 200))
    visit.touch("touchMove", (140, 200))
    visit.touch("touchEnd")
    assert visit.view("camera.azimuth") < before[0]
    visit.touch("touchStart", (150, 200), (200, 200))
    visit.touch("touchMove", (100, 200), (250, 200))
    visit.touch("touchEnd")
    assert visit.view("camera.distance") < before[1]


# --- what may be missing ------------------------------------------------------------------------------------------


def test_a_lost_device_is_said_and_comes_back(visit):
    visit.see("globalThis.lost = viewer.device.gl.getExtension('WEBGL_lose_context'); lost.loseContext(); 0")
    visit.see(until(f"{SAID}.lost"))
    assert "was lost" in visit.see("document.getElementById('message').textContent")
    visit.see("lost.restoreContext(); 0")
    visit.see(until(f"!{SAID}.lost"))
    visit.settle()
    assert visit.see("document.getElementById('message').hidden")
    assert visit.see("viewer.pick(0.5, 0.5).radiance[0][3]") == 1


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "no WebGL 2"),
        ("WebGL2RenderingContext.prototype.getExtension = () => null", ""),
    ],
)
def test_without_what_the_page_needs(need, written, missing, said):
    """No WebGL 2: a message. No targets of floats: bytes do."""
    need("chromium")
    with chromium.shared().page() as page:
        visit = Visit(page)
        visit.size(600, 300)
        page.send("Page.addScriptToEvaluateOnNewDocument", {"source": missing})
        page.go(written.as_uri())
        if said:
            visit.see(until(f"{SAID}.failed"))
            assert said in visit.see("document.getElementById('message').innerText")
            return
        visit.settle()
        assert "bytes" in visit.see("document.getElementById('status').textContent")
        assert max(visit.see("viewer.pick(0.25, 0.5).radiance[0]")[:3]) > 0
        assert page.complaints() == []
