"""The wheel: it holds all that btfref needs and works away from the checkout; pins agree with one another."""

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from btfref.doctor import PINNED
from btfref.provenance import RELEVANT, __version__

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def call(*command, **options):
    """Run a command and fail with what it said."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, built offline."""
    folder = tmp_path_factory.mktemp("wheel")
    call(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), cwd=ROOT)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the wheel installed, and how to run Python with it in place of the checkout."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    call(*pip, str(folder), str(wheel))

    def python(*arguments):
        # PYTHONPATH comes before the editable installation's path.
        return call(
            sys.executable, *arguments, cwd=folder.parent, env={**os.environ, "PYTHONPATH": str(folder)}
        )

    python.folder = folder
    return python


def files(folder, *suffixes):
    """Names of the files below a folder of the checkout, caches left out."""
    found = (ROOT / folder).rglob("*")
    return sorted(
        path.relative_to(ROOT).as_posix()
        for path in found
        if path.is_file()
        and "__pycache__" not in path.parts
        and not path.is_relative_to(
            ROOT / "btfref" / "docs"
        )  # the site's sources: nothing needs them at run time
        and (not suffixes or path.suffix in suffixes)
    )


def test_wheel_holds_everything(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    shaders = [f"btfref/_{name}" for name in files("shaders")]
    wanted = [*files("btfref"), *files("mitsuba_plugins"), *shaders]
    assert any(name.endswith(".glsl") for name in wanted)
    assert {"btfref/gates/tolerances.toml", "btfref/representations/gbrdf/tolerances.toml"} <= set(wanted)
    assert [name for name in wanted if name not in names] == []


def test_wheel_holds_nothing_else(wheel):
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert tops == {"btfref", "mitsuba_plugins", f"btfref-{__version__}.dist-info"}
    assert not [name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("btfref/docs/")]


def test_installed_wheel_is_the_one_that_runs(installed):
    where = installed(
        "-c", "import btfref.cli, mitsuba_plugins; print(btfref.cli.__file__, mitsuba_plugins.__file__)"
    )
    assert all(Path(path).is_relative_to(installed.folder) for path in where.split())


def test_installed_wheel_finds_its_shaders(installed):
    where = Path(installed("-c", "from btfref.platform import shader_directory as d; print(d())").strip())
    assert where == installed.folder / "btfref" / "_shaders"
    there = sorted(path.relative_to(where).as_posix() for path in where.rglob("*") if path.is_file())
    assert there == [name.removeprefix("shaders/") for name in files("shaders")]


def test_installed_wheel_examines_the_machine(installed, need):
    need("llvm")
    need("gl")
    facts = json.loads(installed(str(installed.folder / "bin" / "btfref"), "doctor", "--json"))
    assert facts["ok"]
    assert facts["versions"]["btfref"] == __version__


def test_pins_are_of_one_mind():
    pins = dict(re.findall(r"^(mitsuba|drjit)==(.*)$", "\n".join(PROJECT["dependencies"]), re.MULTILINE))
    assert pins == PINNED
    required = " ".join(importlib.metadata.requires("mitsuba"))
    assert re.search(rf"drjit\s*==\s*{re.escape(PINNED['drjit'])}", required)


def test_what_results_depend_on_is_a_dependency():
    names = {re.split(r"[<>=!\[ ]", line)[0] for line in PROJECT["dependencies"]}
    assert [name for name in RELEVANT if name not in names] == []


def test_pre_commit_runs_the_ruff_of_the_tests():
    (version,) = re.findall(
        r"^ruff==(\S+)$", "\n".join(PROJECT["optional-dependencies"]["test"]), re.MULTILINE
    )
    assert f"rev: v{version}\n" in (ROOT / ".pre-commit-config.yaml").read_text()


def test_continuous_integration_runs_make_test():
    script = (ROOT / ".ci" / "run").read_text()
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    assert script.rstrip().endswith("make --no-print-directory test")
    assert "BTFREF_REQUIRE=all" in script
