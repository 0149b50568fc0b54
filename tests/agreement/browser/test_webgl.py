"""WebGL 2 in a real Chromium: what it draws with, and that a lost device, a blank frame or a lack are failures."""

import dataclasses

import numpy as np
import pytest
from probes import probe_points

from btfref.errors import BtfrefError, MissingDependencyError
from btfref.rendering.gl.probe import broadcast_points
from btfref.rendering.ports.package import port_package
from btfref.rendering.web import chromium
from btfref.rendering.web.probe import Device, WebProbe, device
from btfref.stress.judging import port_agreement

N_POINTS = 500


@pytest.fixture(scope="module")
def browser(need):
    """The process's browser: one for all."""
    need("chromium")
    return chromium.shared()


@pytest.fixture(scope="module")
def asked(fits):
    """A small representation, its package, lookups."""
    rep = fits("rf_poly")
    points = probe_points(np.random.default_rng(5), N_POINTS, rep)
    return rep, port_package(rep), points


def ask(package, points, where=None):
    """Values of the points in the browser."""
    rows, _ = broadcast_points(*points)
    with WebProbe(package, rows, where) as probe:
        probe.run()
        return probe.values()


def test_the_renderer_says_what_it_is(browser):
    facts = device().facts
    assert "SwiftShader" in facts["webgl_renderer"]
    assert facts["browser"].startswith(("Chrome/", "HeadlessChrome/"))


def test_values_are_not_blank_and_agree(browser, asked):
    rep, package, points = asked
    value = ask(package, points)
    assert np.count_nonzero(value) > value.size / 2
    assert port_agreement(value, rep, points).passed


PROTOTYPE = "WebGL2RenderingContext.prototype"

#: What is broken → JavaScript that breaks it, and what is said then.
BROKEN = {
    "no WebGL 2": ("OffscreenCanvas.prototype.getContext = () => null", "no WebGL 2 in this browser"),
    "another renderer": (
        f"{PROTOTYPE}.getParameter = () => 'a GPU'",
        "draws with a GPU, not with SwiftShader",
    ),
    "a blank frame": (f"{PROTOTYPE}.drawArrays = () => {{}}", "a blank frame"),
    "a lost device": (
        f"{PROTOTYPE}.drawArrays = function () {{ this.getExtension('WEBGL_lose_context').loseContext(); }}",
        "the device was lost",
    ),
    "an error of the driver": (
        f"{PROTOTYPE}.drawArrays = function () {{ this.enable(1); }}",
        "WebGL error 0x500",
    ),
    "a texture that is too large": (
        f"const real = {PROTOTYPE}.getParameter; {PROTOTYPE}.getParameter = function (name)"
        " { return name === this.MAX_TEXTURE_SIZE ? 4 : real.call(this, name); }",
        "this device has 4²",
    ),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_what_is_broken_is_said(browser, asked, broken):
    _, package, points = asked
    before, said = BROKEN[broken]
    with pytest.raises(BtfrefError, match=said), Device(browser, f"{before}; 0") as where:
        ask(package, points, where)


def test_a_missing_extension_is_said(browser):
    before = (
        f"const real = {PROTOTYPE}.getExtension; {PROTOTYPE}.getExtension = function (name)"
        " { return name.startsWith('EXT') ? null : real.call(this, name); }; 0"
    )
    said = "WebGL 2 lacks the extension EXT_color_buffer_float"
    with Device(browser, before) as where, pytest.raises(BtfrefError, match=said):
        where.page.evaluate("BtfPort.connect(new OffscreenCanvas(1, 1), ['EXT_color_buffer_float']); 0")


def test_a_crashed_page_is_said_and_the_next_one_works(browser, asked):
    rep, package, points = asked
    crashed = device()
    with pytest.raises(BtfrefError, match="page crashed"):
        crashed.page.send("Page.crash")
    with pytest.raises(BtfrefError, match="page crashed"):
        ask(package, points)
    assert device() is not crashed
    assert port_agreement(ask(package, points), rep, points).passed


def test_shaders_that_do_not_compile_say_where(browser, asked):
    _, package, points = asked
    wrong = dataclasses.replace(package, shader=package.shader + "oops\n")
    with (
        pytest.raises(BtfrefError, match=r"the shader does not compile: ERROR: .*oops"),
        Device(browser) as where,
    ):
        ask(wrong, points, where)


def test_a_changed_texel_fails_the_gate(browser, asked):
    rep, package, points = asked
    textures = list(package.textures)
    at = next(i for i, texture in enumerate(textures) if texture.name == "chroma")
    table = textures[at].table
    values = table.values.copy()
    values[0] *= 1.5
    textures[at] = dataclasses.replace(textures[at], table=dataclasses.replace(table, values=values))
    assert not port_agreement(
        ask(dataclasses.replace(package, textures=tuple(textures)), points), rep, points
    ).passed


def test_errors_and_consoles_of_pages_are_heard(browser):
    with browser.page() as page:
        with pytest.raises(BtfrefError, match="in the browser: Error: said on purpose"):
            page.evaluate("throw new Error('said on purpose')")
        page.evaluate("console.error('a complaint', 3)")
        assert page.complaints() == ["a complaint 3"]
        with pytest.raises(BtfrefError, match=r"the browser refused No\.such"):
            page.send("No.such")
        with pytest.raises(BtfrefError, match=r"cannot load file:///no/such\.html"):
            page.go("file:///no/such.html")


def test_a_browser_that_does_not_answer_or_ends_is_said(need):
    need("chromium")
    with chromium.Browser() as browser, browser.page() as page:
        browser.timeout = 0.5
        with pytest.raises(BtfrefError, match=r"no answer from the browser within 0\.5 s"):
            page.evaluate("new Promise(() => 0)")
        browser.timeout = 30
        with pytest.raises(BtfrefError, match="the browser ended"):
            browser.send("Browser.crash")
    with pytest.raises(BtfrefError, match="the browser is closed"):
        browser.send("Browser.getVersion")


def test_what_is_long_is_said_in_pieces(browser, asked, monkeypatch):
    _, package, points = asked
    with Device(browser) as where:
        whole = ask(package, points, where)
    monkeypatch.setattr(chromium, "PIECE", 1000)
    with Device(browser) as where:
        assert np.array_equal(ask(package, points, where), whole)
    text = ['ä"\\\n{}' * 999, {"b": [1.5, None]}]
    with browser.page() as page:
        one, other = page.given(text), page.given(text[:1])
        assert page.evaluate(f"({one})") == text
        assert page.evaluate(f"({other})") == text[:1]


def test_bytes_go_by_a_file(browser, rng):
    """Whatever they are, and once: the page does not keep them."""
    with browser.page() as page:
        for data in (rng.bytes(3 << 20), b"", memoryview(np.arange(5, dtype=np.float32)).cast("B")):
            given = page.taken(data)
            told = f"{given}.reduce((sum, x, i) => (sum * 31 + x) % 65521, 7)"
            expected = 7
            for x in bytes(data):
                expected = (expected * 31 + x) % 65521
            assert page.evaluate(told) == expected
            with pytest.raises(BtfrefError, match="not defined"):
                page.evaluate(told)


def test_no_message_makes_the_browser_deaf(browser, monkeypatch):
    monkeypatch.setattr(chromium, "LONGEST", 10_000)
    with browser.page() as page:
        with pytest.raises(BtfrefError, match="too long for the browser"):
            page.evaluate(f"'{'x' * 10_000}'")
        assert page.evaluate("6 * 7") == 42


def test_a_browser_that_was_silent_or_ended_is_replaced(need, monkeypatch):
    need("chromium")
    monkeypatch.setattr(chromium, "_shared", [])
    first = chromium.shared()
    assert chromium.shared() is first
    first.timeout = 0.5
    with first.page() as page, pytest.raises(BtfrefError, match="no answer"):
        page.evaluate("new Promise(() => 0)")
    second = chromium.shared()
    assert second is not first
    assert first.closed
    with pytest.raises(BtfrefError, match="the browser ended"):
        second.send("Browser.crash")
    second._process.wait(30)
    third = chromium.shared()
    assert third is not second
    assert third.send("Browser.getVersion")["product"] == third.version
    third.close()


def test_without_chromium_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(chromium, "chromium", lambda: None)
    with pytest.raises(MissingDependencyError, match=r"apt-get install .*chromium"):
        chromium.Browser()
