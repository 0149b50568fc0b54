"""The report: its data, its bytes, and the page in a browser."""

import io
import json
import re
from importlib.resources import files

import numpy as np
import pytest
from browser import browse

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates import GateResult, missing_reference, reason, tolerance
from btfref.images.png import encode_png
from btfref.report import Cell, report_data, write_report
from btfref.report.pack import pack, unpack
from btfref.report.text import number

FACTS = {
    "written": "2026-01-01 12:00 UTC",
    "versions": {"btfref": "0.1.0", "mitsuba": "3.9.1"},
    "seeds": {"render": 0},
    "commands": ["btfref demo --out report.html"],
    # Facts within facts within facts, and words that do not break, as the demo has them.
    "renderers": {
        "geometry truth": {"mesostructure": {"name": "checker", "parameters": {"amplitude": 0.1}}},
        "real time": {"resident_views": {"/a/long/path/without/a/place/to/break/checker.lpca.exr": 81}},
    },
}


def pictures(rng, size=24):
    """Reference, test and truth of a disc, and its class map."""
    y, x = np.mgrid[0:size, 0:size] - (size - 1) / 2
    radius = np.hypot(x, y) / size
    classes = np.full(radius.shape, PixelClass.BACKGROUND, np.uint8)
    classes[radius < 0.43] = PixelClass.SILHOUETTE
    classes[radius < 0.38] = PixelClass.INTERIOR
    hit = (classes != PixelClass.BACKGROUND)[..., None]
    reference = np.where(hit, 0.3 + 0.2 * np.sin(x[..., None] / [1.0, 2.0, 3.0]), 0.0)
    test = reference * (1 + 1e-5 * rng.standard_normal(reference.shape))
    return reference, test, reference * 1.02, classes


@pytest.fixture
def cells(rng):
    reference, test, truth, classes = pictures(rng)
    gates = ["image.noise_free", "image.silhouette", "image.background"]
    good = compare(test, reference, classes=classes, gate=gates, variance=np.full(test.shape, 1e-9))
    bad = compare(test * 1.1, reference, classes=classes, gate=gates)
    named = {"reference": reference, "realtime": test, "truth": truth}
    return [
        Cell("raw · disc", named, good, notes="Shadows are off."),
        Cell("lpca · disc", named | {"realtime": test * 1.1}, bad),
        Cell("svd · disc", {"reference": reference, "realtime": test}, None),
        Cell("raw · probes", gates=tuple(missing_reference("probe.agreement", "probe.npz"))),
    ]


# --- packing ----------------------------------------------------------------------------------------------


def test_the_page_names_pixel_classes_in_their_order():
    script = (files("btfref.report") / "assets" / "report.js").read_text("utf-8")
    table = script.split("const CLASSES = ")[1].split(";")[0]
    assert re.findall(r'"(\w+)"', table) == [kind.label for kind in PixelClass]


@pytest.mark.parametrize(("bits", "key"), [(8, "report.packing.pictures"), (6, "report.packing.maps")])
def test_packing_keeps_its_bits(rng, bits, key):
    values = rng.choice([-1.0, 1.0], (13, 29, 3)) * 10.0 ** rng.uniform(-4, 4, (13, 29, 3))
    packed = pack(values, bits=bits)
    assert (packed["height"], packed["width"], packed["channels"]) == (13, 29, 3)
    assert np.abs(unpack(packed) / values - 1).max() <= tolerance(key)


@pytest.mark.parametrize("smooth", [True, False])
def test_packing_chooses_the_shorter_form(rng, smooth):
    values = np.linspace(1, 2, 64 * 64).reshape(64, 64) if smooth else rng.choice([0.0, 1.0], (64, 64))
    packed = pack(values)
    assert np.abs(unpack(packed)[..., 0] - values).max() <= 2 * tolerance("report.packing.pictures")


def test_packing_marks_what_is_not_finite():
    found = unpack(pack(np.array([[np.nan, np.inf, -np.inf, 0.0, -1.0]])))[0, :, 0]
    assert np.isnan(found[:3]).all()
    assert found[3:].tolist() == [0.0, -1.0]
    assert unpack(pack(np.zeros((2, 2)))).max() == 0
    assert unpack(pack(np.full((2, 2), np.nan))).size == 4
    assert np.isfinite(unpack(pack(np.array([[1e300, 5e-324, 3e38]])))).all()


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
def test_png_is_read_by_others(rng, shape):
    from PIL import Image

    pixels = rng.integers(0, 256, shape, np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encode_png(pixels)))), pixels)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.00123456, "0.00123"),
        (9.99951e-4, "1e−3"),
        (-0.5, "−0.5"),
        (1.0, "1"),
        (120.0, "120"),
        (1234567.0, "1.23e6"),
        (1.5e-7, "1.5e−7"),
        (65536, "65\u202f536"),
        (float("inf"), "∞"),
        (float("nan"), "NaN"),
        (None, "–"),
        ("inf", "inf"),
    ],
)
def test_numbers_for_readers(value, text):
    assert number(value) == text


# --- the file ---------------------------------------------------------------------------------------------


def test_report_holds_every_number_and_reason(tmp_path, cells):
    path = write_report(tmp_path / "report.html", title="A & B", cells=cells, facts=FACTS)
    html = path.read_text("utf-8")
    assert "A &amp; B" in html
    for cell in cells:
        assert cell.name in html
        for gate in cell.all_gates:
            assert gate.gate in html
            assert number(gate.limit) in html
    for key in ("image.noise_free", "image.silhouette", "probe.agreement"):
        assert reason(key).split(";")[0].replace("'", "&#x27;") in html
    assert "missing reference: probe.npz" in html
    assert "were not compared, which counts as a failure" in html
    assert "btfref demo --out report.html" in html
    data = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert data == report_data("A & B", cells, FACTS)
    assert data == json.loads(re.search(r'id="report-data">(.*?)</script>', html, re.S)[1])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "report.json"]


def test_outcomes(cells):
    assert [cell.outcome for cell in cells] == ["pass", "fail", "fail", "fail"]
    assert Cell("nothing").outcome == "fail"
    undecided = GateResult("image.equivalence.relative_rmse", False, 0.01, 0.02, "x", "inconclusive")
    assert Cell("noisy", gates=(undecided,)).outcome == "inconclusive"
    assert report_data("t", cells[:1], {})["passed"] is True
    assert report_data("t", cells, {})["passed"] is False


def test_cell_shows_what_was_compared(rng):
    reference, test, truth, _ = pictures(rng)
    named = {"realtime": test, "truth": truth, "reference": reference}
    assert Cell("a", named).pair == ("reference", "realtime")
    assert Cell("a", named, compare(test, reference)).pair == ("reference", "realtime")
    assert Cell("a", named, compare(reference, truth)).pair == ("truth", "reference")
    assert Cell("a", {"x": test}).pair == ("x", "x")
    assert Cell("a", {"x": test, "y": truth}, compare(test, test)).pair == ("x", "y")
    broken = np.full_like(test, np.nan)
    assert Cell("a", {"x": broken, "y": test}, compare(broken, test)).pair == ("y", "x")


def test_report_is_self_contained(tmp_path, cells):
    html = write_report(tmp_path / "r.html", title="t", cells=cells, facts=FACTS).read_text("utf-8")
    assert not re.findall(r"https?://|@import|<link(?! rel=\"icon\" href=\"data:)|<script[^>]+src", html)
    assert set(re.findall(r'\bsrc="([^"]{5})', html)) == {"data:"}
    assert "default-src 'none'" in html


def test_equal_input_gives_equal_bytes(tmp_path, cells):
    a, b = (
        write_report(tmp_path / name, title="t", cells=cells, facts=FACTS).read_bytes()
        for name in ("a.html", "b.html")
    )
    assert a == b


def test_text_cannot_break_the_page(tmp_path, cells):
    evil = "</script><script>alert(1)</script>{{css}}"
    cell = Cell(evil, cells[0].images | {evil: cells[0].images["truth"]}, cells[0].comparison, notes=evil)
    html = write_report(
        tmp_path / "r.html", title=evil, cells=[cell], facts={evil: {evil: evil}, "commands": [evil]}
    ).read_text("utf-8")
    assert "<script>alert" not in html
    assert html.count("</script>") == 4 - 1  # pixels, data, code


def test_pictures_that_are_not_finite_or_negative_are_named(tmp_path, rng):
    reference, test, _, classes = pictures(rng)
    test = test.copy()
    test[12, 12, 0], test[12, 11, 1] = np.nan, -0.25
    found = compare(test, reference, classes=classes, gate="image.noise_free")
    cell = Cell("broken", {"reference": reference, "realtime": test}, found)
    html = write_report(tmp_path / "r.html", title="t", cells=[cell], facts={}).read_text("utf-8")
    assert "1 pixels are not finite in the test picture" in html
    assert "1 pixels are negative in the test picture" in html


def test_bad_input_is_one_clear_line_and_leaves_nothing(tmp_path, cells):
    wrong = Cell("wrong", {"reference": np.zeros((2, 3, 3)), "realtime": np.zeros((3, 2, 3))})
    flat = Cell("flat", {"reference": np.zeros((2, 3))})
    other = Cell("other", {"reference": np.zeros((2, 3, 3))}, cells[0].comparison)
    for path, chosen, word in (
        (tmp_path / "r.html", [], "cell"),
        (tmp_path / "r.html", [wrong], "wrong"),
        (tmp_path / "r.html", [flat], "flat"),
        (tmp_path / "r.html", [other], "other"),
        (tmp_path / "r.pdf", cells, "html"),
        (tmp_path / "none" / "r.html", cells, "folder"),
    ):
        with pytest.raises(InputError, match=word) as error:
            write_report(path, title="t", cells=chosen, facts={})
        assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_nine_cells_of_noise_stay_small(tmp_path, rng):
    noise = {name: rng.random((256, 256, 3)) for name in ("reference", "realtime", "truth")}
    found = compare(noise["realtime"], noise["reference"], gate="image.noise_free")
    path = write_report(tmp_path / "r.html", title="t", cells=[Cell("noise", noise, found)], facts={})
    assert 9 * path.stat().st_size <= 1e6 * tolerance("report.size.megabytes")


# --- the page in a browser --------------------------------------------------------------------------------

DRIVER = """
<script>
(async () => {
  const root = document.documentElement, found = {};
  const wait = () => new Promise((resolve) => setTimeout(resolve, 25));
  for (let i = 0; i < 200 && !root.dataset.ready && !root.dataset.failed; i++) await wait();
  const peek = (canvas, x, y, w, h) => {
    const copy = document.createElement("canvas");
    copy.width = canvas.width; copy.height = canvas.height;
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0);
    return [...context.getImageData(x, y, w, h).data];
  };
  found.ready = root.dataset.ready, found.failed = root.dataset.failed ?? null;
  found.broken = [...document.images].filter((i) => !i.complete || !i.naturalWidth).length;
  found.images = document.images.length;
  found.overflow = root.scrollWidth - root.clientWidth;
  found.canvases = [...document.querySelectorAll(".frame canvas")].map((c) => {
    return new Set(peek(c, 0, 0, c.width, c.height)).size > 1;
  });
  const stage = document.querySelector(".stage"), q = (selector) => stage.querySelector(selector);
  const canvas = q("canvas.a");
  canvas.setPointerCapture = () => {};
  const box = canvas.getBoundingClientRect();
  const point = (kind, u, v) => canvas.dispatchEvent(new PointerEvent(kind,
    { clientX: box.left + u * box.width, clientY: box.top + v * box.height, bubbles: true, pointerId: 1 }));
  const colour = () => peek(canvas, 12, 12, 1, 1);
  point("pointermove", 12.5 / 24, 12.5 / 24);
  found.readout = q(".readout").textContent;
  point("pointerdown", 0.5, 0.5); point("pointermove", 0.25, 0.5); point("pointerup", 0.25, 0.5);
  found.split = q(".frame.main").style.getPropertyValue("--split");
  found.colour = colour();
  q(".stops").value = 1; q(".stops").dispatchEvent(new Event("input"));
  found.brighter = colour();
  q(".stops").value = 0; q(".stops").dispatchEvent(new Event("input"));
  q("[data-mode=flip]").click(); q("[data-mode=flip]").click();
  const hidden = (selector) => getComputedStyle(q(selector)).display === "none";
  found.flipped = hidden(".tag-a") && !hidden(".tag-b");
  q("[data-mode=side]").click();
  found.side = getComputedStyle(q(".frame.main")).display;
  q(".pick-b").value = "truth"; q(".pick-b").dispatchEvent(new Event("change"));
  found.tag = q(".tag-b").textContent;
  q("[data-mode=swipe]").click(); q("[data-zoom=in]").click();
  found.zoom = q(".zoom-out").textContent;
  const scale = q(".map input"), ticks = () => q(".map .ticks").textContent, before = ticks();
  scale.value = Number(scale.value) + 3; scale.dispatchEvent(new Event("input"));
  found.note = q(".map figcaption .muted").textContent;
  found.rescaled = before !== ticks();
  document.getElementById("theme").click(); document.getElementById("theme").click();
  found.theme = root.dataset.theme;
  parent.postMessage(JSON.stringify(found), "*");
})();
</script></body>"""


@pytest.mark.parametrize("width", [1280, 390])
def test_page_works_in_a_browser(tmp_path, cells, need, width):
    chromium = need("chromium")
    path = write_report(tmp_path / "r.html", title="t", cells=cells, facts=FACTS)
    html = path.read_text("utf-8")
    assert html.count("</body>") == 1
    path.write_text(html.replace("</body>", DRIVER), "utf-8")
    found, console = browse(chromium, path, tmp_path / "profile", width)
    assert console == []
    assert found["failed"] is None
    assert found["ready"] == "3"
    assert found["broken"] == 0
    assert found["images"] == 3 + 3 + 2
    assert found["overflow"] <= 0
    assert all(found["canvases"])
    assert len(found["canvases"]) == (2 + 6) + (2 + 5) + 2
    assert "x 12, y 12, interior" in found["readout"]
    expected = unpack(pack(cells[0].images["reference"]))[12, 12]
    shown = re.search(r"Reference (\S+) (\S+) (\S+)", found["readout"]).groups()
    assert [float(text) for text in shown] == pytest.approx(expected, rel=tolerance("report.readout.rtol"))
    assert found["split"] == "25%"
    display = cells[0].comparison.settings["display"]["stops"]
    from btfref.comparison import Display

    encoded = 255 * Display(display).encoded(expected)
    assert found["colour"][:3] == pytest.approx(encoded, abs=tolerance("report.colour.steps"))
    assert sum(found["brighter"]) > sum(found["colour"])
    assert found["flipped"] is True
    assert found["side"] == "grid"
    assert found["tag"] == "Geometry truth"
    assert found["zoom"] == "2×"
    assert found["rescaled"] is True
    assert found["note"].startswith("Real-time − Reference, gain ")
    assert found["theme"] == "dark"


def test_page_cannot_reach_the_network(tmp_path, cells, need):
    """And the console lines that the other browser test wants to be none are really seen."""
    chromium = need("chromium")
    path = write_report(tmp_path / "r.html", title="t", cells=cells[:1], facts=FACTS)
    foreign = '<img src="http://127.0.0.1:9/a.png">' + DRIVER
    path.write_text(path.read_text("utf-8").replace("</body>", foreign), "utf-8")
    found, console = browse(chromium, path, tmp_path / "profile", 1280)
    assert found["broken"] == 1
    assert any("Content Security Policy" in line for line in console)
