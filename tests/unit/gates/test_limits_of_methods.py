"""Limits that a method brings: in a file beside its module, found through its row in the registry."""

import sys
from pathlib import Path

import pytest

from btfref.gates import tolerances
from btfref.gates.tolerances import gate_keys, gate_table, parse, tolerance, tolerance_of
from btfref.registry import Method, methods
from btfref.stress.judging import limit_finding

SHARED = Path(tolerances.__file__).with_name("tolerances.toml")

OWN = """
[glass.thickness]
reason = "Panes are thin."
max = 0.25

[stress.energy.glass]
reason = "Light passes through glass."
relative = 0.5
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """``install(text)``: a method "glass" from outside whose package holds these limits, None for no file."""

    def installed(text):
        package = tmp_path / "glass_btf" / "model"
        package.mkdir(parents=True)
        (package.parent / "__init__.py").write_text("raise AssertionError('imported for its limits')")
        if text is not None:
            (package / "tolerances.toml").write_text(text)
        row = Method("glass", "Glass", "none", "glass_btf.model.fit", "glass_btf.plugin", "glass.glsl")
        monkeypatch.setattr(tolerances, "methods", lambda: methods() | {"glass": row})
        tolerances._gates.cache_clear()

    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    yield installed
    tolerances._gates.cache_clear()


def test_a_package_from_outside_brings_its_limits(install):
    install(OWN)
    assert gate_table("glass.thickness") == {"reason": "Panes are thin.", "max": 0.25}
    assert tolerance_of("glass", "stress.energy.relative") == 0.5
    assert tolerance_of("raw", "stress.energy.relative") == tolerance("stress.energy.relative") != 0.5
    # Nothing but what its own table names.
    assert tolerance_of("glass", "stress.energy.relief") == tolerance("stress.energy.relief")


@pytest.mark.parametrize(("method", "passed"), [("glass", True), ("raw", False)])
def test_a_check_is_judged_by_the_limit_of_its_method(install, method, passed):
    install(OWN)
    between = (tolerance("stress.energy.relative") + 0.5) / 2
    assert limit_finding("energy", method, "bumpy", between, "stress.energy.relative").passed == passed


def test_a_method_needs_no_limits_of_its_own(install):
    install(None)
    assert "glass.thickness" not in gate_keys()
    assert tolerance_of("glass", "stress.energy.relative") == tolerance("stress.energy.relative")


def test_a_shared_gate_is_not_replaced(install):
    install(OWN + '[stress.energy]\nreason = "Because."\nrelative = 10.0\n')
    with pytest.warns(UserWarning, match=r"glass_btf.*there already.*stress\.energy"):
        assert tolerance("stress.energy.relative") < 10
    assert "glass.thickness" not in gate_keys()


def test_a_broken_file_is_named(install):
    install("[glass")
    with pytest.warns(UserWarning, match=r"glass_btf.model.tolerances\.toml"):
        assert tolerance("stress.energy.relative") > 0


def test_a_module_without_package_has_no_file():
    assert Method("glass", "", "", "glass", "", "").tolerances is None


def test_shared_limits_name_no_method():
    shared = parse(SHARED.read_text("utf-8"))
    words = {word for key, gate in shared.items() for name in gate for word in (*key.split("."), name)}
    found = {word for word in words for key in methods() if word == key or word.endswith(f"_{key}")}
    assert found == set()


def test_limits_in_place_of_shared_ones_are_of_a_method_of_the_file():
    """A mistyped method would leave the shared limit in force."""
    shared = parse(SHARED.read_text("utf-8"))
    found = []
    for file in {row.tolerances for row in methods().values()}:
        owners = {row.key for row in methods().values() if row.tolerances == file}
        for key, gate in parse(file.read_text("utf-8")).items() if file.is_file() else ():
            parent, _, method = key.rpartition(".")
            if parent in shared:
                assert method in owners
                assert gate.keys() <= shared[parent].keys()
                found.append(key)
    assert "stress.energy.gbrdf" in found
