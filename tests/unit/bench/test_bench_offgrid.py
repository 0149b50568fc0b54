"""Errors off the grid: the rows are the same for all, and what is right has none."""

from dataclasses import replace

import numpy as np
import pytest

from btfref.bench import metrics, tables
from btfref.bench.data import source_of
from btfref.bench.experiments import directions, offgrid, queries
from btfref.bench.experiments.between import TEXELS
from btfref.bench.matrix import run
from btfref.bench.measures import off_grid_rows
from btfref.bench.options import Options
from btfref.bench.plan import read_plan
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.querying import off_grid, split
from btfref.representations.tabulated import raw
from btfref.sampling.synthesis import synthesize


class Exact:
    """Answers with the true values themselves, or with their double."""

    def __init__(self, truth, factor=1.0):
        self.truth, self.factor = truth, factor

    def evaluate(self, uv, w_light, w_view):
        rows = next(
            rows for rows in self.truth.values() if len(uv) % len(rows["B"]) == 0 and self.knows(rows, w_view)
        )
        each = len(uv) // len(rows["B"])
        return self.factor * np.repeat(rows["B"], each, 0)

    @staticmethod
    def knows(rows, w_view):
        each = len(w_view) // len(rows["w_view"])
        return np.array_equal(np.asarray(w_view, np.float32)[::each], rows["w_view"])


@pytest.fixture(scope="module")
def truth(need):
    need("llvm")
    return off_grid.true_rows("flat", 60, 8, TEXELS)


def test_rows_have_three_footprints_and_two_halves(truth):
    assert list(truth) == list(split.FOOTPRINTS)
    for footprint, rows in truth.items():
        assert (rows["radius"] == np.float32(split.FOOTPRINTS[footprint] / TEXELS)).all()
        assert np.degrees(np.arccos(rows["w_view"][:, 2].min())) <= split.MAX_THETA
        assert np.array_equal(rows["B"], np.float32(0.5) * (rows["first"] + rows["second"]))
    points, texels = truth["point"], truth["texel"]
    assert not np.array_equal(points["uv"], texels["uv"])


def test_what_is_right_has_no_error_and_what_is_double_has_all(truth):
    right, double = (off_grid.errors(Exact(truth, factor), truth) for factor in (1, 2))
    for footprint in split.FOOTPRINTS:
        assert right[footprint]["nrmse"][2] <= tolerance("queries.rounding.length")
        assert off_grid.cells(right[footprint])[2].startswith("∞")
        _, low, high = double[footprint]["nrmse"]
        assert low < 1 < high
        assert double[footprint]["delta_e00"][1] > 0


def test_tables_have_a_line_for_each(truth):
    found = off_grid.errors(Exact(truth, 2), truth)
    header, rows = offgrid.table({"summary": {"flat, ubo81": {"exact": found}}})
    assert [len(row) for row in rows] == [len(header)] * 3
    made = {"10x5": {"directions": 50, "pictures": 2500, "errors": found}}
    header, rows = directions.table({"summary": {"flat": made}})
    assert [len(row) for row in rows] == [len(header)]
    ratio = {"queries": 2e6, "mitsuba": 1e6, "ratio": [2.0, 1.5, 2.5]}
    header, rows = queries.table({"summary": {"flat": ratio}})
    assert rows == [("flat", "2", "1", "2.00 (1.50 to 2.50)")]
    assert len(header) == 4


PLAN = """
measures = ["build", "off_grid"]
[data]
mesostructures = ["flat"]
texels = 16
directions = "2x4"
spp = 2
[settings]
off_grid_rows = 60
off_grid_spp = 8
[[method]]
key = "raw"
[[peer]]
key = "nearest"
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "small.toml"
    path.write_text(PLAN)
    return path


@pytest.fixture(scope="module")
def sampled(need):
    need("llvm")
    return synthesize("flat", texels=16, views="2x4", lights="2x4", spp=2, estimator="surface")


def test_plans_ask_the_same_rows(plan, truth, sampled, tmp_path, capsys):
    run(read_plan(plan), tmp_path)
    found = [row for row in metrics.rows(tmp_path) if row["kind"] == "off_grid"]
    assert [(row["entry"], row["query"]) for row in found[:3]] == [("raw", name) for name in split.FOOTPRINTS]
    assert len(found) == 6
    expected = off_grid.errors(raw.fit(sampled), truth)
    for row in found[:3]:
        for name in off_grid.COLUMNS:
            assert row[name] == pytest.approx(expected[row["query"]][name])
    title, header, lines = tables.tables(found)[0]
    assert title == tables.KINDS["off_grid"]
    assert all(len(line) == len(header) for line in lines)
    assert all(line["ratio"] == 1 for line in tables.compared(tmp_path, tmp_path) if "point" in line["what"])


def test_without_the_geometry_nothing_is_asked(plan, sampled):
    """Measured data have none; what was changed since is not what was sampled."""
    assert source_of(sampled) is not None
    parent = sampled.attributes["parent"]
    for other in ({}, {"parent": parent | {"geometry": "0"}}, {"parent": parent | {"name": "velvet"}}):
        assert off_grid_rows(replace(sampled, attributes=other), read_plan(plan)) is None


@pytest.mark.parametrize("suite", [offgrid, directions, queries])
def test_unknown_names_are_told(suite):
    with pytest.raises(InputError, match="velvet"):
        suite.run(Options(quick=True, only=["velvet"]))


@pytest.mark.long
def test_the_suites_run(need):
    need("llvm")
    found = offgrid.run(Options(quick=True, only=["raw", "svd"]))
    for facts in found["summary"]["checker, ubo81"].values():
        for errors in facts.values():
            estimate, low, high = errors["nrmse"]
            assert low <= estimate <= high
    assert directions.run(Options(quick=True))["summary"]["checker"]["adaptive:50"]["directions"] == 50
    assert queries.run(Options(quick=True))["summary"]["checker"]["queries"] > 0
