"""No verdict outlives what it was made from: edited code, tampered results, other limits."""

import json
import shutil

import pytest

from btfref.gates import tolerances
from btfref.provenance import code
from btfref.registry import methods
from btfref.validate.injected.edits import EDITS, GUEST, SETTINGS, VIEW, Copy, Edit, copied
from btfref.validate.matrix import Spec
from btfref.validate.run import validate
from btfref.validate.self_test import edit_test

pytestmark = pytest.mark.usefixtures("renderers")

#: A fast fit, of which the views that methods share have nothing.
METHOD = "lpca"


def run(cache):
    mesostructure, scene, lights = VIEW
    spec = Spec(mesostructure, METHOD, scene, lights)
    return validate([spec], settings=SETTINGS, cache=cache, workers=1)


@pytest.fixture(scope="module")
def green(tmp_path_factory):
    """A cache that a run without failures has filled."""
    cache = tmp_path_factory.mktemp("green") / "cache"
    found = run(cache)
    assert [(name, gate.line) for name, gate in found.failed_gates] == []
    assert found.computed == found.jobs == 5
    return cache


@pytest.fixture
def cache(green, tmp_path):
    return shutil.copytree(green, tmp_path / "cache")


def entry(cache, suffix):
    (path,) = cache.glob(f"*{suffix}")
    return path


def test_what_is_there_is_not_computed_again(cache):
    before = sorted((path.name, path.stat().st_mtime_ns) for path in cache.iterdir())
    found = run(cache)
    assert found.passed
    assert found.computed == 0
    assert sorted((path.name, path.stat().st_mtime_ns) for path in cache.iterdir()) == before


def empty(path):
    path.write_bytes(b"")


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("turn", [0, *(pytest.param(n, marks=pytest.mark.long) for n in (1, 2))])
def test_nine_tamperings(cache, turn):
    """Pictures that cells share, a cell, a method's checks, each in three ways: made again, and nothing else."""
    suffixes, tamperings = (".views.npz", ".cell.npz", ".checks.json"), (empty, cut, flipped)
    paths = [entry(cache, suffix) for suffix in suffixes]
    for place, path in enumerate(paths):
        tamperings[(place + turn) % 3](path)
    broken = [path.read_bytes() for path in paths]
    stems = tuple(path.name for path in paths)
    kept = {p.name: p.stat().st_mtime_ns for p in cache.iterdir() if not p.name.startswith(stems)}
    found = run(cache)
    assert found.passed
    assert found.computed == 2  # the views, and the method with its cell and its checks
    assert all(path.read_bytes() != bytes_ for path, bytes_ in zip(paths, broken, strict=True))
    assert {p.name: p.stat().st_mtime_ns for p in cache.iterdir() if p.name in kept} == kept


@pytest.mark.long
def test_materials_fits_and_written_numbers_are_made_again(cache):
    """And numbers that somebody wrote into the checks, large ones, which a stored verdict would have let through."""
    checks = entry(cache, ".checks.json")
    facts = json.loads(checks.read_text("utf-8"))
    for gate in facts["measured"]:
        gate["value"] = 123456
    checks.write_text(json.dumps(facts), "utf-8")
    largest = []
    for suffix in (".0.btf.zarr", f".{METHOD}.exr"):
        path = entry(cache, suffix)
        files = [p for p in [path, *path.rglob("*")] if p.is_file()]
        largest.append(max(files, key=lambda p: p.stat().st_size))
    before = [path.read_bytes() for path in largest]
    for path in largest:
        flipped(path)
    found = run(cache)
    assert found.passed
    assert found.computed == 2
    assert all(gate["value"] != 123456 for gate in found.methods[0]["gates"])
    assert [path.read_bytes() for path in largest] == before


def test_verdicts_are_found_by_the_limits_of_today(cache, monkeypatch):
    """Stored numbers alone: a limit that they do not meet fails them without anything being measured."""
    strict = {key: dict(gate) for key, gate in tolerances._gates().items()}
    strict["sample.weight"]["max"] = 0.0
    strict["image.noise_free"]["max"] = 0.0
    monkeypatch.setattr(tolerances, "_gates", lambda: strict)
    found = run(cache)
    assert found.computed == 0
    assert {gate.name for _, gate in found.failed_gates} == {"sample.weight.max", "image.noise_free.max"}


@pytest.mark.long
def test_several_processes_count_what_they_compute(cache):
    entry(cache, ".cell.npz").unlink()
    mesostructure, _, lights = VIEW
    specs = [Spec(mesostructure, METHOD, scene, lights) for scene in ("plane", VIEW[1])]
    found = validate(specs, settings=SETTINGS, cache=cache, workers=2)
    # The views of the plane and both cells, in one job; the material and the other views are there.
    assert (found.computed, found.jobs) == (2, 6)
    assert validate(specs, settings=SETTINGS, cache=cache, workers=2).computed == 0


#: Modules that make results, and those that only call them.
STAGES = ("material", "stages.fits", "pictures", "cell", "stages.checks", "stages.off_grid")
CALLERS = {
    "btfref.validate.run",
    "btfref.validate.pool",
    "btfref.validate.injected",
    "btfref.validate.injected.edits",
}

#: A factor in a port that renders and probes see, and no fit.
EDIT = Edit(
    "a factor in a port",
    METHOD,
    "mitsuba_plugins/lpca.py",
    "return self._combine_distinct(",
    "return 1.1 * self._combine_distinct(",
)


def test_the_text_of_every_edit_stands_once(tmp_path):
    copy = Copy(tmp_path)
    for edit in (*EDITS, EDIT):
        with copy.edited(edit):
            assert (copy.folder / edit.file).read_text("utf-8").count(edit.wrong) == 1, edit.name


def test_an_edited_port_is_computed_anew_and_fails(cache):
    with copied(cache) as copy:
        clean = copy.run([METHOD])
        with copy.edited(EDIT):
            found = copy.run([METHOD])
    # The copy has the keys of what it was made of: nothing depends on where files lie.
    assert (clean.failed, clean.computed) == ((), 0)
    assert found.computed == 1
    assert EDIT.meant in found.failed

    # Nothing was run that the keys of the results do not hold.
    stages = [code.closure(f"btfref.validate.{stage}", (METHOD, "svd", "raw")) for stage in STAGES]
    files = {path for stage in stages for path in stage.files}
    assert len(found.loaded) > 100
    strange = {name for name in found.loaded if code.module_file(name) not in files}
    assert strange - CALLERS == set()


@pytest.mark.long
def test_every_edit_is_computed_anew_and_fails():
    assert len(EDITS) == 7
    assert {edit.method for edit in EDITS} - {GUEST} <= set(methods())
    found = list(edit_test(EDITS))
    assert [(one.name, one.failed, one.clean) for one in found if not one.caught] == []
