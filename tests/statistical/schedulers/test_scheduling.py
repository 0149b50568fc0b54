"""The same store whoever makes it: one process, few or many Dask workers, workers that are killed, little memory."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from clusters import of_processes
from stores import contents

from btfref.cli import main
from btfref.errors import InputError, MissingDependencyError
from btfref.sampling import memory, open_store
from btfref.sampling.store.layout import shard_shape
from btfref.sampling.surface.budget import Shares
from btfref.sampling.synthesis import synthesize_store

pytestmark = pytest.mark.usefixtures("llvm")

SETTINGS = {"texels": 16, "views": "3x4", "lights": "2x4", "spp": 8, "seed": 5, "resolution": 16}


@pytest.fixture(scope="module")
def cluster(need):
    """A client of two local workers, each a process of its own."""
    need("distributed")
    import distributed

    with of_processes(distributed, 2) as local, distributed.Client(local) as client:
        yield client


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("extra", [{}, {"estimator": "path"}, {"estimator": "path", "target_error": 0.1}])
def test_workers_write_the_same_bytes(tmp_path, cluster, extra):
    alone, shared = tmp_path / "alone.btf.zarr", tmp_path / "shared.btf.zarr"
    synthesize_store(alone, "checker", **SETTINGS, **extra)
    calls = []
    synthesize_store(
        shared, "checker", scheduler=cluster, progress=lambda *call: calls.append(call), **SETTINGS, **extra
    )
    assert contents(alone) == contents(shared)
    assert calls[-1] == (12, 12, "synthesis")
    assert sorted(os.listdir(tmp_path)) == ["alone.btf.zarr", "shared.btf.zarr"]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("workers", [1, pytest.param(4, marks=pytest.mark.long)])
def test_the_number_of_workers_changes_no_byte(need, tmp_path, workers):
    """A cluster of one and one of four, started by the synthesis itself; the one of two is above."""
    need("distributed")
    alone, shared = tmp_path / "alone.btf.zarr", tmp_path / "shared.btf.zarr"
    settings = SETTINGS | {"estimator": "surface"}
    synthesize_store(alone, "checker", **settings)
    synthesize_store(shared, "checker", scheduler="dask", workers=workers, **settings)
    assert contents(alone) == contents(shared)


@pytest.mark.filterwarnings("default")
def test_a_cluster_that_runs_elsewhere_is_reached_by_its_address(tmp_path, cluster):
    address = cluster.scheduler.address
    assert address.startswith("tcp://")
    alone, shared = tmp_path / "alone.btf.zarr", tmp_path / "shared.btf.zarr"
    synthesize_store(alone, "flat", texels=4, views="1x3", lights="1x3", spp=4, estimator="surface")
    command = ["synth", "flat", "-o", str(shared), "--texels", "4", "--views", "1x3", "--lights", "1x3"]
    command += ["--spp", "4", "--estimator", "surface", "--scheduler", address]
    before = cluster.run(os.getpid)
    assert main(command) == 0
    assert contents(alone) == contents(shared)
    # The cluster is somebody else's: it goes on.
    assert cluster.run(os.getpid) == before


@pytest.mark.filterwarnings("default")
def test_a_killed_worker_loses_nothing(tmp_path, cluster):
    settings = SETTINGS | {"spp": 64, "texels": 32, "estimator": "path"}
    alone, shared = tmp_path / "alone.btf.zarr", tmp_path / "shared.btf.zarr"
    synthesize_store(alone, "checker", **settings)
    before = cluster.run(os.getpid)

    def kill(done, total, label):
        if done == 2:
            os.kill(next(iter(before.values())), signal.SIGKILL)

    synthesize_store(shared, "checker", scheduler=cluster, progress=kill, **settings)
    assert contents(alone) == contents(shared)
    cluster.wait_for_workers(2, timeout=60)
    assert set(cluster.run(os.getpid).values()) != set(before.values())


@pytest.mark.filterwarnings("default")
def test_an_error_of_a_worker_is_one_clear_line(tmp_path, cluster):
    with pytest.raises(InputError, match="memory budget too small"):
        synthesize_store(tmp_path / "a.btf.zarr", "checker", scheduler=cluster, memory=1 << 20, **SETTINGS)


def test_without_dask_one_line_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    out = str(tmp_path / "a.btf.zarr")
    small = ["--texels", "2", "--views", "1x3", "--lights", "1x3", "--spp", "2"]
    assert main(["synth", "flat", "-o", out, "--scheduler", "dask", *small]) == 2
    message = capsys.readouterr().err
    assert "btfref[distributed]" in message
    assert message.count("\n") == 1
    with pytest.raises(MissingDependencyError):
        synthesize_store(out, "flat", scheduler="dask", texels=2, views="1x3", lights="1x3", spp=2)


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path, capsys):
    out = str(tmp_path / "a.btf.zarr")
    assert main(["synth", "flat", "-o", out, "--scheduler", "nowhere", "--texels", "2"]) == 2
    assert "scheduler" in capsys.readouterr().err


@pytest.mark.long
def test_a_scheduler_that_dies_is_one_line_and_the_run_goes_on(tmp_path, need):
    """What was made before stays; the same command without it ends with the same bytes."""
    need("distributed")
    root = str(Path(__file__).parents[3])
    environment = os.environ | {"PYTHONPATH": root}
    where = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    base = [sys.executable, "-m", "distributed.cli"]
    scheduler = subprocess.Popen(
        [
            *base[:2],
            f"{base[2]}.dask_scheduler",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(where),
        ],
        **quiet,
    )
    worker = subprocess.Popen(
        [*base[:2], f"{base[2]}.dask_worker", "--nthreads", "1", "--scheduler-file", str(where)], **quiet
    )
    out, alone = tmp_path / "a.btf.zarr", tmp_path / "alone.btf.zarr"
    settings = [
        "--texels",
        "32",
        "--views",
        "3x4",
        "--lights",
        "2x4",
        "--spp",
        "256",
        "--set",
        "resolution=16",
        "--estimator",
        "path",
    ]
    command = [sys.executable, "-m", "btfref", "synth", "checker", *settings, "-o"]
    try:
        while not (where.exists() and where.stat().st_size):
            assert scheduler.poll() is None
        address = json.loads(where.read_text())["address"]
        run = subprocess.Popen(
            [*command, str(out), "--scheduler", address], stderr=subprocess.PIPE, env=environment
        )
        while not (out.exists() and open_store(out).coverage.any()):
            assert run.poll() is None
        scheduler.kill()
        _, said = run.communicate(timeout=200)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    assert (run.returncode, said.count(b"\n")) == (2, 1), said
    assert b"scheduler" in said
    for path in (out, alone):
        subprocess.run([*command, str(path)], env=environment, check=True, stdout=subprocess.DEVNULL)
    assert contents(out) == contents(alone)


# --- memory


def test_blocks_shrink_with_the_budget():
    facts = {"triangles": 1000, "n_views": 81, "n_lights": 81, "texels": (256, 256), "shard": (256, 256)}
    surface = {"n_directions": 81, "shares": partial(Shares, 0.3, 0.3)}
    large, small = (
        memory.blocks(budget << 30, estimator="surface", spp=16, **facts, **surface) for budget in (64, 4)
    )
    assert (large.views, large.lights) == (81, 81)
    assert small.views * small.lights < 81 * 81
    assert memory.blocks(2 << 30, estimator="path", spp=16, **facts).buffer <= 96 << 20
    for estimator in ("path", "surface"):
        with pytest.raises(InputError, match=r"at least .* MiB") as error:
            memory.blocks(200 << 20, estimator=estimator, spp=16, **facts)
        assert error.value.field == "memory"
        least = int(str(error.value).split("at least ")[1].split()[0]) + 1
        assert memory.blocks(least << 20, estimator=estimator, spp=16, **facts)


@pytest.mark.parametrize(
    ("n_lights", "texels", "expected"),
    [
        (81, (64, 64), (81, 1, 1)),
        (81, (256, 256), (81, 4, 4)),
        (151, (256, 256), (151, 2, 4)),
        (151, (4096, 4096), (151, 1, 9)),
        (6000, (64, 64), (1365, 1, 1)),
    ],
)
def test_files_of_a_store_stay_small(n_lights, texels, expected):
    shape = shard_shape(n_lights, texels, (64, 64))
    assert shape == expected
    assert shape[0] * shape[1] * shape[2] * 64 * 64 * 12 <= 64 << 20


CHILD = """
import sys
from btfref.sampling.synthesis import synthesize_store
views = [[0, 0, 1.0], [0.6, 0, 0.8], [0, 0.6, 0.8], [0.48, 0.36, 0.8]]
synthesize_store(sys.argv[1], "checker", texels=int(sys.argv[4]), views=views, lights="ubo151", spp=int(sys.argv[5]),
                 max_depth=2, resolution=16, memory=int(sys.argv[2]), estimator=sys.argv[3],
                 report=lambda peak: print(peak))
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "texels", "spp", "budget"),
    [("path", 256, 2, 1000), ("surface", 48, 16, 1400), ("surface", 128, 10, 2000)],
)
def test_the_budget_is_kept(tmp_path, estimator, texels, spp, budget):
    """The budget bounds the process that does the work; 256² · 151² as a whole would be 17 GB."""
    out = tmp_path / "a.btf.zarr"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    child = subprocess.run(
        [sys.executable, "-c", CHILD, str(out), str(budget << 20), estimator, str(texels), str(spp)],
        capture_output=True, text=True, env=environment, check=True,
    )  # fmt: skip
    assert int(child.stdout) <= budget << 20
    assert open_store(out).complete
