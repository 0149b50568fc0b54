"""Packages that add methods and formats: what is broken costs itself alone, and is named; exporters are reached."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from btfref import registry
from btfref.cli import main
from btfref.errors import InputError
from btfref.formats import exporters, identify
from btfref.formats.source import Format
from btfref.numerics.sphere.directions import directions
from btfref.registry import Method, broken_points, method, methods, usable_methods
from btfref.sampling import SampledBTF

CACHED = (registry.points.usable_points, registry.methods, registry._all_methods, registry._unloadable)


class Point:
    """An entry point of a package that is not installed."""

    def __init__(self, group, name, load):
        self.group, self.name, self.value, self.load = group, name, f"{name}:ROW", load
        self.dist = SimpleNamespace(name=f"package-of-{name}", version="1.2")


def fails(error):
    def load():
        raise error

    return load


def export(btf, path, *, level=0, progress=None):
    """Write one number."""
    path.write_text(json.dumps({"level": level, "views": len(btf.views)}))
    return {"format": "mine", "level": level}


def recognises(candidate):
    raise RuntimeError("this package is broken")


MINE = Format("mine", "mine", lambda _: False, None, export=export, settings=frozenset(["level"]))
BAD = Format("bad", "bad", recognises, None)
POINTS = [
    Point("btfref.representations", "gone", fails(ImportError("no module named 'gone'"))),
    Point("btfref.representations", "exits", fails(SystemExit(3))),
    Point("btfref.representations", "odd", lambda: {"key": "odd"}),
    Point("btfref.representations", "twice", lambda: Method("raw", "t", "p", "x.y", "x.z", "x.glsl")),
    Point(
        "btfref.representations", "empty", lambda: Method("empty", "t", "p", "gone.fit", "gone.p", "g.glsl")
    ),
    Point("btfref.formats", "mine", lambda: MINE),
    Point("btfref.formats", "bad", lambda: BAD),
    Point("btfref.formats", "lost", fails(OSError("cannot read"))),
]


@pytest.fixture
def packages(monkeypatch):
    def found(*, group, name=None):
        return [point for point in POINTS if point.group == group and name in (None, point.name)]

    for cached in CACHED:
        cached.cache_clear()
    own = set(methods())
    for cached in CACHED:
        cached.cache_clear()
    monkeypatch.setattr(registry.points, "entry_points", found)
    yield own
    for cached in CACHED:
        cached.cache_clear()


def test_what_is_broken_costs_itself_alone(packages):
    assert set(methods()) >= {"raw", "lpca", "gbrdf"}
    assert method("raw").module == "btfref.representations.tabulated.raw"
    assert set(usable_methods()) == packages - {"tinted_brdf"}
    said = {point.name: str(point) for point in broken_points()}
    assert set(said) == {"gone", "exits", "odd", "twice", "empty", "lost"}
    for name, text in said.items():
        assert f"package-of-{name} 1.2" in text
    with pytest.raises(InputError, match="package-of-gone"):
        method("gone")


def test_doctor_and_help_name_it(packages, capsys):
    from btfref import doctor

    checks = list(doctor._package_checks([vars(point) for point in broken_points()]))
    assert {check.status for check in checks} == {"warning"}
    assert any("package-of-gone 1.2" in check.value for check in checks)
    assert main(["fit", "--help"]) == 0
    assert "package-of-gone" in capsys.readouterr().out


def test_exporters_of_packages_are_reached(packages, tmp_path, capsys):
    grid = directions("2x4")
    SampledBTF(np.ones((8, 8, 2, 2, 3), np.float32), grid, grid, None, {}).save(tmp_path / "x.btf.zarr")
    assert "mine" in exporters()
    command = ["export", str(tmp_path / "x.btf.zarr"), "--format", "mine", "-o", str(tmp_path / "out")]
    assert main([*command, "--set", "level=3"]) == 0
    assert json.loads((tmp_path / "out").read_text()) == {"level": 3, "views": 8}
    capsys.readouterr()
    assert main([*command[:-1], str(tmp_path / "other"), "--set", "height=3"]) == 2
    assert "level" in capsys.readouterr().err
    # A format that fails at a file is passed over.
    (tmp_path / "nothing.bin").write_bytes(b"nothing")
    assert identify(tmp_path / "nothing.bin") is None
