"""The examination of the machine, the choice of LLVM, and the system packages that mend it."""

import json
import subprocess
import threading

import pytest

from btfref import doctor, platform, system
from btfref.cli import main
from btfref.commands.doctor import lines
from btfref.errors import MissingDependencyError


@pytest.fixture(scope="module")
def examination():
    """One examination for all tests that only read it."""
    return doctor.examine()


def libraries(folder, *names):
    """Empty files that look like LLVM libraries."""
    for name in names:
        (folder / name).write_bytes(b"")
    return [str(folder / "libLLVM*.so*")]


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-15.0.6.so", 15),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-19.so", 19),
        ("libLLVM.so.20", 20),
        ("libLLVM.so", None),
        ("libclang.so.19", None),
    ],
)
def test_llvm_version_from_the_file_name(name, version, tmp_path):
    assert platform.llvm_version(tmp_path / name) == version


def test_llvm_version_of_a_link_is_that_of_its_target(tmp_path):
    libraries(tmp_path, "libLLVM.so.19.1")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.19.1")
    (tmp_path / "libLLVM-99.so").symlink_to("gone")
    assert platform.llvm_version(tmp_path / "libLLVM.so") == 19
    found = platform.find_llvm([str(tmp_path / "libLLVM*.so*")])
    assert [version for version, _ in found] == [19]


def test_old_llvm_is_never_chosen(tmp_path):
    found = platform.find_llvm(libraries(tmp_path, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"))
    choice = platform.choose_llvm({}, found)
    assert choice.path is None
    assert [version for version, _ in choice.refused] == [16, 15, 14]


def test_newest_llvm_is_chosen(tmp_path):
    found = platform.find_llvm(libraries(tmp_path, "libLLVM-15.so.1", "libLLVM-17.so.1", "libLLVM.so.19.1"))
    choice = platform.choose_llvm({}, found)
    assert choice.version == 19
    assert choice.path == str(tmp_path / "libLLVM.so.19.1")
    assert [version for version, _ in choice.refused] == [15]


def test_environment_names_the_llvm_unless_it_aborts(tmp_path):
    found = platform.find_llvm(libraries(tmp_path, "libLLVM-15.so.1", "libLLVM-17.so.1", "libLLVM.so.19.1"))

    def choose(name):
        return platform.choose_llvm({"DRJIT_LIBLLVM_PATH": str(tmp_path / name)}, found)

    assert choose("libLLVM-17.so.1").version == 17
    assert choose("libLLVM-15.so.1").version == 19
    assert "LLVM 15" in choose("libLLVM-15.so.1").reason
    assert choose("libLLVM-18.so.1").version == 19
    assert "not there" in choose("libLLVM-18.so.1").reason


def test_prepare_llvm_says_what_to_install(monkeypatch):
    choice = platform.LLVMChoice(None, None, "none found", ((15, "/somewhere/libLLVM-15.so.1"),))
    monkeypatch.setattr(platform, "choose_llvm", lambda: choice)
    with pytest.raises(MissingDependencyError, match=r"found 15, which abort.*libllvm19"):
        platform.prepare_llvm()


def test_shader_directory_holds_the_library():
    assert (platform.shader_directory() / "lib").is_dir()


def test_a_process_that_aborts_is_survived():
    result = doctor.probe("import os; os.abort()")
    assert result == {"works": False, "error": "the process died of signal 6"}


def test_a_process_that_hangs_is_survived(monkeypatch):
    monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 0.5)
    assert "no answer" in doctor.probe("import time; time.sleep(60)")["error"]


def test_a_probe_reports_the_first_cause():
    code = "try:\n  import no_such_module\nexcept ImportError:\n  undefined_name"
    assert doctor.probe(code)["error"] == "ModuleNotFoundError: No module named 'no_such_module'"
    assert doctor.probe("print('no json')")["error"] == "unreadable answer"
    assert doctor.probe("print('{\"a\": 1}')") == {"works": True, "a": 1}


def test_the_variants_render_here(examination, need):
    need("llvm")
    assert examination.facts["variants"]["llvm_ad_rgb"] == {"works": True, "finite": True}
    assert examination.facts["variants"]["scalar_rgb"] == {"works": True, "finite": True}
    assert examination.facts["llvm"]["version"] is None or examination.facts["llvm"]["version"] >= 17


def test_opengl_is_described_here(examination, need):
    need("gl")
    gl = examination.facts["gl"]
    assert gl["works"]
    assert gl["float_target"]
    assert gl["vendor"]
    assert gl["renderer"]
    assert gl["version"]


def test_webgl_is_described_here(examination, need):
    need("chromium")
    webgl = examination.facts["webgl"]
    assert webgl["works"]
    assert "SwiftShader" in webgl["webgl_renderer"]


@pytest.mark.parametrize(("program", "status"), [("/usr/bin/chromium", "warning"), (None, "absent")])
def test_webgl_is_optional(examination, program, status):
    broken = faulty(
        examination,
        webgl={"works": False, "error": "no WebGL 2 in this browser"},
        programs={"glslangValidator": None, "chromium": program},
    )
    (check,) = [check for check in broken.checks if check.name == "WebGL 2"]
    assert check.status == status
    assert bool(check.mend) == (status == "warning")


def test_probes_run_side_by_side(need, monkeypatch):
    """Each waits for all others: one after the other they would never meet."""
    need("llvm")
    count = len(doctor.VARIANTS) + 1 + (system.chromium() is not None)
    calls, all_here = [], threading.Barrier(count)

    def probe(*arguments, **_):
        calls.append(arguments)
        all_here.wait(timeout=60)
        return {"works": False, "error": "not looked at"}

    monkeypatch.setattr(doctor, "probe", probe)
    assert not doctor.examine().facts["gl"]["works"]
    assert len(calls) == count


def test_json_and_exit_status(need, capsys):
    need("llvm")
    need("gl")
    status = main(["doctor", "--json"])
    facts = json.loads(capsys.readouterr().out)
    assert status == (0 if facts["ok"] else 1)
    assert {"checks", "versions", "llvm", "variants", "gl", "webgl", "gpu", "machine", "programs"} <= set(
        facts
    )
    assert facts["versions"]["mitsuba"] == doctor.PINNED["mitsuba"]


def faulty(examination, **changes):
    """The examination with some of its facts replaced."""
    facts = {**examination.facts, **changes}
    return doctor.Examination(tuple(doctor._checks(facts)), facts)


@pytest.mark.parametrize(
    "changes",
    [
        {"llvm": {"chosen": None, "version": None, "reason": "none", "refused": []}},
        {"missing": ["libatomic"]},
        {"gl": {"works": False, "error": "no EGL"}},
        {"versions": {"mitsuba": None}},
        {"variants": {name: {"works": False, "error": "x"} for name in doctor.VARIANTS}},
        {"variants": {name: {"works": True, "finite": False} for name in doctor.VARIANTS}},
    ],
)
def test_what_is_missing_fails_and_has_a_mend(changes, examination, monkeypatch, capsys):
    broken = faulty(examination, **changes)
    assert not broken.ok
    assert all(check.mend for check in broken.checks if check.status == "missing")
    monkeypatch.setattr(doctor, "examine", lambda: broken)
    assert main(["doctor"]) == 1
    assert "missing." in capsys.readouterr().out


def test_optional_things_do_not_fail(examination):
    bare = faulty(
        examination,
        programs={"glslangValidator": None, "chromium": None},
        gpu=[],
        missing=[],
        versions={"mitsuba": "3.9.0"},
        variants={
            "llvm_ad_rgb": {"works": True, "finite": True},
            "scalar_rgb": {"works": True, "finite": True},
            "cuda_ad_rgb": {"works": False, "error": "no CUDA"},
        },
        gl={
            "works": True,
            "renderer": "r",
            "vendor": "v",
            "version": "4.5",
            "max_texture_size": 16384,
            "max_array_texture_layers": 2048,
            "float_target": True,
        },
    )
    assert bare.ok
    text = "\n".join(lines(bare))
    assert "pip install mitsuba==3.9.1" in text
    assert "glslang-tools" in text


def test_text_shows_every_check(examination):
    text = "\n".join(lines(examination, colour=False))
    assert [check.name for check in examination.checks if check.name not in text] == []
    assert "\x1b" not in text
    assert "\x1b[" in "\n".join(lines(examination, colour=True))


class FakeApt:
    """Stands in for subprocess.run; remembers commands and makes requirements appear."""

    def __init__(self, listing="libllvm15\nlibllvm19\nlibllvm21\n", sudo=0):
        self.commands, self.listing, self.sudo, self.installed = [], listing, sudo, False

    def __call__(self, command, **options):
        self.commands.append(command)
        self.installed = self.installed or "install" in command
        status = self.sudo if command == ["sudo", "-n", "true"] else 0
        output = self.listing if "pkgnames" in command else ""
        return subprocess.CompletedProcess(command, status, output, "W: old lists\nE: no space\n")


def requirements(apt):
    """An LLVM and a library that are there once `apt` has run."""
    return [
        system.Requirement("LLVM", (system.DEFAULT_LLVM_PACKAGE,), lambda: apt.installed),
        system.Requirement("libEGL", ("libegl1",), lambda: apt.installed),
    ]


def test_install_as_root(monkeypatch):
    apt = FakeApt()
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 0)
    assert system.install(requirements(apt), run=apt) == ["libllvm19", "libegl1"]
    assert not any("sudo" in command for command in apt.commands)
    assert system.install([], run=apt) == []


def test_install_with_sudo(monkeypatch):
    apt = FakeApt("libllvm18t64\nlibllvm17t64\n")
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 1000)
    assert system.install(requirements(apt), run=apt) == ["libllvm18t64", "libegl1"]
    assert apt.commands[-1][:2] == ["sudo", "-n"]


@pytest.mark.parametrize("programs", [(), ("apt-get",), ("apt-get", "sudo")])
def test_without_the_right_to_install_one_line_says_what(programs, monkeypatch):
    apt = FakeApt(sudo=1)
    monkeypatch.setattr(system.shutil, "which", lambda name: name if name in programs else None)
    monkeypatch.setattr(system.os, "geteuid", lambda: 1000)
    with pytest.raises(
        MissingDependencyError, match=r"LLVM, libEGL; run: sudo apt-get install .*libllvm19"
    ) as error:
        system.install(requirements(apt), run=apt)
    assert "\n" not in str(error.value)
    assert not apt.installed


def test_a_failed_installation_is_an_error(monkeypatch):
    apt = FakeApt()
    absent = [system.Requirement("libEGL", ("libegl1",), lambda: False)]
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 0)
    with pytest.raises(MissingDependencyError, match=r"E: no space; run: .*libegl1"):
        system.install(absent, run=apt)


def test_llvm_package():
    assert system.llvm_package("libllvm14\nlibllvm15\n") is None
    assert system.llvm_package("libllvm20\nlibllvm17t64\n") == "libllvm20"
    assert system.llvm_package("libllvm19\nlibllvm22\n") == "libllvm19"


def test_mend_installs_and_forgives_what_only_tests_need(monkeypatch, capsys):
    needed = system.Requirement("libEGL", ("libegl1",), lambda: False)
    wanted = system.Requirement("Chromium", ("chromium",), lambda: False, for_tests=True)
    installed = []

    def install(items):
        if items == [wanted]:
            raise MissingDependencyError("missing on this machine: Chromium", "run: …")
        installed.extend(items)
        return ["libegl1"]

    monkeypatch.setattr(system, "missing", lambda tests=False: [wanted] if tests else [needed])
    monkeypatch.setattr(system, "install", install)
    assert main(["doctor", "--mend", "--for-tests"]) == 0
    captured = capsys.readouterr()
    assert installed == [needed]
    assert "installed libegl1" in captured.out
    assert "skipped" in captured.err


def test_nothing_missing_is_silent(monkeypatch, capsys):
    monkeypatch.setattr(system, "missing", lambda tests=False: [])
    assert main(["doctor", "--mend", "--for-tests"]) == 0
    assert capsys.readouterr() == ("", "")
