"""What loading a part of a file costs: bytes and memory follow the part; old files are read as well."""

import tracemalloc

import numpy as np
import pytest

from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.registry import method
from btfref.representations.file import container, pixels
from btfref.representations.file.container import bytes_of_choice, load, save
from btfref.representations.file.resident import keeping
from btfref.representations.lookup import direction_arrays, meta_for

#: What a camera before a plane asks for.
VIEWS, LIGHTS = np.arange(40, 46), np.array([7, 8])

#: Texels along a side: files of one to four megabytes.
TEXELS = {"raw": 16, "lpca": 24, "rf_lobes": 64}


def edges(grid):
    return {f"{kind}_edge": float(np.float32(grid.vectors[:, 2].min())) for kind in ("light", "view")}


def representation(key):
    """Maps without a fit; of their bytes little is that of directions."""
    grid, rng = directions("6x8"), np.random.default_rng(0)
    n, texels = len(grid), (TEXELS[key],) * 2

    def some(*shape):
        return rng.uniform(0.1, 1, shape).astype(np.float16)

    made = {
        "raw": lambda: ({"values": some(*texels, n, n, 3)}, {}),
        "lpca": lambda: (
            {
                "basis": some(16, 5, n, n, 3),
                "weights": some(*texels, 4),
                "cluster": rng.integers(0, 16, (*texels, 1)).astype(np.uint32),
            },
            {"n_components": 4},
        ),
        "rf_lobes": lambda: (
            {"lobes": some(*texels, n, 4), "colour": some(*texels, 4)},
            edges(grid) | {"n_lobes": 1},
        ),
    }
    maps, constants = made[key]()
    meta = meta_for(key, texels, grid, grid, {}) | {"constants": constants}
    return method(key).representation.from_arrays(maps | direction_arrays(grid, grid), meta)


@pytest.fixture(scope="module", params=["raw", "lpca", "rf_lobes"])
def made(request, tmp_path_factory):
    """A representation, its file, and what of it is asked for."""
    path = tmp_path_factory.mktemp("loading") / "x.exr"
    whole = representation(request.param)
    save(whole, path)
    return whole, path, {"views": VIEWS} | ({} if request.param == "rf_lobes" else {"lights": LIGHTS})


def kept_alone(part):
    """Bytes of the maps with what no choice leaves out."""
    return sum(a.nbytes for a in part.arrays().values())


def test_bytes_and_memory_follow_what_is_asked_for(made):
    whole, path, choice = made
    load(path, **choice)  # modules and directions
    tracemalloc.start()
    part = load(path, **choice)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = keeping(whole, **choice)
    assert part.meta == expected.meta
    for name, array in expected.arrays().items():
        np.testing.assert_array_equal(part.arrays()[name], array)
    read = bytes_of_choice(path, choice)
    # Rows are of views, in raw of pairs: of lpca all lights of a view are read.
    views = keeping(whole, views=VIEWS) if whole.meta["method"] == "lpca" else expected
    assert read <= tolerance("loading.share") * kept_alone(views) + tolerance("loading.constant")
    assert peak <= tolerance("loading.copies") * kept_alone(views) + tolerance("loading.constant")


def test_the_whole_comes_back_whatever_the_order_of_its_axes_in_the_file(made):
    whole, path, _ = made
    for name, array in load(path).arrays().items():
        np.testing.assert_array_equal(array, whole.arrays()[name])
        assert array.flags.c_contiguous


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize(
    ("value", "finite", "or_nan"),
    [
        (65504, True, True),
        (-1e-7, True, True),
        (np.nan, False, True),
        (np.inf, False, False),
        (-np.inf, False, False),
    ],
)
def test_values_that_are_not_finite_are_seen(monkeypatch, dtype, value, finite, or_nan):
    monkeypatch.setattr(pixels, "_PART", 4)
    array = np.zeros((3, 3), dtype)
    array[1, 2] = value
    assert pixels._finite(array, or_nan=False) is finite
    assert pixels._finite(array, or_nan=True) is or_nan


def test_files_of_blocks_are_read_as_before(made, tmp_path, monkeypatch):
    whole, path, choice = made
    monkeypatch.setattr(container, "rows_alone", lambda entry: False)
    if whole.meta["method"] == "raw":  # of which nothing was read alone
        monkeypatch.setattr(type(whole), "ROWS_BY", {})
    old = tmp_path / "old.exr"
    save(whole, old)
    assert old.read_bytes() != path.read_bytes()
    expected = keeping(whole, **choice)
    for some, other in ((load(old), whole), (load(old, **choice), expected)):
        for name, array in other.arrays().items():
            np.testing.assert_array_equal(some.arrays()[name], array)
