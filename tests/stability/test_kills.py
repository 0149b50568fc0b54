"""SIGKILL at random moments: the same command started again gives the same bytes, and nothing has to be removed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from oracle import oracle_btf
from stores import contents as store_contents

from btfref.formats import export_btf
from btfref.sampling import open_store

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("llvm")]

ROOT = Path(__file__).parents[2]
KILLS = 20


def child(*command):
    return subprocess.Popen(
        [sys.executable, "-m", "btfref", *map(str, command)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def contents(path):
    """Bytes of a file, or of all files of a folder by name."""
    if path.is_file():
        return path.read_bytes()
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kills")
    oracle_btf((32, 32)).save(folder / "good.btf.zarr")
    export_btf(open_store(folder / "good.btf.zarr"), folder / "pictures", "ubo", image="png")
    return folder


COMMANDS = {
    "import": lambda m, o: ("import", m / "pictures", "-o", o / "out.btf.zarr"),
    "export": lambda m, o: (
        "export",
        m / "good.btf.zarr",
        "-o",
        o / "out",
        "--format",
        "ubo",
        "--image",
        "png",
    ),
    "fit": lambda m, o: ("fit", "svd", m / "good.btf.zarr", "-o", o / "out.exr"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_end_with_the_same_bytes(material, tmp_path, name, rng):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir()
    broken.mkdir()
    started = os.times().elapsed
    assert child(*COMMANDS[name](material, whole)).wait() == 0
    longest = os.times().elapsed - started
    killed = 0
    for _ in range(10 * KILLS):
        started = os.times().elapsed
        process = child(*COMMANDS[name](material, broken))
        try:
            process.wait(rng.uniform(0.3, 1) * longest)
            longest = max(
                0.9 * longest, os.times().elapsed - started
            )  # what a slower machine took is no measure
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += process.wait() == -signal.SIGKILL
        out = next((p for p in broken.iterdir() if p.name.startswith("out")), None)
        whole_by_now = process.returncode == 0
        if name != "import" and out is not None:
            # It appears whole or not at all.
            assert contents(out) == contents(whole / out.name)
            whole_by_now = True
        if out is not None and whole_by_now:
            shutil.rmtree(out) if out.is_dir() else out.unlink()
        if killed == KILLS:
            break
    assert killed == KILLS
    assert child(*COMMANDS[name](material, broken)).wait() == 0
    assert sorted(p.name for p in broken.iterdir()) == sorted(p.name for p in whole.iterdir())
    for path in whole.iterdir():
        same = store_contents if path.name.endswith(".zarr") else contents
        assert same(broken / path.name) == same(path)


def test_a_reader_beside_a_killed_writer(material, tmp_path, rng):
    """What a reader gets is what was written, or a refusal: never half of it."""
    from btfref.errors import InputError

    out, whole = tmp_path / "out.btf.zarr", tmp_path / "whole.btf.zarr"
    assert child("import", material / "pictures", "-o", whole).wait() == 0
    expected = open_store(whole).read()[0]
    read = 0
    for _ in range(KILLS):
        if read and out.exists() and open_store(out).coverage.all():
            shutil.rmtree(out)
        process = child("import", material / "pictures", "-o", out)
        reads = rng.integers(1, 40)  # until the writer is killed
        while process.poll() is None and reads:
            if not out.exists():
                continue
            try:
                store = open_store(out)
                for view in np.flatnonzero(store.coverage.all(axis=(1, 2, 3)))[:3]:
                    assert np.array_equal(store.read(views=int(view))[0][0], expected[view])
                    read += 1
                reads -= 1
            except InputError:
                continue
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert read
    assert child("import", material / "pictures", "-o", out).wait() == 0
    assert store_contents(out) == store_contents(whole)


def test_a_killed_validation_goes_on(tmp_path, rng):
    """Results of a killed run are used; the result is that of a run of one go."""
    import json

    command = (
        "validate",
        "--quick",
        "--only",
        "raw,svd",
        "--mesostructure",
        "checker",
        "--no-report",
        "--workers",
        1,
    )
    for _ in range(KILLS):
        process = child(*command, "--cache", tmp_path / "broken")
        try:
            process.wait(rng.uniform(2, 20))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
    found = []
    for cache in ("broken", "whole"):
        done = subprocess.run(
            [sys.executable, "-m", "btfref", *map(str, command), "--json", "--cache", str(tmp_path / cache)],
            capture_output=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert done.returncode in (0, 1), done.stderr
        cells = json.loads(done.stdout)["cells"]
        found.append([(c["name"], c["outcome"], c["gates"]) for c in cells])
    assert found[0] == found[1]


def test_a_terminated_validation_leaves_no_process(tmp_path):
    """SIGTERM ends the workers too."""
    command = [
        "validate",
        "--quick",
        "--only",
        "raw,svd",
        "--no-report",
        "--workers",
        "2",
        "--cache",
        str(tmp_path),
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "btfref", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(20)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate()
    assert (process.returncode, said) == (143, b"btfref: error: terminated\n")
    # Processes that were told to end take a moment to be gone.
    for _ in range(100):
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("a process is still there ten seconds later")
