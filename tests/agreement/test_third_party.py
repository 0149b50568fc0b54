"""A method from outside, installed into a folder of its own: btfref knows it everywhere without a change."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from oracle import oracle_btf

pytestmark = pytest.mark.usefixtures("renderers")

EXAMPLE = Path(__file__).parents[1] / "third_party" / "tinted_brdf"
KEY = "tinted_brdf"
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """``run(*arguments)``: a btfref command in a process that has the example installed; what it printed."""
    folder = tmp_path_factory.mktemp("third_party")
    # A copy: building leaves files beside the sources.
    source = shutil.copytree(EXAMPLE, folder / "source")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run([*pip, "--target", folder / "site", source], check=True, timeout=120)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder / "site"), str(ROOT)])}

    def call(*arguments, status=0):
        command = [sys.executable, "-m", "btfref", *map(str, arguments)]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=folder, env=environment, timeout=500, check=False
        )
        assert done.returncode == status, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout

    call.folder = folder
    oracle_btf((16, 16)).save(folder / "formula.btf.zarr")
    call("fit", KEY, "formula.btf.zarr", "-o", f"formula.{KEY}.exr")
    return call


def test_it_is_not_known_without_its_package():
    from btfref.registry import methods

    assert KEY not in methods()


def test_command_line_and_both_renderers(run):
    assert json.loads(run("info", f"formula.{KEY}.exr", "--json"))["method"] == KEY
    scene = ["sphere", "-D", f"btf=formula.{KEY}.exr", "-D", "lights=points2", "--size", "48x48"]
    run("render", *scene, "-o", "a.exr", "--grid", "4", "--classes", "a.png")
    run("realtime", *scene, "-o", "b.exr")
    run("compare", "b.exr", "a.exr", "--classes", "a.png", "--gate", "image.noise_free")


@pytest.mark.long
def test_validate(run):
    """Probe agreement, χ², pictures, waterfall, directions that nobody fitted, report."""
    command = ["validate", "--quick", "--only", KEY, "--workers", "1", "--cache", "cache", "-o", "report"]
    result = json.loads(run(*command, "--json"))
    assert result["passed"] is True
    assert {cell["method"] for cell in result["cells"]} == {KEY}
    gates = {gate["name"] for gate in result["methods"][0]["gates"]}
    assert {"probe.agreement.p999", "chi2.rejected.tests", "sample.weight.max"} <= gates
    assert len(list((run.folder / "report" / "cells").glob("*.html"))) == 3


@pytest.mark.long
def test_bench_and_stress(run):
    assert KEY in run("bench", "eval", "--quick", "--only", KEY, "--btf", "formula.btf.zarr", "-o", "bench")
    assert KEY in run("stress", "--only", KEY, "--data", "bumpy")
