"""Port packages: each method's folder answers its questions in Chromium and in desktop OpenGL, without btfref."""

import dataclasses
import json
import os
import re
import struct
import subprocess
import sys

import numpy as np
import pytest

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.registry import methods
from btfref.rendering.gl import composer, device
from btfref.rendering.ports.ktx2 import IDENTIFIER
from btfref.rendering.ports.package import MOST_SAMPLERS, port_package
from btfref.rendering.web import chromium
from btfref.stress.known_answers import export_port, known_answers

N_PROBES = 100

#: Programs of the folders, one after the other in one process: numpy and moderngl, and nothing of ours.
CHECKS = """
import pathlib, runpy, sys
for folder in sys.argv[1:]:
    try:
        runpy.run_path(str(pathlib.Path(folder, "check.py")), run_name="__main__")
    except SystemExit as end:
        print(pathlib.Path(folder).name, end.code)
assert not {"btfref", "mitsuba", "mitsuba_plugins"} & set(sys.modules)
"""


@pytest.fixture(scope="module")
def folders(fits, tmp_path_factory):
    """A folder of each method."""
    root = tmp_path_factory.mktemp("ports")
    for key in methods():
        export_port(fits.path(key), root / key, n=N_PROBES)
    return root


def checked(*paths):
    """What check.py says of folders, and its exit status, by the folder's name."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-I", "-c", CHECKS, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd="/")
    lines = done.stdout.splitlines()
    return {
        end.split()[0]: (int(end.split()[1]), said) for said, end in zip(lines[::2], lines[1::2], strict=True)
    }


def test_numpy_and_moderngl_alone_reproduce_the_answers_of_every_method(folders, need):
    need("gl")
    found = checked(*folders.iterdir())
    assert set(found) == set(methods())
    for key, (status, said) in found.items():
        assert status == 0, f"{key}: {said}"
        assert f"{N_PROBES} lookups" in said


#: Compiled at every run; the others, which ask nothing else of a compiler, at long ones. The Laplacian pyramid has
#: arrays of constants, the network matrices.
ALWAYS = ("laplacian", "neural")


def webgpu(script, variables, *arguments):
    """What a folder's program for WebGPU says, and its exit status."""
    command = [sys.executable, str(script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | variables)
    assert done.returncode in (0, 1), done.stderr
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    "key", [*ALWAYS, *(pytest.param(key, marks=pytest.mark.long) for key in methods() if key not in ALWAYS)]
)
def test_webgpu_reproduces_the_answers(folders, need, key):
    variables = need("wgpu")
    status, said = webgpu(folders / key / "check_wgpu.py", variables)
    assert status == 0, said
    assert f"{N_PROBES} lookups" in said


def test_webgpu_is_asked_for_other_texts_and_says_when_they_are_wrong(folders, need, tmp_path):
    variables, script = need("wgpu"), folders / "rf_poly" / "check_wgpu.py"
    text = tmp_path / "btf.comp"
    assert webgpu(script, variables, "--write", text) == (0, "")
    right = text.read_text()
    text.write_text(right.replace("= value.x;", "= value.y;"))
    assert text.read_text() != right
    status, said = webgpu(script, variables, text)
    assert status == 1
    assert "DOES NOT AGREE" in said


@pytest.mark.parametrize("key", methods())
def test_the_page_of_the_folder_reproduces_them_in_chromium(folders, need, key):
    need("chromium")
    with chromium.shared().page((folders / key / "index.html").as_uri()) as page:
        result = page.evaluate("result")
        assert page.complaints() == []
        assert page.evaluate("document.getElementById('verdict').textContent").startswith(
            "Agrees: worst error "
        )
    assert result["agrees"], result
    assert result["lookups"] == N_PROBES
    assert "SwiftShader" in result["renderer"]


def test_a_damaged_texture_is_found_by_both(folders, fits, tmp_path, need):
    need("gl")
    need("chromium")
    package = port_package(fits("svd"))
    weights = next(texture for texture in package.textures if texture.name == "weights")
    damaged = weights.table.values.copy()
    damaged[:8] *= 2
    table = dataclasses.replace(weights.table, values=damaged)
    textures = tuple(
        dataclasses.replace(texture, table=table) if texture is weights else texture
        for texture in package.textures
    )
    from btfref.rendering.ports.folder import write_folder

    answers = known_answers(fits("svd"), N_PROBES)
    write_folder(dataclasses.replace(package, textures=textures), answers, tmp_path / "damaged")
    status, said = checked(tmp_path / "damaged")["damaged"]
    assert status == 1
    assert "DOES NOT AGREE" in said
    with chromium.shared().page((tmp_path / "damaged" / "index.html").as_uri()) as page:
        assert page.evaluate("result.agrees") is False
        assert "DOES NOT AGREE" in page.evaluate("document.body.textContent")


def test_without_webgl_the_page_says_so(folders, need):
    need("chromium")
    with chromium.shared().page() as page:
        broken = "HTMLCanvasElement.prototype.getContext = () => null"
        page.send("Page.addScriptToEvaluateOnNewDocument", {"source": broken})
        page.go((folders / "rf_poly" / "index.html").as_uri())
        verdict = page.evaluate("document.getElementById('verdict').textContent")
    assert verdict == "Failed: no WebGL 2 in this browser"


@pytest.mark.parametrize("key", methods())
def test_the_layout_says_what_the_files_hold(folders, fits, key):
    folder = folders / key
    layout = json.loads((folder / "layout.json").read_text())
    text = (folder / "btf.glsl").read_text()
    assert layout["method"] == key
    assert "#include" not in text
    assert "#line" not in text
    assert "#version" not in text
    arrays = fits(key).port_arrays()
    for entry in layout["textures"]:
        data, image = ((folder / entry["file"]).with_suffix(end).read_bytes() for end in (".bin", ".ktx2"))
        texel = {"RGBA8": 4, "RGBA16F": 8, "RGBA32F": 16, "RGBA32UI": 16}[entry["internal_format"]]
        assert len(data) == entry["bytes"] == entry["width"] * entry["height"] * entry["layers"] * texel
        # The table comes first, then zeros.
        whole = arrays[entry["name"]].tobytes()
        assert data[: len(whole)] == whole
        assert not any(data[len(whole) :])
        assert image.startswith(IDENTIFIER)
        size = struct.unpack_from("<9I", image, 12)
        assert size[2:8] == (entry["width"], entry["height"], 0, entry["layers"], 1, 1)
        first, length, plain = struct.unpack_from("<3Q", image, 80)
        assert first % texel == 0
        assert length == plain == len(data)
        assert image[first:] == data
    declared = set(re.findall(r"^uniform \w+ (\w+);", text, re.MULTILINE))
    assert {entry["name"] for entry in layout["textures"]} <= declared
    probes = json.loads((folder / "probes.json").read_text())
    rows = np.array(probes["lookups"])
    assert (rows == rows.astype(np.float32)).all()
    below = (rows[:, [4, 7]] < 0).any(1)
    assert below.any()
    assert (np.array(probes["values"])[below] == 0).all()


@pytest.mark.parametrize("version", composer.VERSIONS)
@pytest.mark.parametrize("key", methods())
def test_glslang_accepts_the_text_with_all_its_functions(fits, need, tmp_path, key, version):
    validator = need("glslang")
    main_text = """
    in vec2 uv;
    in vec3 w_light, w_view;
    out vec4 value;
    void main() {
        mat3 to_local = shading_frame(vec3(0.0, 0.0, 1.0), vec3(1.0, 0.0, 0.0), vec3(0.0, 0.0, 1.0));
        float lod = btf_lod(dFdx(uv), dFdy(uv));
        value = vec4(btf_eval(uv, to_local * w_light, to_local * w_view, lod), malformed(uv, w_light, w_view).x);
    }
    """
    path = tmp_path / "host.frag"
    path.write_text(port_package(fits(key)).source(version, main_text), encoding="utf-8")
    done = subprocess.run([validator, str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_embedded_package_is_the_folder(folders, fits):
    embedded = port_package(fits("lpca")).embedded()
    assert embedded["shader"]["text"] == (folders / "lpca" / "btf.glsl").read_text()
    assert json.loads(json.dumps(embedded)) == embedded
    assert all("base64" in entry for entry in embedded["textures"])


def test_what_no_device_need_hold_is_refused(fits, monkeypatch):
    rep = fits("raw")
    monkeypatch.setattr("btfref.rendering.ports.package.MOST_SAMPLERS", 2)
    with pytest.raises(InputError, match="more textures than a stage"):
        port_package(rep)
    monkeypatch.setattr("btfref.rendering.ports.package.MOST_SAMPLERS", MOST_SAMPLERS)
    large = device.FoldedTable(4096, 4096, 257, np.zeros(4, np.float16))
    monkeypatch.setattr(device, "folded", lambda array, name: large)
    with pytest.raises(InputError, match=r"too large for a port.*257 layers"):
        port_package(rep)


def test_answers_that_hang_on_rounding_are_left_out(fits):
    """A method that jumps: all its answers hold for arguments that are off by their rounding."""
    rep = dataclasses.replace(fits("raw"), meta=fits("raw").meta | {"filter_type": "nearest"})
    found = known_answers(rep, 60, seed=3)
    assert len(found.rows) == len(found.values) == 60
    size = np.abs(found.values).max(-1)
    scale = np.maximum(size, tolerance("probe.agreement.floor") * size.max())
    for towards in (-np.inf, np.inf):
        uv = np.nextafter(found.rows[:, :2].astype(np.float32), np.float32(towards)).astype(float)
        moved = rep.evaluate(uv, found.rows[:, 2:5], found.rows[:, 5:8])
        assert (np.abs(moved - found.values).max(-1) <= tolerance("probe.agreement.max") * scale).all()

    class Jumping:
        meta = rep.meta

        def arrays(self):
            return rep.arrays()

        def evaluate(self, uv, w_light, w_view, *, lod=0.0):
            return 1.0 + (np.asarray(uv)[..., :1] * 1e7 % 2 > 1) * np.ones(3)

    with pytest.raises(InputError, match="no known answers"):
        known_answers(Jumping(), 50)


def test_the_command(fits, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("btfref.stress.known_answers.N_PROBES", 20)
    assert main(["export", str(fits.path("rf_poly")), "--format", "gl", "-o", "port", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["method"] == "rf_poly"
    assert facts["textures"] == 5
    assert {path.name for path in (tmp_path / "port").iterdir()} == {
        "README.md", "btf.glsl", "check.py", "check_wgpu.py", "index.html", "layout.json", "probes.json", "textures",
        "three",
    }  # fmt: skip
    for path in (tmp_path / "port").rglob("*"):
        assert path.is_dir() or path.suffix in (".bin", ".ktx2") or "{{" not in path.read_text()
