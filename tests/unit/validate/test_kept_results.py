"""Results that are kept: keys, seals, what was tampered with."""

from dataclasses import replace
from pathlib import Path

import pytest

from btfref.validate.cache import Cache
from btfref.validate.material import material_key
from btfref.validate.matrix import QUICK
from btfref.validate.stages import drawn
from btfref.validate.stages.fits import fit_key


def test_keys_follow_what_a_result_depends_on(tmp_path, monkeypatch):
    assert material_key("checker", QUICK) != material_key("rings", QUICK)
    assert material_key("checker", QUICK) != material_key("checker", replace(QUICK, spp=QUICK.spp + 1))
    # The size of the pictures is no affair of the material's or of a fit's.
    assert fit_key("checker", "svd", QUICK) == fit_key("checker", "svd", replace(QUICK, size=QUICK.size + 1))
    assert fit_key("checker", "svd", QUICK) != fit_key("checker", "lpca", QUICK)


def test_results_appear_whole_or_not_at_all(tmp_path):
    store = Cache(tmp_path / "results")
    with pytest.raises(RuntimeError):
        store.write(
            "key", ".txt", lambda path: (path.write_text("half"), (_ for _ in ()).throw(RuntimeError()))
        )
    assert not store.has("key", ".txt")
    assert list((tmp_path / "results").iterdir()) == []
    store.write("key", ".txt", lambda path: path.write_text("whole"))
    assert store.path("key", ".txt").read_text() == "whole"
    assert store.computed == 2


def _entry(path, kind):
    if kind == "folder":
        path.mkdir()
        (path / "inner").mkdir()
        path = path / "inner" / "chunk"
    path.write_bytes(b"what was measured, 0123456789")


TAMPERINGS = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "flipped": lambda path: path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:]),
    "edited": lambda path: path.write_bytes(path.read_bytes().replace(b"0123456789", b"1234561234")),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"0"),
    "gone": lambda path: path.unlink(),
    "another's": lambda path: path.write_bytes(b"what was measured, 9999999999"),
}


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("tampering", TAMPERINGS)
def test_what_was_tampered_with_is_made_again(tmp_path, tampering, kind):
    def save(path):
        _entry(path, kind)

    entry = Cache(tmp_path).get("key", ".json", save)
    assert Cache(tmp_path).has("key", ".json")
    target = entry / "inner" / "chunk" if kind == "folder" else entry
    TAMPERINGS[tampering](target)
    again = Cache(tmp_path)
    assert not again.has("key", ".json")
    again.get("key", ".json", save)
    assert again.computed == 1
    assert target.read_bytes() == b"what was measured, 0123456789"
    assert Cache(tmp_path).has("key", ".json")


def test_a_file_takes_the_place_of_a_folder_and_the_other_way_round(tmp_path):
    for kind, there in (("file", Path.mkdir), ("folder", Path.touch)):
        path = Cache(tmp_path).path(kind, ".x")
        there(path)
        Cache(tmp_path).get(kind, ".x", lambda path, kind=kind: _entry(path, kind))
        assert Cache(tmp_path).has(kind, ".x")
        assert path.is_dir() == (kind == "folder")


def test_a_seal_is_of_its_own_entry(tmp_path):
    store = Cache(tmp_path)
    for key, text in (("a", "1"), ("b", "2")):
        store.get(key, ".txt", lambda path, text=text: path.write_text(text))
    for name in ("b.txt", "b.txt.sha256"):
        (tmp_path / name.replace("b", "a", 1)).write_bytes((tmp_path / name).read_bytes())
    assert not Cache(tmp_path).has("a", ".txt")
    (tmp_path / "b.txt.sha256").write_bytes(b"\xff\x00")
    assert not Cache(tmp_path).has("b", ".txt")


def test_what_code_made_that_changed_meanwhile_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("btfref.provenance.code.changed", lambda: [tmp_path])
    store = Cache(tmp_path)
    store.get("key", ".txt", lambda path: path.write_text("1"))
    assert store.has("key", ".txt")  # it serves who made it
    assert not Cache(tmp_path).has("key", ".txt")


def test_another_browser_makes_other_keys(tmp_path, monkeypatch):
    """What WebGL 2 decided with one version, or without a browser, is not what it decides with another."""
    monkeypatch.setattr("btfref.rendering.gl.device.context", lambda: None)
    monkeypatch.setattr("btfref.rendering.gl.device.facts", lambda _: {})
    program, told = tmp_path / "chromium", []
    for version in (None, "156.0", "157.0"):
        if version is not None:
            program.write_text(f"#!/bin/sh\necho Chromium {version}\n")
            program.chmod(0o755)
        there = None if version is None else str(program)
        monkeypatch.setattr("btfref.validate.stages.drawn.chromium", lambda there=there: there)
        monkeypatch.setattr(drawn, "_told", [])
        told.append(drawn.code_of("btfref.validate.cell"))
    assert len(set(told)) == 3
    assert drawn.driver().endswith("Chromium 157.0")
