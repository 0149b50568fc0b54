"""What processes share: a synthesis as data that workers read, and a store that one of them writes."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.sampling import open_store
from btfref.sampling.store.lock import writing
from btfref.sampling.synthesis import make_job, synthesize_store

SETTINGS = {"texels": 4, "views": "1x3", "lights": "1x3", "spp": 4, "seed": 5}
ROOT = Path(__file__).parents[3]


@pytest.mark.usefixtures("llvm")
def test_a_job_comes_back_from_its_file(tmp_path):
    """Geometry, textures, settings and selection bit by bit; nothing of it is code."""
    from PIL import Image

    from btfref.sampling.job import fingerprint
    from btfref.sampling.job_file import read_job, write_job
    from btfref.sampling.paths.adaptive import Plan
    from btfref.sampling.store.selection import Selection

    Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8)).save(tmp_path / "height.png")
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(tmp_path / "albedo.png")
    own = {"albedo": str(tmp_path / "albedo.png"), "amplitude": 0.1, "allow_seams": True}
    job = make_job(tmp_path / "height.png", None, {**SETTINGS, **own})
    only, plan = Selection(pairs=((0, (1, 2)), (2, (0,)))), Plan(1.5, 0.25, None, 64, False)
    write_job(tmp_path / "job", job, only, plan)
    again, selection, planned = read_job(tmp_path / "job")
    assert fingerprint(again.mesostructure) == fingerprint(job.mesostructure)
    assert again.attributes["versions"] == job.attributes["versions"]
    assert (again.views, again.lights, again.texels) == (job.views, job.lights, job.texels)
    assert again.views.name == job.views.name
    assert again.settings.attributes() == job.settings.attributes()
    assert json.loads(json.dumps(selection.pairs)) == [[0, [1, 2]], [2, [0]]]
    assert planned == plan


@pytest.mark.usefixtures("llvm")
def test_numbers_of_vertices_and_what_was_ignored_come_back_as_well(tmp_path):
    from gltf_files import gltf

    from btfref.sampling.job import fingerprint
    from btfref.sampling.job_file import read_job, write_job

    colours = np.random.default_rng(0).random((4, 4))
    file = gltf(tmp_path / "m.glb", {}, COLOR_0=colours, top={"animations": [{}]})
    job = make_job(file, None, {**SETTINGS, "estimator": "surface"})
    write_job(tmp_path / "job", job, None, None)
    again, *_ = read_job(tmp_path / "job")
    assert fingerprint(again.mesostructure) == fingerprint(job.mesostructure)
    # A worker gets the estimator that was chosen: why is for the store.
    assert "vertices" in job.attributes["fallback"]
    assert again.settings.estimator == "path"
    assert again.attributes["ignored"] == job.attributes["ignored"] != []
    other = make_job(gltf(tmp_path / "m.glb", {}, COLOR_0=colours[::-1]), None, SETTINGS)
    assert fingerprint(other.mesostructure) != fingerprint(job.mesostructure)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("asked", "used", "why"),
    [
        ({}, "surface", None),
        ({"bsdf": {"type": "conductor"}}, "path", "part 0 has a mirror"),
        ({"target_error": 0.1, "spp": 16}, "surface", None),
        ({"target_error": 0.1, "spp": 16, "texel_error": 0.5}, "path", "limit of its own"),
        ({"target_error": 0.1, "spp": 16, "texel_error": 0.5, "estimator": "surface"}, "surface", None),
        ({"estimator": "path"}, "path", None),
    ],
)
def test_the_estimator_is_chosen_and_the_store_says_why(asked, used, why):
    job = make_job("flat", None, {**SETTINGS, **asked})
    assert job.settings.estimator == job.attributes["estimator"] == used
    assert (why in job.attributes["fallback"]) if why else ("fallback" not in job.attributes)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data | {"btfref": "0.0.1"}, "another version"),
        (lambda data: data | {"versions": {"numpy": "0.1"}}, "another version"),
        (lambda data: {k: v for k, v in data.items() if k != "settings"}, "not the job"),
        (lambda data: data | {"mesostructure": 3}, "not the job"),
    ],
)
def test_a_job_of_another_kind_is_refused(tmp_path, change, words):
    from btfref.sampling.job_file import read_job, write_job

    write_job(tmp_path / "job", make_job("flat", None, SETTINGS), None, None)
    data = json.loads((tmp_path / "job").read_text())
    (tmp_path / "job").write_text(json.dumps(change(data)))
    with pytest.raises(InputError, match=words):
        read_job(tmp_path / "job")


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path, need):
    need("distributed")
    from btfref.sampling.scheduling import _work

    with pytest.raises(InputError, match="does not see the folder"):
        _work(
            str(tmp_path / "job"),
            str(tmp_path / "x.btf.zarr"),
            [0],
            "synthesis",
            {"memory": None, "threads": 1},
        )


def test_one_process_writes_a_store(tmp_path):
    """The second one is told who; nothing has to be removed after the first was killed."""
    store = tmp_path / "x.btf.zarr"
    code = "import sys, time; from btfref.sampling.store.lock import writing\n"
    code += "with writing(sys.argv[1]): print('held', flush=True); time.sleep(600)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(store)], stdout=subprocess.PIPE, env=environment
    )
    assert child.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=f"process {child.pid} "), writing(store):
        pass
    child.send_signal(signal.SIGKILL)
    child.communicate()
    with writing(store):
        assert [path.name for path in tmp_path.iterdir()] == ["x.btf.zarr.lock.partial"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("llvm")
def test_a_refused_start_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="memory"):
        synthesize_store(tmp_path / "x.btf.zarr", "flat", memory=1 << 20, **SETTINGS)
    assert list(tmp_path.iterdir()) == []
    synthesize_store(tmp_path / "x.btf.zarr", "flat", **SETTINGS)
    before = open_store(tmp_path / "x.btf.zarr").read()[0]
    # A refused start never removes what was there.
    with pytest.raises(InputError):
        synthesize_store(tmp_path / "x.btf.zarr", "checker", **SETTINGS)
    assert np.array_equal(open_store(tmp_path / "x.btf.zarr").read()[0], before)
