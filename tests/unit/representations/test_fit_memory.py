"""Budgets of fits: what a method says it takes is what a process takes at most."""

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.numerics.sphere.directions import directions
from btfref.registry import method, methods
from btfref.representations.fit_memory import FIT_BASE, UNKNOWN, check_budget, least_budget, stated
from btfref.sampling import SampledBTF

ROOT = Path(__file__).parents[3]


def store(texels, dtype="float16"):
    """What a budget is found from."""
    grid = directions("ubo81")
    return SimpleNamespace(views=grid, lights=grid, texels=(texels, texels), dtype=np.dtype(dtype))


@pytest.mark.parametrize("key", methods())
def test_a_budget_grows_with_the_values(key):
    row, values = method(key), 3 * 81 * 81 * 64 * 64
    small, large = least_budget(row, store(32)), least_budget(row, store(64))
    assert FIT_BASE < small < large
    half = np.dtype("float16").itemsize
    more = least_budget(row, store(64, "float32")) - large
    if stated(row).streams:
        # Of wider values no more than what is read at a time.
        assert 0 <= more <= half * values
    else:
        # The values themselves, once at least; in float32 twice as much for them.
        assert large - small >= half * (values - values // 4)
        assert round(more / values) == half
    check_budget(row, store(64), large)
    with pytest.raises(InputError, match=f"too small to fit {key}.*at least {large / 2**20:.0f} MiB"):
        check_budget(row, store(64), large - (1 << 20))


def test_a_method_that_says_nothing_counts_as_a_large_one():
    silent = SimpleNamespace(key="silent", fitting=SimpleNamespace(fit=None, PRESETS={}))
    assert least_budget(silent, store(1)) == FIT_BASE + int(UNKNOWN.blocks + 3 * 81 * 81 * UNKNOWN.each)


@pytest.mark.parametrize(
    ("key", "more"),
    [
        ("svd", {"components": 64}),
        ("lpca", {"clusters": 64}),
        ("rf_lobes", {"lobes": 4}),
        ("lafortune", {"lobes": 6}),
    ],
)
def test_a_larger_model_takes_more(key, more):
    row = method(key)
    assert least_budget(row, store(16), more) > least_budget(row, store(16))
    # Fewer are no less: what a fit takes beside its model stays.
    assert least_budget(row, store(16), dict.fromkeys(more, 1)) <= least_budget(row, store(16))


@pytest.mark.long
@pytest.mark.parametrize(
    ("key", "parameters"),
    [
        *((key, {}) for key in methods()),
        ("svd", {"components": 150}),
        ("lpca", {"clusters": 64, "components": 12}),
        ("rf_lobes", {"lobes": 4}),
        ("laplacian", method("laplacian").presets["paper"]),
    ],
)
def test_a_fit_keeps_its_budget(key, parameters, tmp_path, rng):
    """In a process of its own, with the least budget that is let through."""
    grid = directions("ubo81")
    shades = rng.uniform(0.05, 0.5, (24, 24, 3))
    lobes = np.maximum(grid.vectors @ grid.vectors.T, 0) ** 4 + 0.3
    values = (lobes * grid.vectors[:, 2])[:, :, None, None, None] * shades
    SampledBTF(values.astype(np.float16), grid, grid).save(tmp_path / "x.btf.zarr")
    budget = least_budget(method(key), store(24), parameters)
    given = [f"{name}={','.join(map(str, np.atleast_1d(value)))}" for name, value in parameters.items()]
    made = subprocess.run(
        [sys.executable, "-m", "btfref", "fit", key, "x.btf.zarr", "-o", "x.exr", "--memory", str(budget)]
        + (["--set", *given] if given else []),
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert made.returncode == 0, made.stderr
    peak = int(
        re.search(r"largest memory of the process: .*\(([\d ]+) bytes\)", made.stdout)[1].replace(" ", "")
    )
    assert peak <= budget
