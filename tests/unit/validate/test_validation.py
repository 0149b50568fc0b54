"""The matrix of validation: selection, failures, the report in a browser."""

import copy
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import jsonschema
import numpy as np
import pytest
from browser import browse
from schemas import assert_follows_schema

from btfref.commands.validate import lines
from btfref.comparison.waterfall import Picture, waterfall
from btfref.conventions import PixelClass
from btfref.errors import InputError, MissingDependencyError
from btfref.gates import tolerance, tolerances
from btfref.images.display import Display
from btfref.querying import split
from btfref.registry import methods
from btfref.report.pack import pack, unpack, unpack_text
from btfref.report.validation import write_validation
from btfref.validate.cell import GATES, CellResult, eight_bits, failed_cell, read_cell
from btfref.validate.cell import _save as save_cell
from btfref.validate.matrix import FULL, LIGHTS, MESOSTRUCTURES, QUICK, SCENES, Spec, select
from btfref.validate.run import Validation, validate
from btfref.validate.stages import browser
from btfref.validate.summary import HEADER, off_grid_rows, rows


def test_selection():
    assert len(select()) == len(methods()) * len(SCENES) * len(LIGHTS) * len(MESOSTRUCTURES)
    assert {spec.method for spec in select(quick=True)} == set(methods())
    chosen = select(only=["lpca", "cmf"], scenes=["sphere"], lights=["points2"], mesostructures=["rings"])
    assert chosen == [Spec("rings", key, "sphere", "points2") for key in ("cmf", "lpca")]
    for wrong in (
        {"only": ["jpeg"]},
        {"scenes": ["moon"]},
        {"lights": ["dark"]},
        {"mesostructures": ["mud"]},
    ):
        with pytest.raises(InputError):
            select(**wrong)


def test_ways_of_environments_in_the_browser(fits, monkeypatch):
    """The quick run draws none of those that are sums over lights alone: they have pictures under lights."""
    assert tuple(browser.WAYS) == FULL.browser_ways == (*QUICK.browser_ways, "lights")
    found = {key: browser.environment_ways(fits(key)) for key in ("lpca", "rf_poly", "raw")}
    assert found == {"lpca": ["sh", "lights"], "rf_poly": ["prefiltered", "lights"], "raw": ["lights"]}
    assert browser.environment_gates(fits.path("raw"), QUICK.browser_ways) == []
    monkeypatch.setattr(browser, "chromium", lambda: None)
    assert browser.environment_gates(fits.path("lpca"), QUICK.browser_ways) == []


def test_background_beside_a_surface_is_a_silhouette_in_the_browser():
    classes = np.full((5, 6), PixelClass.BACKGROUND, np.uint8)
    classes[0, 0] = classes[0, 1] = PixelClass.INTERIOR
    found = browser.browser_classes(classes)
    assert found.dtype == classes.dtype
    assert (found[0, :2] == PixelClass.INTERIOR).all()
    assert {tuple(at) for at in np.argwhere(found == PixelClass.SILHOUETTE)} == {
        (0, 2),
        (1, 0),
        (1, 1),
        (1, 2),
    }


def test_without_a_browser_its_pictures_are_left_out_or_demanded(monkeypatch):
    lights = QUICK.browser_lights[0]
    assert set(QUICK.browser_lights) < set(FULL.browser_lights)
    monkeypatch.delenv("BTFREF_REQUIRE", raising=False)
    monkeypatch.setattr(browser, "chromium", lambda: "chromium")
    assert browser.draws(lights, QUICK)
    assert not browser.draws("sky", FULL)
    assert browser.left_out(lights, QUICK) == ""
    monkeypatch.setattr(browser, "chromium", lambda: None)
    assert not browser.draws(lights, QUICK)
    assert "Chromium is not on this machine" in browser.left_out(lights, QUICK)
    assert browser.left_out("sky", QUICK) == ""
    browser.demand_browser()
    for wanted in ("chromium", "gl, chromium", "all"):
        monkeypatch.setenv("BTFREF_REQUIRE", wanted)
        with pytest.raises(MissingDependencyError, match="Chromium"):
            validate([Spec("checker", "lpca", "sphere", lights)])


def test_evaluators_that_took_no_part_are_named(monkeypatch):
    result = Validation([], [], QUICK, facts={"absent": ["webgl"]})
    assert [line for line in lines(result) if line.startswith("not run: webgl;")]
    assert not [line for line in lines(Validation([], [], QUICK)) if line.startswith("not run")]


def test_a_missing_reference_fails_every_gate():
    cell = failed_cell(Spec("checker", "lpca", "sphere", "points2"), "no driver")
    assert cell.outcome == "fail"
    assert {gate.gate for gate in cell.gates} == set(GATES)
    assert not any(gate.passed for gate in cell.gates)
    assert all("no driver" in gate.detail for gate in cell.gates)
    assert not Validation([cell], [], QUICK).passed
    assert not Validation([], [], QUICK).passed


def test_eight_bits_are_what_a_display_shows():
    display = Display(1.0)
    assert eight_bits(np.array([0.0, 0.5, 7.0]), display) == pytest.approx(
        [0, 0.5, 0.5], abs=tolerance("report.eight_bits")
    )
    shown = eight_bits(np.linspace(0, 0.75, 20001), display)
    assert len(np.unique(shown)) == 256


def test_a_picture_that_is_nearly_another_costs_little(rng):
    reference = rng.random((60, 70, 3))
    image = reference * (1 + 1e-6 * rng.normal(size=reference.shape))
    alone, beside = pack(image, bits=6), pack(image, bits=6, base=("reference", reference))
    assert beside["base"] == "reference"
    assert len(beside["data"]) < tolerance("report.beside.share") * len(alone["data"])
    packed = pack(reference, bits=6)
    np.testing.assert_allclose(unpack(beside, packed), image, rtol=tolerance("report.beside.rtol"))
    assert "base" not in pack(5 * image, base=("reference", reference))


@pytest.fixture
def result(rng):
    """A validation of two cells with made pictures."""
    cells, size = [], 24
    classes = np.full((size, size), PixelClass.INTERIOR, np.uint8)
    classes[:3], classes[3] = PixelClass.BACKGROUND, PixelClass.SILHOUETTE
    hit = (classes != PixelClass.BACKGROUND)[..., None]
    for key in ("lpca", "svd"):
        reference = rng.uniform(0.1, 0.9, (size, size, 3)).astype(np.float32) * hit
        image = (reference * (1 + 1e-6 * rng.normal(size=reference.shape))).astype(np.float32)
        truth = reference + 0.02 * rng.normal(size=(4, *reference.shape)) * hit
        chain = [("geometry", truth), ("sampled BTF", reference[None] * 1.01), ("fit", reference[None])]
        chain += [
            ("port", reference[None]),
            ("real time", image[None]),
            ("8 bits", eight_bits(image, Display())[None]),
        ]
        fall = waterfall([Picture(*c) for c in chain], classes == PixelClass.INTERIOR, Display())
        spec = Spec("checker", key, "sphere", "points2")
        images = {"truth": truth.mean(0).astype(np.float32), "reference": reference, "realtime": image}
        facts = {
            "name": spec.name,
            **vars(spec),
            "waterfall": fall.to_dict(),
            "image_gates": list(GATES),
            "gates": [],
            "notes": fall.explanation,
            "frame_ms": 2.0 + len(cells),
        }
        made = CellResult(facts, images, classes)
        measured = (*made.comparison().gates, *fall.gates)
        facts["gates"] = [g.to_dict() for g in measured]
        cells.append(replace(made, measured=measured))
    errors = {name: [0.2, 0.1, 0.3] for name in ("rmse", "nrmse", "mae", "psnr_log", "bias")}
    errors |= {"delta_e00": [8.5, 8.0, 9.0], "noise": 0.01, "rows": 500}
    of_methods = [
        {
            "mesostructure": "checker",
            "method": key,
            "gates": cells[0].facts["gates"][:1],
            "off_grid": {footprint: errors for footprint in split.FOOTPRINTS},
            "bytes": n,
        }
        for key, n in (("lpca", 3000), ("svd", 1000))
    ]
    return Validation(cells, of_methods, QUICK, 1.0, 2, 2)


def test_a_cell_comes_back_from_its_file(result, tmp_path):
    cell = result.cells[0]
    save_cell(tmp_path / "a.cell.npz", cell)
    again = read_cell(tmp_path / "a.cell.npz")
    assert again.facts == json.loads(json.dumps(cell.facts))
    assert again.gates == cell.gates
    with np.load(tmp_path / "a.cell.npz") as stored:
        text = str(stored["facts"])
    assert '"passed"' not in text
    assert '"outcome"' not in text
    assert '"explained"' not in text
    np.testing.assert_array_equal(again.images["truth"], cell.images["truth"])


def test_verdicts_follow_the_limits_of_today(result, tmp_path, monkeypatch):
    """Nothing is measured again: the stored number meets another limit."""
    save_cell(tmp_path / "a.cell.npz", result.cells[0])
    assert read_cell(tmp_path / "a.cell.npz").outcome == "pass"
    strict = copy.deepcopy(tolerances._gates())
    strict["image.noise_free"]["max"] = 0.0
    monkeypatch.setattr(tolerances, "_gates", lambda: strict)
    cell = read_cell(tmp_path / "a.cell.npz")
    assert cell.outcome == "fail"
    assert [gate.name for gate in cell.gates if not gate.passed] == ["image.noise_free.max"]


def test_results_follow_the_schema(result):
    data = result.to_dict()
    assert_follows_schema(data)
    assert_follows_schema(
        Validation([failed_cell(Spec("checker", "lpca", "a", "b"), "why")], [], QUICK).to_dict()
    )
    del data["cells"][0]["gates"][0]["reason"]
    with pytest.raises(jsonschema.ValidationError):
        assert_follows_schema(data)


def test_summary_has_a_row_a_method(result):
    table = [dict(zip(HEADER, row, strict=True)) for row in rows(result)]
    assert [(r["method"], r["cells"], r["bytes"]) for r in table] == [
        ("lpca", "1/1", 3000),
        ("svd", "1/1", 1000),
    ]
    fall = result.cells[0].facts["waterfall"]
    assert table[0]["total"] == pytest.approx(fall["total"]["estimate"] / fall["mean"])
    assert table[0]["off grid ΔE00"] == 8.5
    assert table[0]["off grid MAE"] == 0.2
    header, lines = off_grid_rows(result)
    assert [line[:3] for line in lines[:3]] == [["checker", "lpca", name] for name in split.FOOTPRINTS]
    assert dict(zip(header, lines[0], strict=True))["ΔE00"] == "8.50 (8.00 to 9.00)"
    # Where the checks failed there is no error to show.
    none = replace(result, methods=[{**facts, "off_grid": None} for facts in result.methods])
    assert rows(none)[0][2] is None
    assert off_grid_rows(none)[1] == []


DRIVER = """<script>
addEventListener("load", async () => {
  const found = {}, root = document.documentElement;
  for (let i = 0; i < 200 && root.dataset.ready === undefined && !root.dataset.failed; i++)
    await new Promise((done) => setTimeout(done, 20));
  found.ready = root.dataset.ready; found.failed = root.dataset.failed ?? null;
  found.matrix = root.dataset.matrix ?? null;
  found.broken = [...document.images].filter((i) => !i.complete || !i.naturalWidth).length;
  found.images = document.images.length;
  found.overflow = root.scrollWidth - innerWidth;
  found.canvases = [...document.querySelectorAll("canvas")].map((c) => c.width > 0);
  const value = document.getElementById("value");
  if (value) {
    const read = () => [...document.querySelectorAll(".matrix .value")].map((v) => v.textContent);
    found.before = read();
    value.value = "whole, RMSE / mean"; value.dispatchEvent(new Event("change"));
    found.after = read();
    const filter = document.getElementById("filter");
    filter.value = "checker"; filter.dispatchEvent(new Event("change"));
    found.rows = [...document.querySelectorAll(".matrix tbody tr")].filter((r) => !r.hidden).length;
  }
  const canvas = document.querySelector(".frame.main canvas.a");
  if (canvas) {
    const pick = document.querySelector(".pick-a");
    pick.value = "truth"; pick.dispatchEvent(new Event("change"));
    found.tag = document.querySelector(".tag-a").textContent;
    const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    found.painted = data.some((x, i) => i % 4 !== 3 && x > 0);
  }
  parent.postMessage(JSON.stringify(found), "*");
});
</script></body>"""


@pytest.mark.parametrize("width", [1280, 390])
def test_the_report_works_from_disk(result, tmp_path, need, width):
    chromium = need("chromium")
    index = write_validation(tmp_path / "report", result)
    pages = [index, *sorted((index.parent / "cells").iterdir())]
    assert len(pages) == 3
    for number, page in enumerate(pages[:2]):
        page.write_text(page.read_text("utf-8").replace("</body>", DRIVER), "utf-8")
        found, console = browse(chromium, page, tmp_path / f"profile{number}", width)
        assert console == []
        assert found["failed"] is None
        assert found["broken"] == 0
        assert found["overflow"] <= 0
        if page == index:
            assert found["images"] == 2
            assert found["matrix"] == "ready"
            assert found["before"] == ["✓", "✓"]
            assert all(re.fullmatch(r"0\.\d+", text) for text in found["after"])
            assert found["rows"] == 2
        else:
            assert found["ready"] == "1"
            assert all(found["canvases"])
            assert found["tag"] == "Geometry truth"
            assert found["painted"]
    data = json.loads((index.parent / "validation.json").read_text("utf-8"))
    assert data["kind"] == "validation"
    assert data["passed"] is True
    text = "".join(page.read_text("utf-8") for page in pages)
    cells = [unpack_text(packed) for packed in re.findall(r'id="packed">([^<]+)<', text)]
    assert len(cells) == 2
    text += "".join(cells)
    assert "Where the error comes from" in text
    assert "8.50 (8.00 to 9.00)" in text
    assert not re.search(r'(src|href)="https?:', text)


class _Elements(HTMLParser):
    """Elements of a page that its own text does not have."""

    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        """Whatever would run or load something of an attacker."""
        self.found += [name for name, _ in attrs if name.startswith("on")]
        self.found += [tag] if tag == "hostile" else []


def _hostile(data, evil):
    """Every text of JSON-able data with an attack behind it, but for what is looked up in tables."""
    if isinstance(data, dict):
        kept = ("outcome", "entry", "gate", "sign", "pixel_class", "name")
        return {k: v if k in kept and k != "name" else _hostile(v, evil) for k, v in data.items()}
    if isinstance(data, list | tuple):
        return [_hostile(one, evil) for one in data]
    return data + evil if isinstance(data, str) else data


def test_hostile_names_cannot_break_the_pages(result, tmp_path):
    """Names of methods, mesostructures, scenes and lights, notes, reasons and facts come from files and packages."""
    evil = """\"'></script></td><hostile onclick=alert(1)>{{css}}"""
    cells = []
    for cell in result.cells:
        facts = dict(cell.facts)
        for name in ("name", "method", "mesostructure", "scene", "lights", "notes"):
            facts[name] = f"{facts[name]}{evil}"
        facts["gates"] = _hostile(json.loads(json.dumps(facts["gates"])), evil)
        facts["waterfall"] = facts["waterfall"] | {"explanation": facts["waterfall"]["explanation"] + evil}
        cells.append(replace(cell, facts=facts))
    methods = [
        m | {"method": m["method"] + evil, "mesostructure": m["mesostructure"] + evil, "notes": evil}
        for m in result.methods
    ]
    made = replace(result, cells=cells, methods=methods, facts={evil: {evil: evil}, "code": evil})
    index = write_validation(tmp_path / "report", made)
    pages = [path.read_text("utf-8") for path in index.parent.rglob("*.html")]
    assert len(pages) == 1 + len(cells)
    for page in pages:
        assert _Elements(page).found == []
        packed = re.search(r'id="packed">([^<]*)<', page)
        if packed:
            inside = unpack_text(packed[1])
            assert "alert(1)" in inside
            assert _Elements(inside).found == []


def test_settings_say_how_finely():
    assert FULL.texels > QUICK.texels
    assert FULL.size > QUICK.size
    # The rows of benchmarks.
    assert (FULL.off_grid_rows, FULL.off_grid_spp) == (split.ROWS, split.SPP)
    assert (QUICK.off_grid_rows, QUICK.off_grid_spp) == (split.QUICK_ROWS, split.QUICK_SPP)
