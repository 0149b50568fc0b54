"""Files of queries: read as their layouts say, by readers that are not ours; resumed; described."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from stores import contents

import btfref
from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.querying import open_queries, query_file
from btfref.querying.files import zarr_file

ROOT = Path(__file__).parents[3]
LAWS = {"light": "cosine", "radius": "levels:0.02:1,1", "spp": 4, "seed": 3}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A small table, whose rows take no Mitsuba."""
    values = np.random.default_rng(2).uniform(0.05, 0.3, (8, 8, 4, 4, 3))
    btf = btfref.SampledBTF(values, "2x4", "2x4")
    path = tmp_path_factory.mktemp("queries") / "noise.raw.exr"
    btfref.save(btfref.fit("raw", btf), path)
    return path


@pytest.fixture(scope="module")
def whole(file, tmp_path_factory):
    """1024 rows in one file."""
    return query_file(tmp_path_factory.mktemp("whole") / "whole.queries.zarr", file, n=1024, **LAWS)


def test_the_file_holds_what_the_generator_yields(file, whole):
    batches = list(btfref.queries(file, n=1024, batch=300, **LAWS))
    rows = whole.read()
    assert [len(batch["B"]) for batch in batches] == [300, 300, 300, 124]
    for name, values in rows.items():
        assert np.array_equal(values, np.concatenate([batch[name] for batch in batches]))
    assert set(rows) == set(zarr_file.COLUMNS)
    later = next(btfref.queries(file, n=1024, first=1000, **LAWS))
    assert np.array_equal(later["B"], rows["B"][1000:])


def test_points_are_single_lookups_and_footprints_have_variance(file):
    exact = btfref.load(file)
    point = next(btfref.queries(file, n=64, seed=1))
    expected = exact.evaluate(*(point[name].astype(float) for name in ("uv", "w_light", "w_view")))
    assert np.array_equal(point["B"], expected.astype(np.float32))
    assert not point["variance"].any()
    assert (point["samples"] == 1).all()
    wide = next(btfref.queries(file, n=64, radius=0.2, seed=1))
    assert (wide["samples"] == 16).all()
    assert (wide["variance"] > 0).mean() > tolerance("synthesis.seen.min_noisy")


def records(path):
    """Random records as a training program reads them: from the description of the layout alone."""
    import h5py

    with h5py.File(path, "r") as data:
        assert "base_radius" in data.attrs
        color = data["ground_color"][:]
        items, height, width, _ = color.shape
        camera, light = (data[name][..., :2] for name in ("ground_camera_dir", "ground_light"))
        location, radius = data["ground_camera_target_loc"][:], data["ground_camera_query_radius"][:]
    assert camera.shape == light.shape == location.shape == (items, height, width, 2)
    assert radius.shape == (items, height, width, 1)
    # Directions of travel, downwards.
    camera, light = (
        np.concatenate([w, -np.sqrt(np.maximum(1 - (w**2).sum(-1, keepdims=True), 0))], -1)
        for w in (camera, light)
    )
    return [a.reshape(-1, a.shape[-1]) for a in (color, camera, light, location, radius)]


def test_random_records_are_read_without_our_code(file, whole, tmp_path, need):
    need("h5py")
    import h5py

    out = tmp_path / "records.h5"
    command = f"query {file} -o {out} --n 1024 --light cosine --radius levels:0.02:1,1 --spp 4 --seed 3"
    assert main([*command.split(), "--texels", "64"]) == 0
    color, camera, light, location, radius = records(out)
    rows = whole.read()
    limit = tolerance("queries.rounding.z")
    assert np.abs(camera + rows["w_view"]).max() <= limit
    assert np.abs(light + rows["w_light"]).max() <= limit
    assert np.abs(0.5 * (location + 1) - rows["uv"]).max() <= tolerance("queries.rounding.length")
    assert np.array_equal(radius[:, 0], rows["radius"])
    # A reader that multiplies by the cosine has B.
    assert np.abs(color * rows["w_light"][:, 2:] - rows["B"]).max() <= tolerance("queries.rounding.length")
    with h5py.File(out, "r") as data:
        assert data.attrs["base_radius"] == 1 / 128
        assert data["ground_color"].shape == (1, 32, 32, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["records.h5", "records.h5.croissant.json"]


def test_pictures_and_their_directions_are_read_without_our_code(file, tmp_path, need):
    need("h5py")
    import h5py

    out = tmp_path / "pictures.h5"
    assert main(f"query {file} -o {out} --n 96 --picture 8x4 --view 2x4 --max-theta 80".split()) == 0
    with h5py.File(out, "r") as data:
        light, view, color = (data[name][:] for name in ("ground_light", "ground_camera_dir", "ground_color"))
    assert (light.shape, view.shape, color.shape) == ((3, 2), (3, 2), (3, 4, 8, 3))
    assert color.dtype == np.float32
    light, view = (np.concatenate([w, np.sqrt(1 - (w**2).sum(-1, keepdims=True))], -1) for w in (light, view))
    v, u = np.meshgrid((np.arange(4) + 0.5) / 4, (np.arange(8) + 0.5) / 8, indexing="ij")
    expected = btfref.load(file).evaluate(np.stack([u, v], -1), light[:, None, None], view[:, None, None])
    assert np.abs(color - expected).max() <= tolerance("queries.rounding.length")


def test_arrays_and_tables(file, whole, tmp_path, need):
    need("pyarrow")
    from pyarrow import parquet

    rows = whole.read()
    command = f"query {file} --n 1024 --light cosine --radius levels:0.02:1,1 --spp 4 --seed 3 -o"
    for name in ("rows.npz", "rows.parquet"):
        assert main([*command.split(), str(tmp_path / name)]) == 0
    with np.load(tmp_path / "rows.npz") as arrays:
        for name, values in rows.items():
            assert np.array_equal(arrays[name], values)
        assert json.loads(str(arrays["attributes"]))["kind"] == "btf-queries"
    table = parquet.read_table(tmp_path / "rows.parquet")
    assert table.num_rows == 1024
    assert np.array_equal(table["v"].to_numpy(), rows["uv"][:, 1])
    assert np.array_equal(table["w_light_z"].to_numpy(), rows["w_light"][:, 2])
    assert np.array_equal(table["variance_b"].to_numpy(), rows["variance"][:, 2])
    assert np.array_equal(table["samples"].to_numpy(), rows["samples"])
    described = json.loads((tmp_path / "rows.parquet.croissant.json").read_text())
    columns = [field["source"]["extract"]["column"] for field in described["recordSet"][0]["field"]]
    assert sorted(columns) == sorted(table.column_names)
    assert described["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    (entry,) = described["distribution"]
    assert entry["sha256"] == hashlib.sha256((tmp_path / "rows.parquet").read_bytes()).hexdigest()
    assert entry["contentUrl"] == "rows.parquet"
    assert {"@context", "@type", "name", "description"} <= set(described)


KILLED = """
import sys
from btfref.querying.files import zarr_file
zarr_file.CHUNK = 256
from btfref.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_killed_run_goes_on_to_the_same_bytes(file, tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_file, "CHUNK", 256)
    alone, killed = tmp_path / "alone.queries.zarr", tmp_path / "killed.queries.zarr"
    options = ["--n", "5000", "--spp", "16", "--radius", "0.01"]
    assert main(["query", str(file), "-o", str(alone), *options]) == 0
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, "query", str(file), "-o", str(killed), *options],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    marks = killed / "coverage" / "c"
    while child.poll() is None and not (marks.is_dir() and len(list(marks.iterdir())) >= 3):
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    begun = open_queries(killed)
    assert 0 < begun.coverage.sum() < len(begun.coverage)
    with pytest.raises(InputError, match="incomplete"):
        begun.read()
    assert main(["query", str(file), "-o", str(killed), *options]) == 0
    assert contents(killed) == contents(alone)


def test_other_settings_are_refused_and_replaced_when_asked_for(file, tmp_path):
    out = tmp_path / "rows.queries.zarr"
    query_file(out, file, n=10, seed=1)
    before = contents(out)
    query_file(out, file, n=10, seed=1)
    assert contents(out) == before
    with pytest.raises(InputError, match=r"other settings.*settings"):
        query_file(out, file, n=10, seed=2)
    assert contents(out) == before
    query_file(out, file, n=10, seed=2, overwrite=True)
    assert contents(out) != before
    folder = tmp_path / "mine.queries.zarr"
    folder.mkdir()
    (folder / "thesis.txt").write_text("x")
    with pytest.raises(InputError, match="no queries"):
        query_file(folder, file, n=10, overwrite=True)
    assert (folder / "thesis.txt").exists()


def test_answers_of_a_method_and_their_errors(file, tmp_path, capsys):
    """The method that made the rows answers them without an error; another one has one."""
    queries, out = tmp_path / "rows.queries.zarr", tmp_path / "values.npy"
    query_file(queries, file, n=400)
    assert main(["evaluate", str(file), str(queries), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert np.array_equal(np.load(out), open_queries(queries).read()["B"])
    assert told["errors"]["rmse"] == [0, 0, 0]
    exact = btfref.load(file)
    darker = type(exact)(
        {k: v * np.float32(0.5) if k == "values" else v for k, v in exact.arrays().items()}, exact.meta
    )
    btfref.save(darker, tmp_path / "darker.exr")
    assert main(["evaluate", str(tmp_path / "darker.exr"), str(queries), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert "-0.5" in text
    assert "0.5" in text


def test_lookups_share_no_paths(file, tmp_path):
    with pytest.raises(InputError, match="lights_per_path"):
        query_file(tmp_path / "rows.queries.zarr", file, n=4, lights_per_path=2)


def test_levels_of_detail_answer_footprints(tmp_path):
    """Wide footprints of a method with levels: coarse ones are nearer to the average over the footprint."""
    from btfref.querying.evaluate import evaluate

    values = np.random.default_rng(4).uniform(0.0, 0.3, (1, 1, 16, 16, 3))
    btf = btfref.SampledBTF(values, [[0, 0, 1.0]], [[0, 0, 1.0]])
    table = btfref.fit("raw", btf)
    pyramid = btfref.fit("laplacian", btf)
    queries = tmp_path / "rows.queries.zarr"
    query_file(queries, table, n=200, light=[[0, 0, 1.0]], view=[[0, 0, 1.0]], radius=0.12, spp=64)
    found = {
        name: evaluate(pyramid, queries, tmp_path / "values.npy", filter=name)["errors"]["rmse"][0]
        for name in ("level", "point")
    }
    assert 2 * found["level"] < found["point"]
    with pytest.raises(InputError, match="no levels"):
        evaluate(table, queries, tmp_path / "values.npy", filter="level")
