"""The board: what is handed in is checked, answers are judged, ranks have intervals, and the page works."""

import json

import numpy as np
import pytest
from browser import browse

from btfref.board import ranking, rows, site
from btfref.board.scoring import Truth, scored
from btfref.cli import main
from btfref.datasets import sets
from btfref.errors import InputError

MATERIALS = ("flat", "knit")
N = 400


def true_rows(material, footprint):
    """Rows of a package with a little noise, without a package."""
    rng = np.random.default_rng([len(material), len(footprint)])
    truth = 0.2 + rng.random((N, 3))
    halves = [truth + 0.01 * rng.standard_normal((N, 3)) for _ in range(2)]
    return {
        "first": halves[0],
        "second": halves[1],
        "B": 0.5 * (halves[0] + halves[1]),
        "variance": np.full((N, 3), 0.5e-4),
        "truth": truth,
    }


class Given:
    """A package as the board sees one."""

    def __init__(self, folder, material):
        self.path = folder
        self.material = material
        self.manifest = {
            "set_version": sets.SETS["btf-1"].version,
            "material": material,
            "difficulty": {
                "rank_1_percent": 3,
                "parallax": 0.1,
                "dynamic_range": 5.0,
                "indirect": 0.2,
                "hidden": 0.1,
            },
            "noise": {"4x9": 0.01},
        }

    def test(self, footprint):
        return true_rows(self.material, footprint)


@pytest.fixture(autouse=True)
def packages(monkeypatch, tmp_path):
    """A folder that stands for packages of the materials."""
    from btfref.images.png import encode_png

    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "picture.png").write_bytes(encode_png(np.zeros((4, 12, 3), np.uint8)))
    monkeypatch.setattr("btfref.board.scoring.open_package", lambda path: Given(folder, path.name))
    return folder


def hand_in(folder, name, spread, **changes):
    """Files of a row whose answers are off by so much."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(len(name))
    entries = {}
    for material in MATERIALS:
        truth = np.concatenate([true_rows(material, footprint)["truth"] for footprint in sets.FOOTPRINTS])
        values = truth + spread * rng.standard_normal(truth.shape)
        np.save(folder / f"{name}-{material}.npy", values.astype(np.float32))
        entries[material] = {"answers": f"{name}-{material}.npy", "bytes": 1000}
    facts = {
        "method": name,
        "setting": "",
        "set": "btf-1",
        "set_version": sets.SETS["btf-1"].version,
        "tier": "toy",
        "fitted": "grid 4x9",
        "by": "somebody",
        "materials": entries,
    }
    path = folder / f"{name}.row.json"
    rows.write_row(path, facts)
    path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | changes))
    return path


@pytest.mark.parametrize("spread", [0.02, 0.05])
def test_answers_are_judged_without_the_noise_of_the_truth(tmp_path, spread):
    path = hand_in(tmp_path / "in", "good", spread)
    (found,) = scored(rows.read_rows([path]), Truth(tmp_path))
    assert set(found) == set(MATERIALS)
    for footprints in found.values():
        assert set(footprints) == set(sets.FOOTPRINTS)
        for errors in footprints.values():
            _, low, high = errors["rmse"]
            assert low <= spread <= high
    path = hand_in(tmp_path / "in", "exact", 0.0)
    (found,) = scored(rows.read_rows([path]), Truth(tmp_path))
    assert found["flat"]["point"]["rmse"][1] == 0


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"kind": "something"}, "kind"),
        ({"schema": 7}, "schema"),
        ({"method": ""}, "method"),
        ({"tier": 3}, "tier"),
        ({"setting": "x" * 300}, "setting"),
        ({"link": "javascript:alert(1)"}, "link"),
        ({"materials": {}}, "materials"),
        ({"materials": {"flat": {"answers": "/etc/passwd"}}}, "materials.flat.answers"),
        ({"materials": {"flat": {"answers": "../other.npy"}}}, "materials.flat.answers"),
        ({"materials": {"flat": {"answers": "none.npy"}}}, "materials.flat.answers"),
        ({"materials": {"flat": {"answers": "m-flat.npy", "bytes": -1}}}, "materials.flat.bytes"),
        ({"evaluate_ns": {"numpy": "fast"}}, "evaluate_ns"),
    ],
)
def test_rows_that_cannot_be_used_are_named(tmp_path, changes, field):
    (tmp_path / "other.npy").write_bytes(b"")
    with pytest.raises(InputError) as error:
        rows.read_row(hand_in(tmp_path / "in", "m", 0.1, **changes))
    assert error.value.field == field


def test_answers_that_cannot_be_judged_are_named(tmp_path):
    path = hand_in(tmp_path / "in", "m", 0.1)
    answers = tmp_path / "in/m-flat.npy"
    for values in (
        np.zeros((7, 3), np.float32),
        np.full((3 * N, 3), np.nan, np.float32),
        np.zeros((3 * N, 3), int),
    ):
        np.save(answers, values)
        with pytest.raises(InputError, match="cannot be judged"):
            scored(rows.read_rows([path]), Truth(tmp_path))
    answers.write_bytes(b"no numbers")
    with pytest.raises(InputError, match="cannot be read"):
        scored(rows.read_rows([path]), Truth(tmp_path))
    path = hand_in(tmp_path / "in", "m", 0.1, set_version="0.9")
    with pytest.raises(InputError, match="another version"):
        scored(rows.read_rows([path]), Truth(tmp_path))


def errors_of(table, width=0.0):
    """Errors as the scores have them, of rows × materials."""
    return [
        {f"m{k}": {"point": {"nrmse": [x, x * (1 - width), x * (1 + width)]}} for k, x in enumerate(line)}
        for line in table
    ]


def test_ranks_and_their_intervals():
    """Rationale: what the board orders by. Expected: a method that is the best everywhere is surely first; two that
    change places are told as such; equal ones share a place; a row that left materials out has none.
    """
    found = ranking.ranked(errors_of([[1, 1, 1, 1], [2, 8, 2, 8], [8, 2, 8, 2], [16, 16, 16, 16]]))
    assert [row["place"] for row in found] == [1, 2, 2, 4]
    assert [(row["from"], row["to"]) for row in found] == [(1, 1), (2, 3), (2, 3), (4, 4)]
    assert found[0]["score"] == 1
    assert round(found[1]["score"], 6) == 4
    wide = ranking.ranked(errors_of([[1.0] * 4, [1.05] * 4], width=0.5))
    assert (wide[1]["from"], wide[1]["to"]) == (1, 2)
    partial = errors_of([[1, 1], [2, 2]])
    del partial[1]["m1"]
    found = ranking.ranked(partial)
    assert [row["place"] for row in found] == [1, None]
    assert found[1]["places"] == {"m0": 2}
    assert ranking.ranked([]) == []


def board(tmp_path, **changes):
    hand_in(tmp_path / "in", "good", 0.02)
    hand_in(tmp_path / "in", "bad", 0.2, **changes)
    return tmp_path / "in"


def test_the_command_writes_a_site(tmp_path, capsys):
    out = tmp_path / "site"
    arguments = ["board", str(board(tmp_path)), "--folder", str(tmp_path / "data"), "-o", str(out)]
    assert main([*arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rows"] == 2
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    assert found["bytes"] == size <= site.LARGEST.most
    places = {row["method"]: row["rank"]["point"]["place"] for row in found["board"]["rows"]}
    assert places == {"good": 1, "bad": 2}
    first = (out / "index.html").read_bytes()
    assert main(arguments) == 0
    assert (out / "index.html").read_bytes() == first
    assert "http" not in first.decode().replace("https://…", "").replace("http-equiv", "")


def test_text_of_others_is_no_code(tmp_path):
    evil = "</script><img src=x onerror=alert(1)>"
    site.write_site([board(tmp_path, by=evil)], tmp_path / "site", folder=tmp_path / "data")
    page = (tmp_path / "site/index.html").read_text("utf-8")
    assert evil not in page
    assert "\\u003c/script>" in page


def test_rows_of_two_tiers_make_no_board(tmp_path):
    with pytest.raises(InputError, match="several sets or tiers"):
        site.write_site([board(tmp_path, tier="standard")], tmp_path / "site", folder=tmp_path / "data")
    with pytest.raises(InputError, match="no rows"):
        site.write_site([tmp_path / "data"], tmp_path / "site", folder=tmp_path / "data")


#: What a reader does: sorts, filters, chooses a material; then what the page shows.
DRIVER = """<script>
const names = () => [...document.querySelectorAll("#table tbody tr")].map((r) => r.firstChild.firstChild.textContent);
const found = {first: names()};
const click = (key) => document.querySelector(`th[data-key=${key}] button`).click();
click("error"); click("error"); found.worst = names();
const say = (id, value) => {
  const e = document.getElementById(id);
  e.value = value; e.dispatchEvent(new Event("input"));
};
say("filter", "good"); found.filtered = names();
say("filter", ""); say("material", "knit"); found.facts = document.getElementById("facts").textContent;
found.pictures = document.querySelectorAll("#pictures img").length;
found.sorted = document.querySelector("th[data-key=error]").getAttribute("aria-sort");
found.wide = document.documentElement.scrollWidth;
found.inner = innerWidth;
parent.postMessage(JSON.stringify(found), "*");
</script>"""


@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_sorts_filters_and_fits(tmp_path, width, need):
    chromium = need("chromium")
    site.write_site([board(tmp_path)], tmp_path / "site", folder=tmp_path / "data")
    page = tmp_path / "site/index.html"
    page.write_text(page.read_text("utf-8").replace("</body>", DRIVER + "</body>"), "utf-8")
    found, console = browse(chromium, page, tmp_path / "profile", width)
    assert console == []
    assert found["first"] == ["good", "bad"]
    assert found["worst"] == ["bad", "good"]
    assert found["filtered"] == ["good"]
    assert found["sorted"] == "descending"
    assert "Rank for 1 % error 3" in found["facts"]
    assert found["pictures"] == 1
    assert found["wide"] <= found["inner"] == width
