"""Plans of benchmarks: what is read, what is measured and kept, and what is computed from it afterwards."""

import json

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.bench import metrics, subjects, tables
from btfref.bench.matrix import run
from btfref.bench.plan import Entry, read_plan, shipped
from btfref.cli import main
from btfref.comparison.metrics import rmse
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.registry import methods

PLAN = """
title = "A small one"
baseline = "raw"
measures = ["build", "error", "eval", "render", "sampling", "realtime"]
[query]
filter_type = ["nearest", "bilinear"]
[rounds]
build = 2
eval = 2
render = 2
sampling = 2
realtime = 2
[settings]
error_samples = 3000
points = { numpy = 200, drjit = 300, glsl = 250 }
scenes = ["sphere, suns"]
render_spp = 2
render_size = 24
sampling_size = 16
sampling_spp = 4
sampling_repeats = 3
frames = [[40, 30]]
[[method]]
key = "raw"
[[method]]
key = "lpca"
build = [{ clusters = 4, components = 2 }]
[[method]]
key = "svd"
name = "svd, as large"
bytes_of = "lpca (clusters 4, components 2)"
[[peer]]
key = "nearest"
[[peer]]
key = "sklearn"
build = { clusters = 4, components = 2 }
"""
NAMES = [
    "raw",
    "lpca (clusters 4, components 2)",
    "svd, as large",
    "raw, k nearest pairs in NumPy",
    "scikit-learn KMeans + PCA",
]


@pytest.fixture(scope="module")
def plan_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "small.toml"
    path.write_text(PLAN)
    return path


@pytest.fixture(scope="module")
def results(plan_file, need, tmp_path_factory):
    need("gl")
    need("llvm")
    folder = tmp_path_factory.mktemp("results")
    labels = []
    run(read_plan(plan_file), folder, btf=oracle_btf((8, 8)), progress=lambda *a: labels.append(a))
    assert labels
    assert all(done <= total for done, total, _ in labels)
    return folder


@pytest.fixture(scope="module")
def found(results):
    return metrics.rows(results)


def of(found, kind, entry):
    return [r for r in found if r["kind"] == kind and r["entry"] == entry]


def test_every_shipped_plan_can_be_read():
    for name, path in shipped().items():
        for quick in (False, True):
            plan = read_plan(path, quick=quick)
            assert plan.name == name
            assert plan.entries
    everything = read_plan(shipped()["realtime"])
    assert {e.method for e in everything.entries} == set(methods())
    assert all(len(e.query) == 4 for e in everything.entries)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (("measures =", "measurs ="), "plan"),
        (('"eval", ', '"evall", '), "measures"),
        (("[rounds]", "[rounds]\nfits = 1"), "rounds"),
        (('key = "raw"', 'key = "rau"'), "method.key"),
        (('key = "sklearn"', 'key = "sklern"'), "peer.key"),
        (("filter_type", "filtr"), "query"),
        (("[query]", "[query]\ninterpolation = 'drawn'"), "measures with query.interpolation"),
        (('bytes_of = "lpca', 'bytes_of = "lpka'), "method.bytes_of"),
        (('baseline = "raw"', 'baseline = "row"'), "baseline"),
    ],
)
def test_plans_with_mistakes_are_refused(tmp_path, change, field):
    path = tmp_path / "plan.toml"
    assert change[0] in PLAN
    path.write_text(PLAN.replace(*change))
    with pytest.raises(InputError) as caught:
        read_plan(path)
    assert caught.value.field == field


def test_drawn_pictures_stand_beside_blended_ones():
    """Half the time and three times the variance: two thirds of the efficiency, error √1.5 after equal time."""
    shared = {"record": "render", "run": 0, "material": "m", "entry": "raw", "scene": "s", "kernels": None}
    shared |= {"cold_s": 1.0, "mean": 1.0, "spp": 1}
    ways = {"blended": ([4.0, 8.0], 1.0), "drawn": ([2.0, 4.0], 3.0)}
    records = [
        {**shared, "query": {"interpolation": way}, "warm_s": times, "variance": v, "baseline_s": [1.0, 2.0]}
        for way, (times, v) in ways.items()
    ]
    base = {**shared, "entry": None, "name": "principled + bitmap", "query": {}, "warm_s": [1.0, 2.0]}
    run_of = {"record": "run", "id": 0, "plan": {"name": "render", "baseline": ""}}
    rows = metrics.rows("", [run_of, {**base, "variance": 1.0}, *records])
    drawn = next(r for r in rows if r["query"] == "drawn")
    assert drawn["time_ratio"]["median"] == 0.5
    assert drawn["variance_ratio"] == 3.0
    assert drawn["efficiency"] == 1 / 1.5
    assert drawn["equal_time_error"] == pytest.approx(1.5**0.5)
    assert all("efficiency" not in r for r in rows if r is not drawn)
    (_, header, lines), *_ = tables.tables(rows)
    assert "0.67" in lines[-1][header.index("efficiency")]


def test_only_and_quick(plan_file, tmp_path):
    assert [e.name for e in read_plan(plan_file, only=["svd", "nearest"]).entries] == [NAMES[2], NAMES[3]]
    with pytest.raises(InputError):
        read_plan(plan_file, only=["nothing"])
    path = tmp_path / "plan.toml"
    path.write_text(PLAN + "[quick.rounds]\nbuild = 1\n")
    assert read_plan(path).rounds["build"] == 2
    assert read_plan(path, quick=True).rounds == {**read_plan(path).rounds, "build": 1}


def test_everything_is_measured_of_everything(found):
    expected = {
        "build": [1] * 5,
        "error": [1] * 5,
        "eval": [6, 6, 6, 1, 1],
        "render": [2, 2, 2, 0, 0],
        "sampling": [2, 2, 2, 0, 0],
        "realtime": [2, 2, 2, 0, 0],
    }
    for kind, counts in expected.items():
        assert [len(of(found, kind, name)) for name in NAMES] == counts, kind
    assert len(of(found, "render", "principled + bitmap")) == 1


def test_error_is_that_of_the_answers(found):
    """Against errors over all entries: within the interval; the table itself has none."""
    btf = oracle_btf((8, 8))
    data = btf.values.astype(float)
    assert of(found, "error", "raw")[0]["rmse"] <= tolerance("bench.table.rmse")
    rows, columns = btf.values.shape[2:4]
    uv = np.stack(np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows), -1)
    entry = read_plan_entry("lpca")
    rep = subjects.build(entry, btf).representation
    for view, light in ((0, 0), (40, 7)):
        values = rep.evaluate(uv, btf.lights.vectors[light], btf.views.vectors[view])
        assert values.shape == (rows, columns, 3)
    everything = rep.evaluate(
        uv[None, None],
        btf.lights.vectors[None, :, None, None],
        btf.views.vectors[:, None, None, None],
    )
    exact = rmse(everything, data) / np.sqrt((data**2).mean())
    row = of(found, "error", NAMES[1])[0]
    assert row["rmse_low"] <= exact <= row["rmse_high"]
    assert row["rmse_low"] < row["rmse"] < row["rmse_high"]
    assert row["n"] == 3000


def read_plan_entry(key):
    return Entry(key, method=key, build={"clusters": 4, "components": 2})


def test_peers_answer_for_the_same_data(found):
    """The nearest pair of a measured entry is itself; k-means and PCA lose about as much as ours."""
    assert of(found, "error", NAMES[3])[0]["rmse"] <= tolerance("bench.peers.nearest")
    ours, theirs = (of(found, "error", NAMES[i])[0]["rmse"] for i in (1, 4))
    assert tolerance("bench.peers.min_ratio") < theirs / ours < tolerance("bench.peers.ratio")


def test_bytes_are_matched(found):
    sizes = {name: of(found, "build", name)[0]["payload"] for name in NAMES}
    one_more = sizes[NAMES[2]] / sizes[NAMES[1]]
    assert tolerance("bench.bytes.min_share") < one_more <= tolerance("bench.bytes.share")


def test_evaluators_agree_and_times_are_positive(found):
    for name in NAMES[:3]:
        for row in of(found, "eval", name):
            assert row["largest_difference"] <= tolerance("bench.evaluators.difference")
            assert row["per_second"] > 0
            assert row["time"]["n"] == 2
            assert row["cold_s"] > 0


def test_kernels_are_told_apart_from_the_rest(found):
    for row in [r for r in found if r["kind"] == "render" or r.get("evaluator") == "drjit"]:
        facts = row["kernels"]
        assert facts["launched"] >= max(1, facts["compiled"] + facts["from_disk"])
        assert 0 < facts["execution_s"] <= row["cold_s"] * tolerance("bench.kernels.cold_runs")


def test_ratios_are_of_pairs(results, found):
    records = [r for r in metrics.read_records(results) if r["record"] == "build"]
    by_name = {r["entry"]: r["warm_s"] for r in records}
    row = of(found, "build", NAMES[1])[0]
    assert row["ratio"]["median"] == pytest.approx(by_name[NAMES[1]][0] / by_name["raw"][0])
    assert of(found, "render", "principled + bitmap")[0]["ratio"]["median"] == 1


def test_runs_are_added_and_the_last_one_counts(plan_file, tmp_path):
    for _ in range(2):
        run(
            read_plan(_without(plan_file, tmp_path, 'measures = ["build", "error"]')),
            tmp_path,
            btf=oracle_btf((4, 4)),
        )
    records = metrics.read_records(tmp_path)
    assert sum(r["record"] == "run" for r in records) == 2
    assert len(metrics.latest(records)) == 11
    assert all(r["run"] == records[11]["id"] for r in metrics.latest(records)[1:])


def _without(plan_file, folder, measures):
    path = folder / "fewer.toml"
    text = plan_file.read_text().splitlines()
    path.write_text("\n".join(measures if line.startswith("measures") else line for line in text))
    return path


def test_report_and_comparison(results, plan_file, tmp_path, capsys):
    assert main(["bench", "report", str(results), "-o", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    material = next(iter(summary["front"]))
    assert (tmp_path / "out" / f"{material}.png").stat().st_size > 10_000
    text = (tmp_path / "out" / "tables.md").read_text()
    measured = read_plan(plan_file).measures
    assert {kind for kind, title in tables.KINDS.items() if title in text} == set(measured)
    capsys.readouterr()
    assert main(["bench", "compare", str(results), str(results), "--json"]) == 0
    lines = json.loads(capsys.readouterr().out)
    assert len(lines) == len([r for r in metrics.rows(results) if "time" in r or r["kind"] == "error"])
    assert all(line["ratio"] in (1, None) for line in lines)
    assert main(["bench", "compare", str(results), str(results)]) == 0


def test_a_slower_machine_is_seen(results, tmp_path):
    """Raw times times three give ratios of three, and their interval holds it."""
    lines = []
    for record in metrics.read_records(results):
        for key in ("warm_s", "cold_s"):
            if key in record:
                scaled = np.multiply(3, record[key])
                record[key] = scaled.tolist()
        if record["record"] == "error":
            for key in ("queries", "values"):
                record[key] = str(results / record[key])
        lines.append(json.dumps(record))
    (tmp_path / "results.jsonl").write_text("\n".join(lines))
    for line in tables.compared(results, tmp_path):
        if "RMSE" not in line["what"]:
            assert line["ratio"] == pytest.approx(3)
            rounding = tolerance("metric.float32.rtol")
            assert line["low"] is None or line["low"] <= 3 * (1 + rounding)
            assert line["high"] is None or line["high"] >= 3 * (1 - rounding)


@pytest.mark.parametrize(
    "arguments",
    [
        ["bench", "nothing"],
        ["bench", "report", "nowhere", "-o", "out"],
        ["bench", "compare", "one"],
        ["bench", "fit", "folder"],
    ],
)
def test_bad_calls(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
