"""The command line: start-up, help, argument reading, exit status, and one small chain through it."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from btfref.cli import build_parser, main
from btfref.commands import COMMANDS
from btfref.commands.shared import images, printing, reading
from btfref.errors import BtfrefError, InputError, MissingDependencyError
from btfref.gates import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.provenance import LLVM, __version__, versions
from btfref.registry import method


def run(*arguments, **options):
    """``python -m btfref`` in a process of its own."""
    command = [sys.executable, "-m", "btfref", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def loaded(statement):
    """The modules that a statement brings in, one to a line, in a process of its own."""
    code = (
        f"import sys\nbefore = set(sys.modules)\n{statement}\n"
        "print(*sorted(set(sys.modules) - before), sep='\\n', file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stderr.split()


def foreign(modules):
    """Packages that are neither the standard library's nor ours."""
    return {name.split(".")[0] for name in modules} - set(sys.stdlib_module_names) - {"btfref"}


@pytest.mark.parametrize(
    "arguments", [["--help"], *([command, "--help"] for command in COMMANDS)], ids=" ".join
)
def test_help_is_immediate(arguments):
    modules = loaded(f"from btfref.cli import main\nassert main({arguments}) == 0")
    assert foreign(modules) == set()
    assert len(modules) <= tolerance("cli.start.modules")


def test_the_count_of_modules_can_fail():
    modules = loaded("import numpy")
    assert foreign(modules) == {"numpy"}
    assert len(modules) > 100


@pytest.mark.parametrize(
    "statement",
    ["import btfref", "import btfref.cli; btfref.cli.build_parser()", "import btfref.demo, btfref.doctor"],
)
def test_import_brings_in_no_other_package(statement):
    assert foreign(loaded(statement)) == set()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: btfref {command}")
    assert max(map(len, text.splitlines())) <= 120


def test_help_lists_every_command(capsys):
    assert main(["--help"]) == 0
    words = capsys.readouterr().out.split()
    assert [name for name in COMMANDS if name not in words] == []


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"btfref {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ([], "COMMAND"),
        (["nonsense"], "nonsense"),
        (["synth", "checker"], "--output"),
        (["synth", "checker", "-o", "x.btf.zarr", "--texels", "many"], "--texels"),
        (["render", "plane", "-o", "x.exr", "--size", "640"], "--size"),
        (["render", "plane", "-o", "x.exr", "--size", "0x4"], "--size"),
        (["realtime", "plane", "-o", "x.exr", "--grid", "0"], "--grid"),
    ],
)
def test_usage_errors_are_one_line(arguments, word, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("btfref: error: ")
    assert captured.err.count("\n") == 1
    assert word in captured.err


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (
            InputError("bad", file="f.exr", got=1, expected=2),
            2,
            "btfref: error: f.exr: bad; got 1; expected 2\n",
        ),
        (MissingDependencyError("no LLVM", "install it"), 2, "btfref: error: no LLVM; install it\n"),
        (BtfrefError("two\nlines"), 2, "btfref: error: two lines\n"),
        (PermissionError(13, "Permission denied", "/x"), 2, "btfref: error: /x: Permission denied\n"),
        (KeyboardInterrupt(), 130, "\nbtfref: interrupted\n"),
    ],
)
def test_exit_status_of_errors(error, status, text, monkeypatch, capsys):
    def fail(path):
        raise error

    monkeypatch.setattr("btfref.commands.info.read", fail)
    assert main(["info", "x"]) == status
    assert capsys.readouterr().err == text


def test_a_bug_keeps_its_traceback(monkeypatch, tmp_path, capsys):
    """In a file that the one line names."""
    monkeypatch.setattr("btfref.commands.info.read", lambda path: 1 / 0)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["info", "x"]) == 70
    line = capsys.readouterr().err
    (details,) = tmp_path.iterdir()
    assert line.startswith("btfref: error: internal error, please report it: ZeroDivisionError")
    assert line.endswith(f"details: {details}\n")
    assert "Traceback" in details.read_text()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert main(["info", "x"]) == 70
    assert "test_cli.py" in capsys.readouterr().err


def test_a_reader_that_leaves_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "btfref", "info", "--json", "tests/data"],
            stdout=writing,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.getcwd()},
            timeout=60,
        )
        broken = subprocess.run(
            [
                sys.executable,
                "-c",
                "from btfref.cli import main; import btfref.commands.info as i, sys\n"
                "i.read = lambda path: {'kind': 'x' * 100000}\nsys.exit(main(['info', 'x']))",
            ],
            stdout=writing,
            stderr=subprocess.PIPE,
            timeout=60,
        )
    finally:
        os.close(writing)
    assert done.returncode == 2  # a folder that is no store: the error still arrives
    assert broken.returncode == 141
    assert broken.stderr == b""


def test_assignments_read_json_where_it_is_json():
    given = ["a=1", "b=0.5", "c=true", "d=text", "e=[1, 2]", "f=x=y", "g="]
    expected = {"a": 1, "b": 0.5, "c": True, "d": "text", "e": [1, 2], "f": "x=y", "g": ""}
    assert reading.assignments(given) == expected
    assert reading.assignments(["a=1"], convert=str) == {"a": "1"}
    assert reading.assignments(None) == {}


@pytest.mark.parametrize("items", [["a"], ["=1"], ["a b=1"], ["a=1", "a=2"]])
def test_assignments_refuse(items):
    with pytest.raises(InputError, match="--set"):
        reading.assignments(items)


def test_direction_files_are_in_degrees(tmp_path):
    ubo = directions("ubo81")
    path = tmp_path / "set.csv"
    rows = [f"{theta:.12f}, {phi:.12f}" for theta, phi in np.rad2deg([ubo.theta, ubo.phi]).T]
    path.write_text("# theta, phi\n" + "\n".join(rows) + "\n\n")
    read = directions(reading.direction_set(str(path)))
    np.testing.assert_array_equal(np.round(read.vectors - ubo.vectors, 9), 0)
    assert reading.direction_set("10x5") == "10x5"


@pytest.mark.parametrize("text", ["", "1 2\n3\n", "1 2 3\n", "a b\n", "nan 0\n"])
def test_bad_direction_files(text, tmp_path):
    path = tmp_path / "set.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"set\.txt"):
        reading.direction_set(str(path))


def test_tables_align():
    lines = printing.table([["a", "1.5"], ["long", "12"]], header=["", "n"])
    assert lines == ["        n", "────  ───", "a     1.5", "long   12"]
    assert printing.table([]) == []


def test_bytes_for_readers():
    assert printing.bytes_text(1000) == "1 000 bytes"
    assert printing.bytes_text(17694720) == "16.9 MiB (17 694 720 bytes)"


@pytest.mark.parametrize(("delay", "labels"), [(2.0, []), (0.0, ["one", "two"])])
def test_progress_bar_waits_and_follows_labels(delay, labels, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr(printing.Progress, "delay", delay)
    with printing.Progress() as progress:
        for label in ("one", "two"):
            for done in range(4):
                progress(done, 3, label)
    shown = capsys.readouterr().err
    assert [label for label in ("one", "two") if label in shown] == labels


def test_classes_survive_a_file(tmp_path):
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4) % 3
    images.save_classes(tmp_path / "c.png", classes)
    np.testing.assert_array_equal(images.load_classes(tmp_path / "c.png"), classes)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.png"]


def test_fit_parameters():
    row = method("lpca")
    assert row.settings(None, {"clusters": 3}) == {"clusters": 3}
    paper = row.settings("paper", {"clusters": 3})
    assert paper == {**row.presets["paper"], "clusters": 3}
    with pytest.raises(InputError, match=r"cluster_count.*clusters"):
        row.settings(None, {"cluster_count": 3})
    with pytest.raises(InputError, match="paper"):
        row.settings("papers", {})


def test_versions_name_what_is_not_installed():
    found = versions(["numpy", "no-such-distribution"])
    assert {"scikit-learn", "PyMaxflow", LLVM} <= set(versions())
    assert found["numpy"] == np.__version__
    assert found["no-such-distribution"] is None
    assert found["btfref"] == __version__


def test_parser_runs_are_commands():
    args = build_parser().parse_args(["info", "x", "--json"])
    assert callable(args.run)
    assert args.json


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A tiny synthesized BTF, made through the command line."""
    path = tmp_path_factory.mktemp("cli") / "tiny.btf.zarr"
    options = ["--texels", "4", "--views", "2x4", "--lights", "2x4", "--spp", "2", "--seed", "5"]
    assert main(["synth", "checker", "-o", str(path), *options, "--set", "resolution=16"]) == 0
    return path


def test_synth_and_info(store, need, capsys):
    need("llvm")
    capsys.readouterr()
    assert main(["info", str(store), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["shape"] == [8, 8, 4, 4, 3]
    assert facts["parent"]["parameters"]["resolution"] == 16
    assert facts["seed"] == 5
    assert main(["info", str(store)]) == 0
    assert "8 × 8 × 4 × 4 × 3" in capsys.readouterr().out


def test_synth_again_changes_nothing(store, capsys):
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()}
    options = ["--texels", "4", "--views", "2x4", "--lights", "2x4", "--spp", "2", "--seed", "5"]
    assert main(["synth", "checker", "-o", str(store), *options, "--set", "resolution=16"]) == 0
    assert main(["synth", "checker", "-o", str(store), "--texels", "5"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("key", ["raw", "svd", "lpca"])
def test_fit_and_info(key, store, tmp_path, capsys):
    out = tmp_path / f"tiny.{key}.exr"
    assert main(["fit", key, str(store), "-o", str(out), "--preset", "paper"]) == 0
    capsys.readouterr()
    assert main(["info", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["method"] == key
    wanted = (
        "kind method shape directions payload_bytes file_bytes raw_bytes ratio parameters parent versions"
    )
    assert set(wanted.split()) <= set(facts)
    assert facts["file_bytes"] == out.stat().st_size
    assert main(["info", str(out)]) == 0


def test_info_reads_headers_only(store, tmp_path, monkeypatch, capsys):
    """Rationale: files may be larger than memory. Expected: values damaged behind the header go unnoticed."""
    out = tmp_path / "tiny.raw.exr"
    assert main(["fit", "raw", str(store), "-o", str(out)]) == 0
    content = bytearray(out.read_bytes())
    content[-200:] = bytes(200)
    out.write_bytes(content)
    assert main(["info", str(out)]) == 0


def test_compare_prints_gates_and_decides(tmp_path, capsys):
    from btfref.images import save_image

    rng = np.random.default_rng(3)
    image = rng.random((16, 16, 3)).astype(np.float32) + 0.1
    for name, factor in (("a", 1.0), ("b", 1.0), ("c", 1.5)):
        save_image(tmp_path / f"{name}.exr", image * factor)
    a, b, c = (str(tmp_path / f"{name}.exr") for name in "abc")
    assert main(["compare", b, a, "--gate", "image.noise_free"]) == 0
    assert re.search(
        r"^image\.noise_free +interior\+edge, 100\.0 % .* ≤ 0\.001 +pass$",
        capsys.readouterr().out,
        re.MULTILINE,
    )
    assert main(["compare", c, a, "--gate", "image.noise_free"]) == 1
    assert "FAIL  image.noise_free" in capsys.readouterr().out
    assert main(["compare", c, a]) == 0
    capsys.readouterr()
    assert main(["compare", c, a, "--gate", "image.noise_free", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert not facts["passed"]
    images.save_classes(tmp_path / "k.png", np.zeros((16, 16), np.uint8))
    assert main(["compare", b, a, "--classes", str(tmp_path / "k.png"), "--gate", "image.noise_free"]) == 1


def test_rows_of_gates_name_measure_class_and_limit():
    from btfref.commands import compare, demo
    from btfref.comparison import compare as compared
    from btfref.demo import DemoResult
    from btfref.report import Cell

    truth = np.random.default_rng(0).uniform(0.2, 0.4, (8, 8, 3))
    geometry = compared(truth * 1.1, truth, gate="geometry.image")
    exact = compared(truth * (1 + 4e-4), truth, gate="image.noise_free")
    cells = [Cell("raw against geometry", {}, geometry), Cell("sphere", {}, exact), Cell("nothing")]
    lines = list(demo.lines(DemoResult(cells, "report.html", {"fit": 1.0})))
    rows = [" ".join(line.split()) for line in lines]
    assert rows[0].split() == ["cell", "gate", "pixels", "measure", "value", "limit"]
    assert rows[2] == "raw against geometry geometry.image interior, 100.0 % bias / mean 0.1 ≤ 0.2 pass"
    assert (
        rows[3] == "sphere image.noise_free interior+edge, 100.0 % 99.9 % relative error 0.0004 ≤ 0.001 pass"
    )
    assert rows[4].endswith("FAIL")
    shown = [" ".join(line.split()) for line in compare.lines(exact)]
    assert "gate pixels measure value limit" in shown
    assert "image.noise_free interior+edge, 100.0 % largest relative error 0.0004 ≤ 0.01 pass" in shown


def test_a_fault_names_the_class_of_pixels_that_its_gate_judges():
    from btfref.validate.self_test import Caught

    limits = ("image.noise_free.p999", "probe.agreement.max")
    assert Caught("x", limits[0], True, limits, ()).row == [
        *("x", "image.noise_free.p999 [interior+edge]", "caught"),
        "image.noise_free.p999 [interior+edge], probe.agreement.max",
    ]


def test_the_margin_of_demand_is_in_degrees(monkeypatch, capsys):
    found = {}
    monkeypatch.setattr("btfref.scene.demand.demand", lambda scene, **given: found.update(given) or {})
    assert main(["demand", "plane", "--views", "ubo81", "--margin", "90"]) == 2  # nothing was found
    assert found["margin"] == np.pi / 2


def test_info_of_images(tmp_path, capsys):
    from btfref.images import save_image

    for suffix in (".exr", ".png"):
        save_image(tmp_path / f"x{suffix}", np.ones((3, 5, 3)))
        assert main(["info", str(tmp_path / f"x{suffix}"), "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["size"] == [5, 3]
        assert sorted(facts["channels"]) == ["B", "G", "R"]
