"""`btfref validate` end to end on one method, and its self-test."""

import json

import pytest

from btfref.cli import main
from btfref.gates import tolerance
from btfref.system import chromium
from btfref.validate.injected.faults import FAULTS
from btfref.validate.matrix import QUICK
from btfref.validate.self_test import entries, possible, self_test, used_gates

pytestmark = pytest.mark.usefixtures("renderers")


def test_every_gate_has_a_fault():
    """All gates that validation applies are known, and each has a fault that is meant for it."""
    meant = {fault.meant for fault in FAULTS}
    assert meant <= entries(used_gates())
    assert {name.rpartition(".")[0] for name in meant} == used_gates()
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def test_every_fault_is_caught_by_its_gate():
    """And every single limit is failed by some fault."""
    found = self_test(edits=())  # those have a file of their own, test_stale_results.py
    assert len(found) == len(possible())
    assert [(fault.name, fault.failed) for fault in found if not fault.caught] == []
    assert [(fault.name, fault.clean) for fault in found if fault.clean] == []
    seen = {fault.meant.rpartition(".")[0] for fault in possible()}
    assert entries(seen) - {name for fault in found for name in fault.failed} == set()


def test_faults_in_the_browser_need_one(monkeypatch, need):
    need("chromium")
    assert possible() == FAULTS
    monkeypatch.setattr("btfref.validate.self_test.chromium", lambda: None)
    assert {fault.meant.rpartition(".")[0] for fault in FAULTS if fault not in possible()} == {
        "image.browser",
        "image.browser_edges",
        "image.browser_environment",
    }


@pytest.mark.long
def test_quick_validation_of_one_method(tmp_path, capsys):
    """Computed once, then taken from the cache; the numbers are the same."""
    command = ["validate", "--quick", "--only", "lpca", "--workers", "1", "--cache", str(tmp_path / "cache")]
    command += ["-o", str(tmp_path / "report"), "--json"]
    results = []
    for _ in range(2):
        assert main(command) == 0
        results.append(json.loads(capsys.readouterr().out))
    first, again = results
    assert first["passed"] is True
    assert first["computed"] == first["jobs"] == 7
    assert again["computed"] == 0
    assert again["cells"] == first["cells"]
    assert len(first["cells"]) == 3
    for cell in first["cells"]:
        stages = {stage["name"]: stage["rmse"]["estimate"] for stage in cell["waterfall"]["stages"]}
        # The port's rounding is far below what the fit loses, and that below the picture's brightness.
        drawn = "image.browser.p999" in {gate["name"] for gate in cell["gates"]}
        assert drawn == (chromium() is not None and cell["lights"] in QUICK.browser_lights)
        assert [part["beside"] for part in cell["waterfall"]["parts"]] == [True] * drawn
        assert stages["port"] < tolerance("waterfall.port") * stages["fit"]
    assert stages["fit"] < cell["waterfall"]["mean"]
    assert (tmp_path / "report" / "index.html").exists()
