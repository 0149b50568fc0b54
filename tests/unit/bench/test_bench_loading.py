"""The suite that loads parts of files: what is measured, and what is made of the rounds."""

import pytest
from oracle import oracle_btf

from btfref.bench import SUITES
from btfref.bench.experiments import loading
from btfref.bench.options import Options
from btfref.registry import method
from btfref.representations.file.container import save


def test_a_part_is_measured_beside_the_whole(tmp_path):
    assert SUITES["loading"] == loading.__name__
    save(method("raw").fit(oracle_btf((4, 4), views="3x4", lights="2x3")), tmp_path / "x.exr")
    whole, part = (
        loading.measured(str(tmp_path / "x.exr"), "raw", loading._views(12, count)) for count in (None, 2)
    )
    assert 0 < part["bytes"] < whole["bytes"]
    assert min(part["cpu_s"], part["wall_s"], whole["cpu_s"]) > 0


def test_views_that_are_kept_are_neighbours():
    assert loading._views(81, None) is None
    assert loading._views(81, 3) == [39, 40, 41]
    assert loading._views(3, 3) == [0, 1, 2]


def test_ratios_are_of_pairs():
    wholes = [{"bytes": 100, "cpu_s": s, "peak_bytes": 1 << 20} for s in (1.0, 2.0, 4.0)]
    rounds = [{"bytes": 25, "cpu_s": s, "peak_bytes": None} for s in (0.5, 0.5, 0.4)]
    found = loading._part(81, 20, rounds, wholes)
    assert (found["views"], found["share"], found["peak_bytes"]) == (20, 0.25, None)
    assert found["cpu_s"] == {"median": 0.5, "least": 0.4, "most": 0.5, "of_whole": 0.25}
    header, rows = loading.table({"summary": {"raw": [found]}})
    assert len(header) == len(rows[0])
    assert rows[0] == ("raw", "20", "25.0", "500 (400 … 500)", "25", "–", "–")


@pytest.mark.long
def test_each_measurement_is_a_process_of_its_own(monkeypatch):
    monkeypatch.setattr(loading, "ROUNDS", (4, 2))
    calls = []
    options = Options(True, lambda *call: calls.append(call), oracle_btf((4, 4)), ["raw"])
    found = loading.run(options)
    assert calls[-1][0] == calls[-1][1] - 1
    assert [part["views"] for part in found["summary"]["raw"]] == [81, 2, 8]
    whole, few, _ = found["summary"]["raw"]
    assert whole["share"] == whole["cpu_s"]["of_whole"] == 1
    assert 0 < few["share"] < whole["share"]
