"""The same cells and verdicts, and the same benchmark, whoever computes: this process or the workers of a cluster."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clusters import in_this_process, of_processes
from oracle import oracle_btf

from btfref.bench import matrix
from btfref.bench.metrics import read_records
from btfref.bench.plan import read_plan
from btfref.errors import InputError
from btfref.provenance import told
from btfref.sampling.cluster.tasks import one_a_machine
from btfref.validate import workers
from btfref.validate.cache import Cache
from btfref.validate.injected.edits import SETTINGS, VIEW
from btfref.validate.matrix import Spec
from btfref.validate.pool import Job
from btfref.validate.run import validate

pytestmark = pytest.mark.filterwarnings("default")

#: Of results, what tells of time.
TIMES = {"seconds", "frame_ms", "workers"}


@pytest.fixture(scope="module")
def distributed(need):
    need("distributed")
    import distributed

    return distributed


@pytest.fixture(scope="module")
def one(distributed):
    """A client of one worker, in this process."""
    with in_this_process(distributed) as local, distributed.Client(local) as client:
        yield client


@pytest.fixture(scope="module")
def two(distributed):
    """A client of two workers, each a process of its own."""
    with of_processes(distributed, 2) as local, distributed.Client(local) as client:
        yield client


# --- validate


def _made(root, name):
    """A job that computes, unless that is done."""
    cache = Cache(root)
    cache.get(name, ".txt", lambda path: path.write_text(name))
    return name, cache.computed > 0


def _keys(name):
    return [name]


@pytest.fixture
def asked(one, tmp_path, monkeypatch):
    """Workers of this process, which know nothing of OpenGL, and their folder."""
    monkeypatch.setattr(workers, "driver", lambda: "a driver")
    monkeypatch.setattr(workers, "use_threads", lambda threads: None)
    with told.order(tmp_path / "cache", ["btfref.outputs"], [], driver="a driver") as path:
        yield workers.Workers(one, {"memory": None, "threads": None}, path)


def jobs(folder, *names):
    return [Job(_made, _keys, (str(folder), name)) for name in names]


def test_jobs_are_tasks_and_what_is_there_is_not_computed(asked, tmp_path):
    todo = jobs(tmp_path / "cache", "a", "b", "c")
    assert sorted(asked.each(todo)) == [("a", True), ("b", True), ("c", True)]
    (tmp_path / "cache" / "b.txt").unlink()
    assert sorted(asked.each(todo)) == [("a", False), ("b", True), ("c", False)]


def test_a_worker_that_would_make_something_else_gives_no_verdict(asked, tmp_path, monkeypatch):
    todo = jobs(tmp_path / "cache", "a")
    other = dict(told.accepted(asked._path))
    other["told"] = {**other["told"], "files": {"btfref/outputs.py": "0" * 64}}
    monkeypatch.setattr(told, "_ACCEPTED", {})
    with monkeypatch.context() as patch:
        patch.setattr(told, "told", lambda *asked: other["told"])
        with pytest.raises(InputError, match="a worker has code of its own"):
            list(asked.each(todo))
    with monkeypatch.context() as patch:
        patch.setattr(workers, "driver", lambda: "another")
        with pytest.raises(
            InputError, match=r"another OpenGL driver or browser.*got another; expected a driver"
        ):
            list(asked.each(todo))
    with pytest.raises(InputError, match="would make another result; field 'made'; got a; expected b"):
        workers.work(str(asked._path), todo[0], ["b"], 1)
    asked._path.unlink()
    monkeypatch.setattr(told, "_ACCEPTED", {})
    with pytest.raises(InputError, match="a worker does not see the folder"):
        list(asked.each(todo))
    assert not (tmp_path / "cache" / "a.txt").exists()


def test_workers_in_this_process_are_refused(one, tmp_path):
    assert workers._whereabouts() == (socket.gethostname(), os.getpid())
    with (
        pytest.raises(InputError, match="processes of their own"),
        workers.workers_of(one, 1, tmp_path, ["svd"], ["checker"]),
    ):
        pass


def without_times(data):
    if isinstance(data, dict):
        return {key: without_times(value) for key, value in data.items() if key not in TIMES}
    return [without_times(value) for value in data] if isinstance(data, list | tuple) else data


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return validate(SPECS, settings=SETTINGS, cache=tmp_path_factory.mktemp("plain"), workers=1)


SPECS = [Spec(VIEW[0], method, *VIEW[1:]) for method in ("lpca", "svd")]


@pytest.mark.long
@pytest.mark.usefixtures("renderers")
def test_workers_find_the_cells_and_verdicts_of_one_process(tmp_path, plain, two):
    calls = []
    found = validate(
        SPECS, settings=SETTINGS, cache=tmp_path, scheduler=two, progress=lambda *call: calls.append(call)
    )
    assert found.passed
    assert (found.computed, found.jobs) == (plain.computed, plain.jobs) == (6, 6)
    assert calls[-1] == (6, 6, "validating")
    assert without_times(found.to_dict()) == without_times(plain.to_dict())
    for one, other in zip(found.cells, plain.cells, strict=True):
        for name, image in one.images.items():
            np.testing.assert_array_equal(image, other.images[name])
    again = validate(SPECS, settings=SETTINGS, cache=tmp_path, scheduler=two)
    assert again.computed == 0
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.long
@pytest.mark.usefixtures("renderers")
def test_a_worker_that_is_killed_in_a_validation_loses_nothing(tmp_path, plain, two):
    before = two.run(os.getpid)

    def kill(done, total, label):
        if done == 3:  # the methods are at work
            os.kill(next(iter(before.values())), signal.SIGKILL)

    found = validate(SPECS, settings=SETTINGS, cache=tmp_path, scheduler=two, progress=kill)
    assert found.computed == plain.computed
    assert without_times(found.to_dict()) == without_times(plain.to_dict())
    two.wait_for_workers(2, timeout=60)
    assert set(two.run(os.getpid).values()) != set(before.values())


@pytest.mark.long
@pytest.mark.usefixtures("renderers")
def test_a_worker_of_other_code_is_refused_and_nothing_is_kept(tmp_path, distributed):
    """A copy of the packages in which one port has another text."""
    root, copy, cache = Path(__file__).parents[3], tmp_path / "copy", tmp_path / "cache"
    for package in ("btfref", "mitsuba_plugins", "shaders"):
        shutil.copytree(root / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    edited = copy / "mitsuba_plugins" / "lpca.py"
    edited.write_text(edited.read_text("utf-8") + "# edited\n", "utf-8")
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": copy}
    environment = os.environ | {"PYTHONPATH": str(copy)}
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", silence_logs=50) as local,
        distributed.Client(local) as client,
    ):
        worker = subprocess.Popen([*command, local.scheduler_address], env=environment, **quiet)
        try:
            client.wait_for_workers(1, timeout=120)
            with pytest.raises(
                InputError, match=r"a worker has code of its own; field 'mitsuba_plugins/lpca\.py'"
            ):
                validate(SPECS[:1], settings=SETTINGS, cache=cache, scheduler=client)
        finally:
            worker.kill()
            worker.wait()
    assert list(cache.iterdir()) == []


# --- bench

PLAN = """
measures = ["build", "off_grid", "error"]
[data]
mesostructures = ["flat"]
texels = 4
directions = "1x3"
spp = 2
[rounds]
build = 2
[settings]
off_grid_rows = 40
off_grid_spp = 4
error_samples = 100
[[method]]
key = "svd"
[[method]]
key = "lpca"
bytes_of = "svd"
build = [{ clusters = 2 }]
[[peer]]
key = "nearest"
"""


@pytest.mark.parametrize("known", [False, pytest.param(True, marks=pytest.mark.long)])
def test_workers_build_and_answer_as_one_process_does(tmp_path, one, request, monkeypatch, known):
    """Of a BTF of a user's, and of geometry, where errors off the grid are found as well."""
    btf = oracle_btf((4, 4), views="1x3", lights="1x3")
    if known:
        request.getfixturevalue("llvm")
        btf = None
    else:  # to find all code of all methods takes seconds
        monkeypatch.setattr(told, "told", lambda roots, methods, places: {"versions": {}, "files": {}})
    (tmp_path / "plan.toml").write_text(PLAN)
    plan, found = read_plan(tmp_path / "plan.toml"), []
    for name, scheduler in (("alone", None), ("shared", one)):
        matrix.run(plan, tmp_path / name, btf=btf, scheduler=scheduler)
        records = read_records(tmp_path / name)[1:]
        found.append(records)
        assert sorted(path.name for path in (tmp_path / name).iterdir()) == [
            "queries",
            "results.jsonl",
            "values",
        ]
    assert ("off_grid" in {record["record"] for record in found[0]}) == known
    for alone, shared in zip(*found, strict=True):
        for key in ("record", "entry", "payload", "file_bytes"):
            assert alone.get(key) == shared.get(key)
        if "values" in alone:
            values = [
                np.load(tmp_path / name / record["values"])
                for name, record in (("alone", alone), ("shared", shared))
            ]
            np.testing.assert_array_equal(*values)
        else:
            assert len(shared["warm_s"]) == len(alone["warm_s"]) == 1
            assert ("worker" in shared) == bool(shared["method"])


def _alone(path, number):
    """How many are at work on the machine beside this one."""
    import time

    (path / str(number)).touch()
    time.sleep(0.05)
    beside = len(list(path.iterdir())) - 1
    (path / str(number)).unlink()
    return beside


def test_what_is_timed_is_alone_on_its_machine(tmp_path, distributed):
    with in_this_process(distributed, 2, 2) as local, distributed.Client(local) as client:
        pieces = [(tmp_path, number) for number in range(4)]
        found = list(one_a_machine(client, _alone, pieces, tmp_path))
    assert sorted(found) == [(0, 0), (1, 0), (2, 0), (3, 0)]
