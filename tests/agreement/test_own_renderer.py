"""Other people's renderers: a picture against the reference of a scene, on the command line and in a test suite."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from schemas import assert_follows_schema

from btfref.cli import main
from btfref.errors import InputError
from btfref.images import save_image
from btfref.images.files import load_image
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.picture import attributes
from btfref.scene.shipped import scene_file
from btfref.testing import assert_matches_reference
from btfref.validate.own_renderer import Reference, judge_image, reference_of, representation_for

pytestmark = pytest.mark.usefixtures("renderers")

SIZE = (48, 48)


@pytest.fixture(scope="module")
def theirs(fits, tmp_path_factory):
    """A picture by a renderer that is not the reference's, in a file, the representation, and a cache."""
    folder = tmp_path_factory.mktemp("theirs")
    parameters = {"btf": str(fits.path("lpca")), "lights": "points2"}
    image = realtime(scene_file("sphere"), parameters=parameters, size=SIZE, shadows=False).image
    save_image(folder / "my.exr", image)
    save_image(folder / "wrong.exr", image[::-1].copy())
    shown = np.clip(image, 0, 1)
    from btfref.comparison import Display

    save_image(folder / "my.png", shown, display=Display())
    return folder, fits.path("lpca"), folder / "cache"


def compare_command(folder, name, path, cache, *more):
    command = ["compare", str(folder / name), "sphere", "--method", str(path), "-D", "lights=points2"]
    return main([*command, "--cache", str(cache), *more])


def test_command_line(theirs, capsys):
    folder, path, cache = theirs
    assert compare_command(folder, "my.exr", path, cache, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert_follows_schema(data)
    assert {"image.noise_free.p999", "image.silhouette.relative_l2"} <= {
        gate["name"] for gate in data["gates"]
    }
    # Eight bits are judged by gates of their own, and a picture upside down by none of them passes.
    assert compare_command(folder, "my.png", path, cache) == 0
    judged = [line.split()[0] for line in capsys.readouterr().out.splitlines() if " ≤ " in line]
    assert {"image.eight_bit", "image.eight_bit_silhouette"} <= set(judged)
    assert compare_command(folder, "wrong.exr", path, cache, "--report", str(folder / "r.html")) == 1
    assert "FAIL" in capsys.readouterr().out
    assert (folder / "r.html").exists()
    assert len(list(Path(cache).glob("*.reference.npz"))) == 1


def test_bad_input_is_one_line(theirs, capsys):
    folder, path, cache = theirs
    assert main(["compare", str(folder / "my.exr"), "moon"]) == 2
    assert main(["compare", str(folder / "my.exr"), "sphere", "--method", "lpca"]) == 2
    assert main(["compare", str(folder / "my.exr"), str(folder / "my.exr"), "--method", "lpca"]) == 2
    assert compare_command(folder, "my.exr", path, cache, "--size", "40x40") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 4
    assert "40x40" in lines[3]


def test_codes_taken_for_radiance_are_caught(theirs):
    folder, path, cache = theirs
    from btfref.numerics.colour import encode_srgb

    wrong = encode_srgb(load_image(folder / "my.png"))
    save_image(folder / "coded.png", np.clip(wrong, 0, 1))
    with pytest.raises(AssertionError, match=r"image\.eight_bit"):
        assert_matches_reference(folder / "coded.png", "sphere", btf=path, lights="points2", cache=cache)


def test_a_method_is_fitted_once(fits, tmp_path):
    fits.btf().save(tmp_path / "formula.btf.zarr")
    first = representation_for("svd", tmp_path / "formula.btf.zarr", cache=tmp_path / "cache")
    stamp = first.stat().st_mtime_ns
    assert representation_for("svd", tmp_path / "formula.btf.zarr", cache=tmp_path / "cache") == first
    assert first.stat().st_mtime_ns == stamp
    with pytest.raises(InputError, match="BTF"):
        representation_for("svd")


def test_references_follow_their_files(theirs, fits):
    _, path, cache = theirs
    shared = {"size": (16, 16), "grid": 1, "cache": cache}
    first = reference_of("plane", parameters={"btf": str(path)}, **shared)
    again = reference_of("plane", parameters={"btf": str(path)}, **shared)
    other = reference_of("plane", parameters={"btf": str(fits.path("svd"))}, **shared)
    assert (first.cached, again.cached, other.cached) == (False, True, False)
    np.testing.assert_array_equal(first.image, again.image)
    assert (first.image != other.image).any()


def test_a_noisy_reference_is_judged_by_equivalence(rng):
    image = rng.random((20, 20, 3)).astype(np.float32)
    variance = np.full_like(image, 1e-4)
    reference = Reference(image, np.ones((20, 20), np.uint8), variance)
    right = judge_image(image + 1e-2 * rng.normal(size=image.shape).astype(np.float32), reference)
    assert right.passed
    wrong = judge_image(1.1 * image, reference)
    assert not wrong.passed
    assert wrong.gates[-1].gate == "image.equivalence"


PROJECT = """
from btfref.testing import assert_matches_reference
from btfref.images import load_image

SCENE = dict(btf={path!r}, lights="points2", cache={cache!r})

def test_mine(matches_reference):
    matches_reference({mine!r}, "sphere", **SCENE)

def test_array():
    found = assert_matches_reference(load_image({mine!r}), "sphere", **SCENE)
    assert found.passed

def test_wrong(matches_reference):
    matches_reference({wrong!r}, "sphere", **SCENE)
"""


def test_in_the_test_suite_of_another_project(theirs, tmp_path):
    folder, path, cache = theirs
    names = {"mine": folder / "my.exr", "wrong": folder / "wrong.exr", "path": path, "cache": cache}
    (tmp_path / "test_theirs.py").write_text(PROJECT.format(**{key: str(v) for key, v in names.items()}))
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-m", "pytest", "-q", "-p", "btfref.pytest_plugin", "--btfref-report", "pages"]
    environment = {**os.environ, "PYTHONPATH": root, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=200, check=False
    )
    assert "1 failed, 2 passed" in done.stdout, done.stdout + done.stderr
    assert "image.noise_free.p999" in done.stdout
    assert len(list((tmp_path / "pages").glob("test_wrong.*.html"))) == 1


def test_a_picture_without_shadows_under_a_sky(fits, tmp_path):
    """A square hangs over another: direct light without shadows passes, and fails where the file says it has them."""
    shared = "<bsdf type='btf'><string name='filename' value='{}'/></bsdf>".format(fits.path("lpca"))
    scene = tmp_path / "roof.xml"
    scene.write_text(f"""<scene version="3.0.0"><integrator type="path"/>
        <sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
            <lookat origin="0,-3,2" target="0,0,0" up="0,0,1"/></transform>
            <film type="hdrfilm"><integer name="width" value="20"/><integer name="height" value="20"/></film></sensor>
        <emitter type="constant"/><shape type="rectangle">{shared}</shape>
        <shape type="rectangle"><transform name="to_world"><scale value="0.5"/><translate z="0.3"/></transform>{shared}
        </shape></scene>""")
    result = realtime(scene, grid=2)
    for shadows in (False, True):
        facts = {"renderer": "realtime", "grid": 2, "shadows": shadows}
        save_image(tmp_path / f"{shadows}.exr", result.image, attributes=attributes(facts))
    kept = {"cache": tmp_path / "cache"}
    assert assert_matches_reference(tmp_path / "False.exr", scene, **kept).passed
    with pytest.raises(AssertionError, match=r"image\.equivalence"):
        assert_matches_reference(tmp_path / "True.exr", scene, **kept)
