"""Files of pictures say what they show, and comparisons what differs."""

import json

import numpy as np
import pytest

from btfref.cli import main
from btfref.images import save_image
from btfref.registry import method
from btfref.rendering import RenderResult
from btfref.rendering.picture import (
    ALWAYS,
    ATTRIBUTE,
    attributes,
    differences,
    picture_facts,
    read_picture_facts,
)
from btfref.representations import save
from btfref.scene.facts import scene_facts, scene_files
from btfref.stress.data import bumpy

SIZE = (24, 24)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two representations of one BTF."""
    folder, btf = tmp_path_factory.mktemp("facts"), bumpy(shape=(4, 4))
    paths = {}
    for key in ("svd", "lpca"):
        paths[key] = folder / f"b.{key}.exr"
        save(method(key).fit(btf, components=2), paths[key])
    return paths


@pytest.fixture
def facts(files):
    """``facts(scene, key, meta, **parameters)`` of a picture."""

    def make(scene="sphere", key="svd", meta=None, size=SIZE, **parameters):
        settings = {"renderer": "mitsuba", "grid": 4, "shadows": False} | (meta or {})
        result = RenderResult(np.zeros((*SIZE, 3), np.float32), None, settings)
        given = {"btf": str(files[key]), "lights": "points2", **parameters}
        return picture_facts(result, scene, parameters=given, size=size)

    return make


def test_facts_are_complete(facts):
    found = facts()
    expected = {"scene", "parameters", "lights", "camera", "representation", "versions", *ALWAYS}
    assert expected <= found.keys()
    assert [light["type"] for light in found["lights"]] == ["point", "point"]
    assert len(found["lights"][0]["position"]) == 3
    assert found["camera"]["film"]["width"] == SIZE[0]
    assert np.shape(found["camera"]["to_world"]) == (4, 4)
    assert found["representation"][0]["method"] == "svd"
    assert len(found["representation"][0]["hash"]) == 16
    assert found["versions"]["mitsuba"]
    assert json.loads(json.dumps(found)) == found


def test_facts_come_back_from_the_file(facts, tmp_path, capsys):
    found = facts(meta={"seed": 3, "spp": 16})
    save_image(tmp_path / "a.exr", np.ones((*SIZE, 3)), attributes=attributes(found))
    assert read_picture_facts(tmp_path / "a.exr") == found
    assert main(["info", str(tmp_path / "a.exr"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["picture"] == found
    assert main(["info", str(tmp_path / "a.exr")]) == 0
    text = capsys.readouterr().out
    for word in ("sphere", "points2", "position", "to_world", "svd", "mitsuba", "seed", "grid"):
        assert word in text


@pytest.mark.parametrize("text", [None, "", "no JSON", "[1, 2]"])
def test_a_file_that_says_nothing_is_no_failure(tmp_path, text):
    path = tmp_path / "a.exr"
    save_image(path, np.ones((*SIZE, 3)), attributes={} if text is None else {ATTRIBUTE: text})
    assert read_picture_facts(path) is None
    assert main(["info", str(path)]) == 0
    assert main(["compare", str(path), str(path), "--gate", "image.own"]) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"meta": {"grid": 2}}, "grid 4 against 2"),
        ({"meta": {"shadows": True}}, "shadows in the reference alone"),
        ({"lights": "directional3"}, "lights 2 point against 3 directional"),
        ({"key": "lpca"}, "representation svd"),
        ({"tiling": "3"}, "tiling none against 3"),
        ({"scene": "plane"}, "scene sphere against plane"),
        ({"scene": "plane"}, "another camera"),
        ({"size": (48, 24)}, "size 24 × 24 against 48 × 24"),
    ],
)
def test_what_differs_is_told_first(facts, tmp_path, capsys, change, words):
    ours, theirs = facts(), facts(**change)
    assert any(clause.startswith(words) for clause in differences(ours, theirs))
    for name, found in (("a", ours), ("b", theirs)):
        save_image(tmp_path / f"{name}.exr", np.ones((*SIZE, 3)), attributes=attributes(found))
    main(["compare", str(tmp_path / "a.exr"), str(tmp_path / "b.exr")])
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("differs: ")
    assert words in first
    main(["compare", str(tmp_path / "a.exr"), str(tmp_path / "b.exr"), "--json"])
    assert json.loads(capsys.readouterr().out)["differs"] == differences(ours, theirs)


def test_renderers_and_random_numbers_are_no_difference(facts):
    other = facts(meta={"renderer": "realtime", "seed": 5, "gl_renderer": "a card"})
    assert differences(facts(), other) == []


def test_other_lights_of_the_same_kinds_are_told(facts):
    other = facts()
    other["lights"][0]["position"] = [0.0, 0.0, 9.0]
    assert differences(facts(), other) == ["other 2 point lights"]


def test_files_of_a_scene(tmp_path):
    (tmp_path / "lights.xml").write_text(
        '<scene><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    )
    (tmp_path / "scene.xml").write_text(
        '<scene><default name="mesh" value="a.ply"/><include filename="lights.xml"/>'
        '<shape type="ply"><string name="filename" value="$mesh"/></shape></scene>'
    )
    for name in ("sky.exr", "a.ply", "b.ply", "other.ply"):
        (tmp_path / name).write_bytes(name.encode())
    found = {path.name for path in scene_files(tmp_path / "scene.xml")}
    assert found == {"scene.xml", "lights.xml", "sky.exr", "a.ply"}
    found = {path.name for path in scene_files(tmp_path / "scene.xml", {"mesh": "b.ply"})}
    assert found == {"scene.xml", "lights.xml", "sky.exr", "b.ply"}
    before = scene_facts(tmp_path / "scene.xml")
    for name in ("sky.exr", "a.ply", "lights.xml"):
        text = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(text + b" ")
        assert scene_facts(tmp_path / "scene.xml") != before
        (tmp_path / name).write_bytes(text)
    (tmp_path / "other.ply").write_bytes(b"")
    assert scene_facts(tmp_path / "scene.xml") == before
