"""The same seed gives the same bytes, whatever the number of threads and of cores."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from btfref.gates.tolerances import tolerance
from btfref.numerics.solvers.threads import BLOCK, product, reproducible
from btfref.registry import methods

#: Whose sums are long enough to differ on the tests' small tables.
QUICK = ("svd", "laplacian")

CODE = """
import hashlib, os, sys
if sys.argv[1] == "pinned":
    os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])
from oracle import oracle_btf
from btfref.registry import methods
btf = oracle_btf((20, 16))
for key in sys.argv[2:]:
    made = methods()[key].quick_fit(btf)
    digest = hashlib.sha256(repr(sorted(made.meta.get("fit", {}).items())).encode())
    for name, array in sorted(made.arrays().items()):
        digest.update(name.encode() + array.tobytes())
    print(key, digest.hexdigest())
"""


def hashes(how, keys):
    """Key → hash of the fits that a process of its own makes."""
    threads = {f"{name}_NUM_THREADS": how for name in ("OPENBLAS", "OMP")} if how != "pinned" else {}
    root = Path(__file__).parents[3]
    environment = {**os.environ, **threads, "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}"}
    done = subprocess.run(
        [sys.executable, "-c", CODE, how, *keys],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
        env=environment,
    )
    return dict(line.split() for line in done.stdout.splitlines())


@pytest.mark.parametrize(
    "keys",
    [pytest.param(QUICK, id="quick"), pytest.param(tuple(methods()), marks=pytest.mark.long, id="all")],
)
def test_fits_do_not_depend_on_threads(keys):
    one, two, pinned = (hashes(how, keys) for how in ("1", "2", "pinned"))
    assert set(one) == set(keys)
    assert one == two
    assert one == pinned


@pytest.mark.parametrize("shape", [(3 * BLOCK + 5, 70, 20), (20, 70, 3 * BLOCK + 5)])
def test_products_in_blocks_are_products(rng, shape):
    n, k, m = shape
    a, b = rng.normal(size=(n, k)), rng.normal(size=(m, k)).T
    expected = product(a, b)
    with reproducible():
        np.testing.assert_allclose(product(a, b), a @ b, rtol=tolerance("factored.svd.rtol"))
        np.testing.assert_allclose(expected, product(a, b), rtol=tolerance("factored.svd.rtol"))
