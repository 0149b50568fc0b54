"""A sampled BTF from a user's own arrays, and what BTFs, stores and representations say of themselves."""

import doctest

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.numerics.sphere.directions import DirectionSet, directions
from btfref.registry import methods
from btfref.representations.lookup import StoredMaps
from btfref.sampling import SampledBTF, open_store, sampled_btf

VIEWS, LIGHTS = directions("2x4"), directions("1x6")


def values(dtype=np.float32):
    generator = np.random.default_rng(1)
    return generator.uniform(0.1, 0.5, (len(VIEWS), len(LIGHTS), 8, 12, 3)).astype(dtype)


@pytest.mark.parametrize(
    ("views", "lights"),
    [
        (VIEWS, LIGHTS),
        ("2x4", "1x6"),
        (VIEWS.vectors, LIGHTS.vectors),
        (VIEWS.vectors.tolist(), np.float32(LIGHTS.vectors)),
    ],
    ids=["sets", "names", "arrays", "lists"],
)
def test_directions_are_sets_names_or_vectors(views, lights):
    btf = SampledBTF(values(), views, lights)
    for found, meant in ((btf.views, VIEWS), (btf.lights, LIGHTS)):
        assert isinstance(found, DirectionSet)
        assert np.array_equal(np.float32(found.vectors), np.float32(meant.vectors))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_half_and_single_floats_are_kept_without_a_copy(dtype):
    given = values(dtype)
    assert SampledBTF(given, VIEWS, LIGHTS).values is given


def test_double_floats_and_lists_become_single():
    given = values(np.float64)
    for form in (given, given.tolist()):
        btf = SampledBTF(form, VIEWS, LIGHTS, variance=form)
        assert np.array_equal(btf.values, given.astype(np.float32))
        assert btf.values.dtype == btf.variance.dtype == np.float32


def test_own_arrays_can_be_stored_and_compressed(tmp_path):
    btf = SampledBTF(values(), "2x4", LIGHTS.vectors)
    btf.save(tmp_path / "own.btf.zarr")
    assert np.array_equal(SampledBTF.load(tmp_path / "own.btf.zarr").values, btf.values)
    assert methods()["raw"].fit(btf).meta["views"] == {"name": "2x4", "count": 8}


def damaged(value):
    result = values()
    result[1, 2, 3, 4, 0] = value
    return result


LONG = LIGHTS.vectors * np.array([[1], [1], [1.5], [1], [1], [1]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((values()[:3], VIEWS, LIGHTS), ("(3, 6, 8, 12, 3)", "(8, 6, rows, columns, 3)")),
        ((values()[0], VIEWS, LIGHTS), ("(6, 8, 12, 3)",)),
        ((values()[..., :2], VIEWS, LIGHTS), ("(8, 6, 8, 12, 2)",)),
        ((values(np.uint8), VIEWS, LIGHTS), ("uint8", "float32")),
        ((damaged(np.nan), VIEWS, LIGHTS), ("values[1, 2, 3, 4, 0]", "nan", "finite")),
        ((damaged(np.inf), VIEWS, LIGHTS), ("values[1, 2, 3, 4, 0]", "inf")),
        ((values(np.float64) * 1e40, VIEWS, LIGHTS), ("values[0, 0, 0, 0, 0]", "inf")),
        ((values(), VIEWS, LONG), ("lights[2]", "length 1.5")),
        ((values(), VIEWS, DirectionSet(LONG)), ("lights[2]", "length 1.5")),
        ((values(), VIEWS, np.full((6, 3), np.nan)), ("lights[0]", "length nan")),
        ((values(), VIEWS, -LIGHTS.vectors), ("below the horizon",)),
        ((values(), VIEWS, LIGHTS.vectors[:, :2] / np.hypot(*LIGHTS.vectors.T[:2])[:, None]), ("(6, 2)",)),
        ((values(), VIEWS, [[0, 0, 1], [0]]), ("lights", "(n, 3)")),
        ((values(), "nonsense", LIGHTS), ("nonsense", "ubo81")),
        ((values(), VIEWS, LIGHTS, values()[:3]), ("variance", "(3, 6, 8, 12, 3)")),
        ((values(), VIEWS, LIGHTS, damaged(np.nan)), ("variance[1, 2, 3, 4, 0]", "nan")),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(arguments, words):
    with pytest.raises(InputError) as error:
        SampledBTF(*arguments)
    assert [word for word in words if word not in str(error.value)] == []


def test_the_example_is_right():
    finder = doctest.DocTestFinder()
    runner = doctest.DocTestRunner()
    for test in finder.find(SampledBTF, "SampledBTF", module=sampled_btf):
        runner.run(test)
    assert runner.tries >= 5
    assert runner.failures == 0


def test_a_btf_and_its_store_are_one_line(tmp_path):
    btf = SampledBTF(values(), VIEWS, LIGHTS)
    facts = "8 × 12 texels, 8 views (2x4) × 6 lights (1x6), 55296 bytes>"
    assert repr(btf) == f"<SampledBTF float32: {facts}"
    btf.save(tmp_path / "own.btf.zarr")
    assert repr(open_store(tmp_path / "own.btf.zarr")) == f"<BTFStore float32: {facts}"
    assert repr(VIEWS) == "<DirectionSet 2x4: 8 directions>"


def test_a_representation_is_one_line():
    found = repr(methods()["raw"].fit(SampledBTF(values(), VIEWS, LIGHTS)))
    facts = "8 × 12 texels, 8 views (2x4) × 6 lights (1x6)"
    assert found == f"<Representation raw: {facts}, 55296 bytes>"


@pytest.mark.parametrize("key", list(methods()))
def test_so_is_one_of_every_method(key):
    assert methods()[key].representation.__repr__ is StoredMaps.__repr__
