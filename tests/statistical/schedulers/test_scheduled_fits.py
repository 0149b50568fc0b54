"""The same fit whoever makes it: this process, one worker or several, workers that are killed."""

import dataclasses
import os
import signal

import pytest
from clusters import in_this_process, of_processes
from oracle import oracle_btf

from btfref.cli import main
from btfref.errors import InputError
from btfref.provenance import versions
from btfref.registry import method
from btfref.representations import between
from btfref.representations.file.container import save
from btfref.representations.fit_memory import FIT_BASE, fitted_by
from btfref.sampling import open_store
from btfref.sampling.passes import DistributedBTF, over_blocks, refuse_versions

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.filterwarnings("default")]

#: By view with few sums, with many, level by level; and by rows.
KEYS = ("svd", "lpca", "laplacian", "lafortune")

#: Likewise, of which the default set has enough.
SLOW = ("rf_poly", "rf_lobes", "lafortune_lut", "cmf", "hf", "gbrdf")


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


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Tiles, so that rows are read from several chunks."""
    path = tmp_path_factory.mktemp("scheduled") / "x.btf.zarr"
    oracle_btf((6, 5), views="1x3", lights="6x3").save(path, tile=4)
    return path


def fitted(folder, path, key, scheduler=None, progress=None):
    """Bytes of the file of a fit."""
    row, out = method(key), folder / "made.exr"
    with fitted_by(row, open_store(path), None, {}, scheduler, None) as btf:
        save(row.fit(btf, progress=progress), out)
        # Workers read all of it, but what hf reads of a few scattered texels.
        assert not isinstance(btf, DistributedBTF) or key == "hf" or btf.passes == 0
    return out.read_bytes()


@pytest.mark.parametrize("key", [*KEYS, *(pytest.param(key, marks=pytest.mark.long) for key in SLOW)])
def test_the_number_of_workers_changes_no_byte(tmp_path, path, one, two, key, monkeypatch):
    # Several blocks by rows.
    monkeypatch.setattr("btfref.representations.analytic.light_functions.BLOCK", 10)
    alone = fitted(tmp_path, path, key)
    for client in (one, two):
        assert fitted(tmp_path, path, key, client) == alone


@pytest.mark.long
def test_four_workers_change_no_byte(tmp_path, path, distributed, monkeypatch):
    monkeypatch.setattr("btfref.representations.analytic.light_functions.BLOCK", 5)
    with of_processes(distributed, 4) as local, distributed.Client(local) as client:
        for key in KEYS:
            assert fitted(tmp_path, path, key, client) == fitted(tmp_path, path, key)


@pytest.mark.long
@pytest.mark.parametrize("key", ["lpca", "laplacian"])
def test_a_worker_that_is_killed_in_a_fit_loses_nothing(tmp_path, distributed, key):
    path = tmp_path / "x.btf.zarr"
    oracle_btf((24, 24), views="4x6", lights="8x6").save(path)
    alone, killed = fitted(tmp_path, path, key), []
    with of_processes(distributed, 2) as local, distributed.Client(local) as client:
        before = client.run(os.getpid)

        def kill(done, total, label):
            if 2 * done > total and not killed:
                killed.append(next(iter(before.values())))
                os.kill(killed[0], signal.SIGKILL)

        assert fitted(tmp_path, path, key, client, progress=kill) == alone
        client.wait_for_workers(2, timeout=60)
        assert killed
        assert set(client.run(os.getpid).values()) != set(before.values())


def test_a_cluster_is_reached_by_its_address(tmp_path, path, two, monkeypatch):
    monkeypatch.setattr(between, "LOOKUPS", 64)
    monkeypatch.setattr(between, "ALBEDOS", 2)
    command = ["fit", "svd", str(path), "--set", "components=2", "-o"]
    alone, shared = tmp_path / "alone.exr", tmp_path / "shared.exr"
    assert main([*command, str(alone)]) == 0
    assert main([*command, str(shared), "--scheduler", two.scheduler.address]) == 0
    assert alone.read_bytes() == shared.read_bytes()


def _item(btf, shared, item):
    yield item


def test_what_workers_lack_is_one_clear_line(path, one):
    btf = DistributedBTF(path, one, {"memory": None, "threads": None})
    assert list(over_blocks(btf, _item, None, range(100))) == list(range(100))
    for change, message in (
        ({"path": str(path) + ".gone"}, "a worker does not see the store"),
        (
            {"versions": versions() | {"numpy": "1.0"}},
            r"a worker of another version; field 'numpy'.*expected 1\.0",
        ),
        ({"least": 1 << 60}, "memory budget of a worker too small"),
    ):
        btf._order = dataclasses.replace(btf._order, run=message, **change)
        with pytest.raises(InputError, match=message):
            list(over_blocks(btf, _item, None, [0]))
        btf = DistributedBTF(path, one, {"memory": None, "threads": None})


def test_versions_that_are_equal_are_taken():
    refuse_versions(versions())


def test_a_budget_is_that_of_all_processes(path, distributed):
    budget = FIT_BASE + (200 << 20)
    with (
        pytest.raises(InputError, match=r"too small for workers \(1\) and what adds up"),
        fitted_by(method("svd"), open_store(path), budget, {}, "dask", 1),
    ):
        pass
