"""Packages of data sets: made, resumed, equal byte for byte, checked, opened; a tiny tier of two materials."""

import inspect
import json
import shutil
import tarfile

import numpy as np
import pytest

import btfref
from btfref.cli import main
from btfref.datasets import sets, verifying
from btfref.datasets.difficulty import noise, rank
from btfref.datasets.making import make, place
from btfref.datasets.manifest import BEGUN, MANIFEST, files_of, read_manifest
from btfref.datasets.truth import MAPS
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import _CATALOGUE, names
from btfref.querying import distribute
from btfref.querying.job import QueryJob

pytestmark = pytest.mark.usefixtures("llvm")

TINY = sets.Tier(2, ("1x3", "2x3"), 2, 12, 4, 16, 2, 4, 4)
RHO = [0.60, 0.42, 0.25]


@pytest.fixture(scope="module")
def tiny():
    """The set with a tier for tests."""
    known = sets.SETS["btf-1"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            sets.SETS, "btf-1", sets.DataSet("btf-1", known.version, known.materials, {"toy": TINY})
        )
        # What is published is another tier of that name.
        patch.setattr(verifying, "published_of", lambda name: {})
        yield


@pytest.fixture(scope="module")
def data(tiny, tmp_path_factory):
    """A folder with the package of the flat material; not to be changed."""
    folder = tmp_path_factory.mktemp("data")
    make("flat", folder)
    return folder


@pytest.fixture
def copied(data, tmp_path):
    shutil.copytree(data, tmp_path / "data")
    return tmp_path / "data"


def contents(folder):
    return {name: (folder / name).read_bytes() for name in [*files_of(folder), MANIFEST]}


def test_the_set_has_twelve_materials_and_more_that_can_be_built():
    materials = sets.SETS["btf-1"].materials
    assert len(materials) >= 12
    assert {one.mesostructure for one in materials} <= set(names())
    for one in materials:
        assert set(one.parameters) <= set(inspect.signature(_CATALOGUE.load(one.mesostructure)).parameters)
        assert one.difficulty.endswith(".")


@pytest.mark.long
def test_an_interrupted_run_ends_with_the_same_bytes(data, tmp_path):
    """Rationale: packages are resumed, and their bytes are what is published. Expected: wherever a run stops, the next
    one ends with the bytes of one that did not; nothing half done looks like a package.
    """
    calls = []

    def stop(done, total, label):
        calls.append(label)
        if len(calls) in (3, 8):
            raise KeyboardInterrupt

    where = place(tmp_path, sets.SETS["btf-1"], "toy", sets.SETS["btf-1"].material("flat"))
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            make("flat", tmp_path, progress=stop)
        assert (where / BEGUN).exists()
        with pytest.raises(InputError, match="not finished"):
            read_manifest(where)
    make("flat", tmp_path, progress=stop)
    assert contents(where) == contents(data / "btf-1/toy/flat")
    assert not list(where.rglob("*.partial"))
    # What is there stays as it is.
    before = (where / MANIFEST).stat().st_mtime_ns
    make("flat", tmp_path)
    assert (where / MANIFEST).stat().st_mtime_ns == before


def test_a_package_holds_the_truth_of_a_plane(data):
    package = btfref.dataset("btf-1/flat", folder=data, make=False)
    assert package.grids == ("1x3", "2x3")
    assert package.grid().values.shape == (6, 6, 2, 2, 3)
    limit = tolerance("queries.flat.relative")
    for footprint in sets.FOOTPRINTS:
        rows = package.test(footprint)
        expected = np.array(RHO) / np.pi * rows["w_light"][:, 2:]
        assert (np.abs(rows["B"] - expected) <= limit * expected).all()
        assert (rows["samples"] == 8).all()
        assert rows["w_light"][:, 2].min() > 0
    assert package.training().n == 16
    for name, width in {"normal": 3, "albedo": 3, "direct": 3, "indirect": 3}.items():
        assert package.map(name).shape == (4, 4, width)
    assert (package.map("height") == 0).all()
    assert (package.map("normal") == [0, 0, 1]).all()
    assert (package.map("visibility") == 1).all()
    assert (package.map("indirect") == 0).all()
    for name in ("albedo", "direct"):
        assert (np.abs(package.map(name) - RHO) <= limit).all()
    assert set(MAPS) == {path.stem for path in (package.path / "maps").iterdir()}
    assert package.manifest["difficulty"]["rank_1_percent"] == 1
    assert package.manifest["difficulty"]["hidden"] == 0
    assert package.mesostructure().parameters["reflectance"] == RHO


def test_a_package_says_what_it_is(data):
    where = data / "btf-1/toy/flat"
    manifest = read_manifest(where)
    assert manifest["licence"] == "CC0-1.0"
    assert manifest["settings"]["texels"] == 2
    assert set(manifest["files"]) == set(files_of(where))
    described = json.loads((where / "croissant.json").read_text("utf-8"))
    ids = {entry["@id"]: entry for entry in described["distribution"]}
    assert ids["maps/height.npy"]["sha256"] == manifest["files"]["maps/height.npy"]["sha256"]
    assert ids["grids/2x3.btf.zarr"]["@type"] == "cr:FileSet"
    assert "CC0" in (where / "LICENCE.txt").read_text("utf-8")
    header = (where / "geometry/part_0.ply").read_bytes().split(b"end_header\n")[0]
    assert b"element vertex 4" in header


def _flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


FAULTS = {
    "flipped": (lambda p: _flip(p / "maps/albedo.npy"), "maps/albedo.npy: other bytes"),
    "short": (lambda p: (p / "picture.png").write_bytes(b""), "picture.png: 0 bytes"),
    "missing": (lambda p: (p / "geometry/part_0.ply").unlink(), "geometry/part_0.ply: missing"),
    "strange": (lambda p: (p / "more.txt").write_text("x"), "more.txt: not in the manifest"),
    "no manifest": (lambda p: (p / MANIFEST).unlink(), "no package"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_verify_finds_a_damaged_package(copied, fault, capsys):
    where = copied / "btf-1/toy/flat"
    assert main(["dataset", "verify", "--folder", str(copied)]) == 0
    spoil, words = FAULTS[fault]
    spoil(where)
    assert main(["dataset", "verify", "flat", "--folder", str(copied)]) == 1
    assert words in capsys.readouterr().out


def test_verify_finds_another_version(copied, monkeypatch, capsys):
    known = sets.SETS["btf-1"]
    newer = sets.DataSet("btf-1", "9.0.0", known.materials, known.tiers)
    monkeypatch.setitem(sets.SETS, "btf-1", newer)
    assert main(["dataset", "verify", "--folder", str(copied)]) == 1
    assert 'set_version is "1.0.0", expected "9.0.0"' in capsys.readouterr().out
    with pytest.raises(InputError, match="another version"):
        make("flat", copied)


def test_a_library_of_another_version_is_said_and_is_no_fault(copied, monkeypatch, capsys):
    monkeypatch.setattr("btfref.datasets.making.versions", lambda names: {"numpy": "99"})
    before = contents(copied / "btf-1/toy/flat")
    make("flat", copied)
    assert contents(copied / "btf-1/toy/flat") == before
    assert main(["dataset", "verify", "--folder", str(copied)]) == 0
    assert "here 99" in capsys.readouterr().out


@pytest.mark.long
def test_a_package_of_another_version_is_replaced_when_asked(copied, monkeypatch):
    known = sets.SETS["btf-1"]
    monkeypatch.setitem(sets.SETS, "btf-1", sets.DataSet("btf-1", "9.0.0", known.materials, known.tiers))
    make("flat", copied, overwrite=True)
    assert main(["dataset", "verify", "--folder", str(copied)]) == 0


def test_verify_compares_with_what_was_published(data, monkeypatch):
    """Rationale: another processor may round otherwise. Expected: equal digests are the same bytes; else the means of
    the true values decide, within their limit and no further.
    """
    manifest = read_manifest(data / "btf-1/toy/flat")
    limit = tolerance("dataset.published.relative")

    def told(digest, factor):
        means = {key: [factor * x for x in value] for key, value in manifest["means"].items()}
        known = {"toy": {"flat": {"digest": digest, "means": means}}}
        monkeypatch.setattr(verifying, "published_of", lambda name: known)
        (found,) = verifying.verify("flat", data)
        return found["published"], found["passed"]

    assert told(manifest["digest"], 1) == ("same bytes", True)
    assert told("other", 1 + limit / 2) == ("same values", True)
    assert told("other", 1 + 2 * limit) == ("other values", False)


def test_a_package_comes_out_of_an_archive_checked(data, tmp_path):
    packed = tmp_path / "btf.tar.gz"
    with tarfile.open(packed, "w:gz") as archive:
        archive.add(data / "btf-1", "btf-1")
    taken = btfref.dataset("btf-1/flat", folder=tmp_path / "new", archive=packed)
    assert contents(taken.path) == contents(data / "btf-1/toy/flat")
    zipped = shutil.make_archive(str(tmp_path / "btf"), "zip", data)
    taken = btfref.dataset("btf-1/flat", folder=tmp_path / "newer", archive=zipped)
    assert contents(taken.path) == contents(data / "btf-1/toy/flat")
    bad = tmp_path / "bad"
    shutil.copytree(data, bad)
    _flip(bad / "btf-1/toy/flat/picture.png")
    damaged = shutil.make_archive(str(tmp_path / "damaged"), "zip", bad)
    with pytest.raises(InputError, match="damaged package"):
        btfref.dataset("btf-1/flat", folder=tmp_path / "newest", archive=damaged)
    assert not (tmp_path / "newest/btf-1/toy/flat").exists()


def test_what_cannot_be_opened_is_said(data, tmp_path):
    for name, field in (("btf-9/flat", "NAME"), ("btf-1/silk", "NAME"), ("btf-1", "NAME")):
        with pytest.raises(InputError) as error:
            btfref.dataset(name, folder=data)
        assert error.value.field == field
    with pytest.raises(InputError, match="no such package"):
        btfref.dataset("btf-1/knit", folder=tmp_path, make=False)
    with pytest.raises(InputError, match="unknown tier"):
        btfref.dataset("btf-1/flat", folder=data, tier="huge")
    package = btfref.dataset("btf-1/flat", folder=data)
    for ask in (package.test, package.map, package.grid):
        with pytest.raises(InputError, match="no such"):
            ask("nothing")
    other = tmp_path / "btf-1/toy/flat"
    other.mkdir(parents=True)
    (other / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="other files"):
        make("flat", tmp_path)
    assert (other / "mine.txt").read_text() == "x"


def test_rank_and_noise_are_those_of_known_tables():
    """Rationale: cards state them. Expected: a table of rank three has it, and its noise is what it was given."""

    class Table:
        def __init__(self, values, variance):
            self.arrays = values, variance
            self.views, self.lights, self.texels = (
                range(len(values)),
                range(values.shape[1]),
                values.shape[2:4],
            )

        def read(self, *, views, lights=None, rows=None, columns=None):
            return tuple(array[np.atleast_1d(views)] for array in self.arrays)

    rng = np.random.default_rng(0)
    low = np.einsum("vlk,krcx->vlrcx", rng.random((5, 6, 3)), rng.random((3, 4, 4, 3)))
    assert rank(Table(low, np.zeros_like(low))) == 3
    sigma = 0.02 * np.sqrt((low**2).mean())
    noisy = low + sigma * rng.standard_normal(low.shape)
    assert rank(Table(noisy, np.full_like(low, sigma**2))) == 3
    assert rank(Table(noisy, np.zeros_like(low))) > 3
    assert round(noise(Table(low, np.full_like(low, sigma**2))), 3) == 0.02


def test_cards_and_lists(data, capsys):
    assert main(["dataset", "list", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["name"] == "btf-1"
    assert main(["dataset", "card", "--folder", str(data)]) == 0
    said = capsys.readouterr().out
    assert "# btf-1/flat" in said
    assert "rank for 1 % error: 1" in said


def test_rows_of_the_suite_reach_the_board(data, tmp_path, capsys):
    """Rationale: what the suite measures and what others hand in go the same way. Expected: a plan's rows are judged,
    and a second run adds to them.
    """
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'measures = ["build"]\n[[method]]\nkey = "raw"\n[[method]]\nkey = "svd"\nbuild = [{components = 1}]\n'
    )
    out = tmp_path / "rows"
    arguments = [
        "bench",
        str(plan),
        "--dataset",
        "btf-1/flat",
        "--folder",
        str(data),
        "-o",
        str(out),
        "--json",
    ]
    assert main(arguments) == 0
    names = json.loads(capsys.readouterr().out)
    assert [json.loads((tmp_path / name).read_text())["method"] for name in names] == ["raw", "svd"]
    kept = json.loads((out / "raw.row.json").read_text())
    kept["materials"]["knit"] = kept["materials"]["flat"]
    (out / "raw.row.json").write_text(json.dumps(kept))
    assert main(arguments) == 0
    assert set(json.loads((out / "raw.row.json").read_text())["materials"]) == {"flat", "knit"}
    (out / "raw.row.json").write_text(json.dumps(kept | {"materials": {"flat": kept["materials"]["flat"]}}))
    capsys.readouterr()
    assert main(["board", str(out), "--folder", str(data), "-o", str(tmp_path / "site"), "--json"]) == 0
    board = json.loads(capsys.readouterr().out)["board"]
    assert [row["name"] for row in board["rows"]] == ["raw", "svd · components 1"]
    for row in board["rows"]:
        entry = row["materials"]["flat"]
        # A plane of the least albedo 0.25 and the largest 0.6: no evaluator makes light or loses all of it.
        assert 0 < entry["energy"] < 1
        assert entry["errors"]["point"]["nrmse"][0] < 1
        assert (tmp_path / "site" / entry["picture"]).is_file()


def test_the_second_half_is_of_other_random_numbers_whoever_makes_it(tmp_path):
    """Rationale: two halves of one stream would take no noise out. Expected: their files differ in nothing but the
    stream, workers make the same one, and answers differ.
    """
    settings = {"n": 64, "spp": 2, "resolution": 16}
    first, second = (QueryJob.of("checker", None, settings, stream=stream) for stream in (0, 1))
    assert second.attributes == first.attributes | {"stream": 1}
    distribute._write(tmp_path / "order", second)
    assert distribute.read_order(tmp_path / "order").stream == 1
    rows = []
    for job in (first, second):
        with job.ready():
            rows.append(job.rows(job.make_source(), 0, 64))
    assert np.array_equal(rows[0]["uv"], rows[1]["uv"])
    assert not np.array_equal(rows[0]["B"], rows[1]["B"])
