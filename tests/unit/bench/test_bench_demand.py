"""The suite demand: parts against the whole, the law of their cost, shares of the shipped scenes."""

import json

import pytest

from btfref.bench.demand import BASELINE, QUICK_SCENES, TRACED, cost_law, table
from btfref.bench.demand import run as run_suite
from btfref.bench.options import Options
from btfref.cli import main
from btfref.gates import tolerance


def test_law_of_the_cost():
    parts = {
        str(n): (v, p, 0.5 + 0.05 * v + 0.01 * p)
        for n, (v, p) in enumerate([(1, 1), (13, 52), (13, 1053), (81, 6561)])
    }
    law = cost_law(parts)
    assert law["constant_s"] == pytest.approx(0.5)
    assert law["view_s"] == pytest.approx(0.05)
    assert law["pair_s"] == pytest.approx(0.01)
    assert law["lights_per_view"] == pytest.approx(5)
    assert law["largest_residual"] <= tolerance("bench.law.residual")
    # Times that follow no such law are told: a part that takes twice as long as it should.
    parts["again"] = (*parts["1"][:2], 2 * parts["1"][2])
    assert cost_law(parts)["largest_residual"] >= tolerance("bench.law.min_broken")


def test_quick_synthesis(need, llvm, capsys):
    assert main(["bench", "demand", "--quick", "--only", "synthesis", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["synthesis"]
    assert found["equal_pictures"]
    parts = found["parts"]
    assert set(TRACED) < set(parts)
    whole, plane, sphere = (parts[name] for name in (BASELINE, *TRACED))
    assert whole["pairs"] == whole["views"] ** 2
    assert parts["single pair"]["pairs"] == 1
    assert plane["pairs"] < tolerance("bench.demand.pairs") * whole["pairs"]
    most = tolerance("bench.demand.slope") * plane["share_of_samples"] + tolerance("bench.demand.headers")
    assert plane["share_of_bytes"] < most
    # All views of a sphere are needed, and some of their lights each.
    assert sphere["views"] > tolerance("bench.demand.min_views") * whole["views"]
    assert plane["pairs"] < sphere["pairs"] < whole["pairs"]
    assert whole["share_of_samples"] == whole["share_of_bytes"] == 1
    # What the times are is no test's business; what is made of them is.
    law = found["law"]
    for part in parts.values():
        expected = law["constant_s"] + part["views"] * law["view_s"] + part["pairs"] * law["pair_s"]
        assert part["law_s"] == pytest.approx(expected)


def test_quick_scenes(need, fits):
    need("llvm")
    need("gl")
    result = run_suite(Options(quick=True, btf=fits.btf(), only=("scenes",)))
    scenes = result["scenes"]
    assert set(scenes) == set(QUICK_SCENES)
    for entry in scenes.values():
        for costs in entry["methods"].values():
            assert 0 < costs["bytes"] <= 1
            assert 0 < costs["read"] <= 1
            assert costs["load"]["median_s"] > 0
    assert (
        scenes["plane, 1 light"]["methods"]["lpca"]["bytes"]
        < scenes["cloth, sky"]["methods"]["lpca"]["bytes"]
    )
    assert scenes["cloth, sky"]["methods"]["lpca"]["frame"] is None
    assert scenes["horizon"]["methods"]["lpca"]["frame"]["median_s"] > 0
    assert len(table(result)[1]) >= len(QUICK_SCENES) * 6
