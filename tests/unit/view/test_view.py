"""The page of `btfref view` as a file: what is in it, what it is of, and the server."""

import base64
import http.client
import json
import re
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.cli import main
from btfref.commands.view import _names
from btfref.errors import InputError
from btfref.view import Material, build_page, mesh_shape, packing, sampled, shipped_shapes, write_page
from btfref.view.packing import Packed
from btfref.view.page import SCRIPTS
from btfref.view.server import LOOPBACK, PageServer


def data_of(html):
    """The page's data, and its tables by name."""
    data = json.loads(re.search(r'id="data">(.*?)</script>', html, re.S)[1])
    tables = dict(re.findall(r'<script type="text/plain" id="([\w-]+)">(.*?)</script>', html))
    return data, tables


def unpacked(packed, tables):
    planes = np.frombuffer(zlib.decompress(base64.b64decode(tables[packed["blob"]])), np.uint8)
    width = np.dtype(packed["type"]).itemsize
    return np.ascontiguousarray(planes.reshape(width, -1).T).view(packed["type"]).ravel()


def test_the_page_stands_alone_and_holds_the_tables(fits):
    rep, shapes = fits("rf_poly"), shipped_shapes()
    html = build_page([Material("<a>.exr", rep, ["fact  </script>"], "a note")], shapes, title="<a>")
    assert "<title>&lt;a&gt;</title>" in html
    assert re.findall(r'\b(?:src|href)="(?!data:)[^"]*"|https?://', html) == []
    data, tables = data_of(html)
    (material,) = data["materials"]
    assert (material["name"], material["note"], material["facts"]) == (
        "<a>.exr",
        "a note",
        ["fact  </script>"],
    )
    assert material["shaders"]["fragment"].startswith("#version 300 es\n")
    ours = rep.port_arrays()
    for texture in material["textures"]:
        values, table = unpacked(texture, tables), ours[texture["name"]].ravel()
        np.testing.assert_array_equal(values[: table.size], table)
        assert not values[table.size :].any()
    assert [shape["name"] for shape in data["shapes"]] == ["plane", "sphere", "cloth"]
    for shape in data["shapes"]:
        assert unpacked(shape["triangles"], tables).size == shape["count"] * 32


def test_every_script_is_in_the_page():
    folder = Path(packing.__file__).parent / "assets"
    assert sorted(SCRIPTS) == sorted(path.stem for path in folder.glob("*.js"))


@pytest.mark.parametrize("kind", ["float16", "float32", "uint32", "uint8"])
def test_packing_loses_nothing(rng, kind):
    values = rng.integers(0, 200, 97).astype(kind)
    packed = Packed()
    np.testing.assert_array_equal(unpacked(packed.add(values), packed.blobs), values)


def test_what_a_page_cannot_hold_is_refused(monkeypatch, fits):
    monkeypatch.setattr(packing, "LARGEST", 1000)
    with pytest.raises(InputError, match="too much for a page"):
        build_page([Material("a", fits("rf_poly"))], shipped_shapes())
    with pytest.raises(InputError, match="nothing to show"):
        build_page([], shipped_shapes())


def test_the_page_is_an_html_file(fits, tmp_path):
    with pytest.raises(InputError, match=r"\.html"):
        write_page(tmp_path / "page.txt", [Material("a", fits("rf_poly"))], shipped_shapes())
    assert list(tmp_path.iterdir()) == []


# --- shapes -------------------------------------------------------------------------------------------------------


def test_meshes_of_ours(tmp_path):
    """Two pieces, one without normals; a triangle without area; y up in glTF."""
    import trimesh

    path = tmp_path / "two.glb"
    boxes = [trimesh.creation.box().apply_translation([0, height, 0]) for height in (0, 3)]
    for box in boxes:
        box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2])
    trimesh.Scene(boxes).export(path)
    shape = mesh_shape(path)
    assert shape.name == "two.glb"
    assert len(shape.mesh.faces) == 24
    assert np.ptp(shape.mesh.positions, axis=0).tolist() == [1.0, 1.0, 4.0]
    np.testing.assert_array_equal(
        shape.target, (shape.mesh.positions.min(0) + shape.mesh.positions.max(0)) / 2
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no texture coordinates"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n", "no triangle with an area"),
    ],
)
def test_meshes_that_show_nothing(tmp_path, text, said):
    path = tmp_path / "mesh.obj"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        mesh_shape(path)


# --- what is shown of what ----------------------------------------------------------------------------------------


def test_sampled_btfs_say_how_they_are_shown(tmp_path, monkeypatch):
    path = tmp_path / "a.btf.zarr"
    oracle_btf((4, 3), "2x4", "2x4").save(path)
    shown, note = sampled.quick_representation(path)
    assert shown.meta["method"] == "raw"
    assert "as it is" in note
    monkeypatch.setattr(sampled, "AS_IT_IS", 100)
    shown, note = sampled.quick_representation(path)
    assert shown.meta["method"] == "lpca"
    assert "quick compression" in note
    assert re.search(r"error [\d.e-]+ %", note)


def test_files_are_named_as_short_as_they_differ(tmp_path):
    assert _names(["a/x.exr", "a/y.exr"]) == ["x.exr", "y.exr"]
    assert _names(["a/x.exr", "b/x.exr"]) == ["a/x.exr", "b/x.exr"]
    assert _names(["a/x.exr", "a/x.exr"]) == ["x.exr", "x.exr (2)"]


def test_the_command_writes_a_page_and_says_the_note(tmp_path, capsys):
    store, page = tmp_path / "a.btf.zarr", tmp_path / "page.html"
    oracle_btf((4, 3), "2x4", "2x4").save(store)
    assert main(["view", str(store), "-o", str(page)]) == 0
    said = capsys.readouterr().out
    assert "shown as it is" in said
    data, _ = data_of(page.read_text("utf-8"))
    assert "shown as it is" in data["materials"][0]["note"]
    assert any(line.startswith("kind") and "sampled-btf" in line for line in data["materials"][0]["facts"])


# --- the server ---------------------------------------------------------------------------------------------------


def asked(server, path="/", host=None):
    connection = http.client.HTTPConnection(*server.server_address, timeout=30)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    return answer.status, answer.read().decode("utf-8")


def test_the_server_has_one_page_for_this_machine():
    with PageServer("<p>é</p>") as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            assert server.server_address[0] == LOOPBACK
            assert server.url == f"http://{LOOPBACK}:{server.server_address[1]}/"
            assert asked(server) == (200, "<p>é</p>")
            assert asked(server, "/etc/passwd")[0] == 404
            # A name of others that points here.
            assert asked(server, host="example.org")[0] == 404
        finally:
            server.shutdown()


def test_without_a_page_to_write_the_browser_is_opened(fits, monkeypatch, capsys):
    opened = []

    def stop(server):
        opened.append(asked_in_thread(server))
        raise KeyboardInterrupt

    def asked_in_thread(server):
        threading.Thread(target=server.handle_request, daemon=True).start()
        return asked(server)

    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    monkeypatch.setattr(PageServer, "serve_forever", stop)
    assert main(["view", str(fits.path("rf_poly"))]) == 0
    url, (status, html) = opened
    assert url in capsys.readouterr().out
    assert status == 200
    assert data_of(html)[0]["materials"][0]["name"] == fits.path("rf_poly").name


def test_a_port_that_is_taken(fits, capsys):
    with PageServer("") as server:
        port = server.server_address[1]
        assert main(["view", str(fits.path("rf_poly")), "--no-browser", "--port", str(port)]) == 2
    assert f"got {port} (" in capsys.readouterr().err
