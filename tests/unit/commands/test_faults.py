"""What may go wrong with a command is one line and an exit status of the contract; the table of it is documentation."""

import contextlib
import gc
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import faults
import numpy as np
import pytest

from btfref import registry
from btfref.cli import main
from btfref.images import save_image
from btfref.representations.file.container import save
from btfref.representations.tabulated import raw
from btfref.sampling import SampledBTF

ROOT = Path(__file__).parents[3]

SCENE = """<scene version="3.0.0">
  <default name="btf" value="good.exr"/>
  <integrator type="direct"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>
  </sensor>
  <shape type="rectangle"><bsdf type="btf"><string name="filename" value="$btf"/></bsdf></shape>
  <emitter type="directional"><vector name="direction" value="0,0,-1"/></emitter>
</scene>
"""


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """A folder with a good store, representation, picture and scene."""
    folder = tmp_path_factory.mktemp("faults")
    values = np.full((8, 8, 2, 2, 3), 0.25, np.float32)
    SampledBTF(values, _grid(), _grid(), None, {}).save(folder / "good.btf.zarr")
    save(raw.fit(SampledBTF.load(folder / "good.btf.zarr")), folder / "good.exr")
    save_image(folder / "image.exr", np.ones((4, 4, 3)))
    (folder / "good.xml").write_text(SCENE)
    return folder


def _grid():
    """Eight directions that are on no rings, so that files have triangles and cells."""
    from btfref.numerics.sphere.directions import directions

    vectors = directions("2x4").vectors.copy()
    x, y, _ = vectors[5]
    vectors[5, :2] = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y
    return directions(vectors)


def test_the_table_of_faults(material, tmp_path, monkeypatch, capfd, need):
    """Every row; all in one test, since the table is of all of them."""
    need("llvm")
    need("gl")
    found = []
    for number, row in enumerate(faults.ROWS):
        folder = tmp_path / str(number)
        shutil.copytree(material, folder)
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            row.prepare(folder, patch)
            before = sorted(path.name for path in folder.iterdir())
            capfd.readouterr()
            status = main(row.command.split())
            if held := getattr(patch, "held", None):
                held.close()
        for cached in (registry.points.usable_points, registry.methods, registry._all_methods):
            cached.cache_clear()
        said = capfd.readouterr()
        told = f"{row.command} ({row.fault}): {status}, {said.out!r}, {said.err!r}"
        assert status == row.status, told
        assert said.err.startswith("btfref: error: "), told
        assert said.err.count("\n") == 1, told
        assert said.out == "", told
        assert len(said.err) < 1000, told
        for word in row.words:
            assert word in said.err, told
        assert sorted(
            path.name for path in folder.iterdir() if path.name != "busy.btf.zarr.lock.partial"
        ) == [name for name in before if name != "busy.btf.zarr.lock.partial"], told
        found.append((row, status, faults.plain(said.err, folder)))
        gc.collect()
    page, made = ROOT / faults.PAGE, faults.page(found)
    if os.environ.get("BTFREF_WRITE_PAGES"):
        page.write_text(made, "utf-8")
    assert page.read_text("utf-8") == made


def run(*command, **options):
    """A command in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("env", {})}
    return subprocess.run(
        [sys.executable, *options.pop("python", ()), "-m", "btfref", *command],
        stdout=options.pop("stdout", subprocess.PIPE),
        stderr=subprocess.PIPE,
        env=environment,
        **options,
    )


def test_streams_of_all_kinds(material):
    """Standard output that is closed, full, or of another code; no docstrings; a place for details that is none."""
    info = ("info", "image.exr")
    assert run(*info, cwd=material, python=("-OO",)).returncode == 0
    ascii_only = run("info", "good.exr", cwd=material, env={"PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
    assert ascii_only.returncode == 0, ascii_only.stderr
    with open("/dev/full", "w") as stream:
        full = run(*info, cwd=material, stdout=stream)
    assert (full.returncode, full.stderr.count(b"\n")) == (2, 1), full.stderr
    closed = subprocess.run(
        ["/bin/sh", "-c", f"{sys.executable} -m btfref info image.exr >&-"],
        cwd=material,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert (closed.returncode, closed.stderr.count(b"\n")) == (2, 1), closed.stderr
    assert b"closed" in closed.stderr


def test_a_full_place(material, tmp_path, need):
    """The system refuses to write more: one line that says so, and no word of damage; nothing is left."""
    need("llvm")
    store = material / "good.btf.zarr"
    for command in (
        f"fit raw {store} -o out.exr",
        "synth flat -o out.btf.zarr --texels 16 --spp 2",
    ):
        done = subprocess.run(
            ["/bin/bash", "-c", f"ulimit -f 1; exec {sys.executable} -m btfref {command}"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert done.stderr.startswith("btfref: error: out"), done.stderr
        assert "File too large" in done.stderr
        assert list(tmp_path.iterdir()) == []


def test_a_terminated_command_leaves_nothing(tmp_path, need):
    """SIGTERM ends a synthesis with its own status, and its lock with it."""
    need("llvm")
    out = tmp_path / "x.btf.zarr"
    command = ["synth", "checker", "-o", str(out), "--texels", "64", "--spp", "4096", "--views", "3x4"]
    command += ["--estimator", "path"]
    child = subprocess.Popen(
        [sys.executable, "-m", "btfref", *command],
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    while not out.exists() and child.poll() is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(0.1)
    child.send_signal(signal.SIGTERM)
    _, said = child.communicate()
    assert (child.returncode, said) == (143, b"btfref: error: terminated\n")
    assert [path.name for path in tmp_path.iterdir()] == ["x.btf.zarr"]


def test_what_a_terminal_would_obey_is_written_out(material, tmp_path, monkeypatch, capsys):
    """Names in a file move no cursor and turn no text."""
    from btfref.representations.file.container import load

    good = load(material / "good.exr")
    hostile = "\x1b]0;owned\x07 \x9b2J \u202egnp"
    meta = good.meta | {"parent": {"name": hostile}, "views": good.meta["views"] | {"name": hostile}}
    save(type(good)(good.arrays(), meta), tmp_path / "hostile.exr")
    monkeypatch.chdir(tmp_path)
    for extra in ((), ("--json",)):
        assert main(["info", "hostile.exr", *extra]) == 0
        said = capsys.readouterr().out
        assert "owned" in said
        assert not set(said) & {"\x1b", "\x07", "\x9b", "\u202e"}
    assert main(["info", "\x1b[31mred.exr"]) == 2
    assert "\x1b" not in capsys.readouterr().err
