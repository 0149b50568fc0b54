"""How parts get into the files of a store: the same bytes however they come, and beside what is being made."""

import threading

import numpy as np
import pytest
import zarr
from stores import contents

from btfref.errors import InputError
from btfref.numerics.sphere.directions import directions
from btfref.sampling import open_store
from btfref.sampling.store.store import create_store
from btfref.sampling.store.writing import Writer

VIEWS, LIGHTS = directions("1x3"), directions("2x4")
TILES = np.divmod(np.arange(6), 3)


@pytest.fixture
def views(rng):
    """Values and variances of two views, more texels than tiles have."""
    values = rng.gamma(2.0, 0.05, (2, len(LIGHTS), 6, 10, 3)).astype(np.float32)
    return values, (1e-4 * values).astype(np.float32)


def _store(path, **settings):
    return create_store(path, views=VIEWS, lights=LIGHTS, texels=(6, 10), tile=4, **settings)


def _some(store, values, spread, view, lights, tiles):
    rows, columns = np.array(tiles).T
    lights = np.array(lights)
    store.write_part(view, lights, (rows, columns), values[view, lights], spread[view, lights])


def test_parts_in_any_order_make_the_files_of_the_whole(tmp_path, views):
    whole, parts = _store(tmp_path / "whole.btf.zarr"), _store(tmp_path / "parts.btf.zarr")
    every = [(row, column) for row in range(2) for column in range(3)]
    for view in (0, 1):
        whole.write_view(view, views[0][view], views[1][view])
    _some(parts, *views, 1, [1, 4], [(1, 2), (0, 1)])
    held = parts.path / "values/c/1/0/0/0/0"
    size = held.stat().st_size
    assert parts.coverage[1].sum() == 4
    _some(parts, *views, 1, [0, 2, 3, 5, 6, 7], every)
    _some(parts, *views, 1, [1, 4], every[:3])
    assert not parts.coverage[1].all()
    # What is not there is in no file, and what is there twice is there once.
    assert size < held.stat().st_size < (whole.path / "values/c/1/0/0/0/0").stat().st_size
    assert np.isnan(zarr.open_group(str(parts.path))["values"][1, 1, 4:]).any()
    _some(parts, *views, 1, [1, 4], every)
    parts.write_view(0, views[0][0], views[1][0])
    assert contents(whole.path) == contents(parts.path)


def test_zarr_reads_and_writes_the_same_files(tmp_path, views):
    store = _store(tmp_path / "a.btf.zarr", dtype="float32")
    store.write_view(0, views[0][0], views[1][0])
    arrays = zarr.open_group(str(store.path), mode="r+")
    assert np.array_equal(arrays["values"][0], views[0][0])
    assert np.array_equal(arrays["variance"][0], views[1][0])
    assert (arrays["coverage"][0] == 1).all()
    arrays["values"][0, 3] = 2 * views[0][0, 3]
    assert np.array_equal(store.read(views=0, lights=3)[0][0, 0], 2 * views[0][0, 3])
    _some(store, *views, 0, [2], [(0, 0)])
    assert np.array_equal(store.read(views=0)[0][0, 3], 2 * views[0][0, 3])


@pytest.mark.parametrize("file", ["values/c/0/0/0/0/0", "coverage/c/0/0/0/0"])
def test_a_part_does_not_go_into_a_damaged_file(tmp_path, views, file):
    store = _store(tmp_path / "a.btf.zarr")
    store.write_view(0, views[0][0], views[1][0])
    path = store.path / file
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(InputError, match="damaged store") as error:
        _some(store, *views, 0, [2], [(0, 0)])
    assert error.value.field == file.partition("/")[0]
    assert not list(store.path.rglob("*.partial"))


class _Slow:
    """A store whose writes wait until they are let go."""

    def __init__(self, failing=None):
        self.go, self.written, self.failing = threading.Event(), [], failing

    def write_part(self, view, *_, **__):
        self.go.wait()
        if view == self.failing:
            raise InputError("full", field="values")
        self.written.append(view)


def test_parts_are_written_in_order_beside_the_next_and_a_few_wait(views):
    store, part = _Slow(), views[0][0]
    with Writer(store, 2 * part.nbytes) as writer:
        writer.write_part(0, None, None, part)
        writer.write_part(1, None, None, part)
        late = threading.Thread(target=lambda: writer.write_part(2, None, None, part))
        late.start()
        late.join(0.05)
        assert late.is_alive()  # two wait, a third one has to
        assert store.written == []
        store.go.set()
        late.join()
    assert store.written == [0, 1, 2]


def _hand_over(store, part, views, error=None):
    with Writer(store, 10 * part.nbytes) as writer:
        for view in views:
            writer.write_part(view, None, None, part)
        if error is not None:
            raise error


def test_after_an_error_nothing_is_written_and_it_is_told(views):
    store = _Slow(failing=1)
    store.go.set()
    with pytest.raises(InputError, match="full"):
        _hand_over(store, views[0][0], range(4))
    assert store.written == [0]
    # What was handed over before an error of the maker is kept.
    store = _Slow()
    store.go.set()
    with pytest.raises(KeyboardInterrupt):
        _hand_over(store, views[0][0], [0], KeyboardInterrupt())
    assert store.written == [0]


def test_what_is_read_in_whole_views_is_what_zarr_reads(tmp_path, views):
    store = _store(tmp_path / "a.btf.zarr")
    for view in (0, 1):
        store.write_view(view, views[0][view], views[1][view])
    for chosen in (slice(0, 2), [1, 0]):
        values, variance = store.read(views=chosen)
        assert np.array_equal(values, zarr.open_group(str(store.path))["values"][:][chosen])
        assert np.array_equal(variance, views[1][chosen])
    path = store.path / "values/c/1/0/0/0/0"
    content = bytearray(path.read_bytes())
    content[20] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="checksum"):
        open_store(store.path).read(views=1)


@pytest.mark.parametrize("coded", ["compressed", "without shards", "with checksums alone", "big-endian"])
def test_what_was_coded_elsewhere_is_read_by_zarr(tmp_path, views, coded):
    """Compressed, unsharded or big-endian arrays hold the same values; nothing is added to them."""
    path = tmp_path / "theirs.btf.zarr"
    store = _store(path)
    for view in (0, 1):
        store.write_view(view, views[0][view], views[1][view])
    expected, marks = store.read(views=slice(0, 2)), store.coverage
    group = zarr.open_group(path)
    for name, fill in (("values", float("nan")), ("variance", float("nan")), ("coverage", 0)):
        data, chunks = group[name][:], group[name].chunks
        shards = None if "with" in coded else group[name].shards
        more = {"compressors": zarr.codecs.ZstdCodec()} if coded == "compressed" else {"compressors": None}
        if coded == "with checksums alone":
            more = {"compressors": zarr.codecs.Crc32cCodec()}
        if coded == "big-endian":
            more["serializer"] = zarr.codecs.BytesCodec(endian="big")
        group.create_array(
            name,
            shape=data.shape,
            dtype=data.dtype,
            chunks=chunks,
            shards=shards,
            fill_value=fill,
            overwrite=True,
            **more,
        )[:] = data
    theirs = open_store(path)
    assert np.array_equal(theirs.coverage, marks)
    assert theirs.covered(0).all()
    for ours, read in zip(expected, theirs.read(views=slice(0, 2)), strict=True):
        assert np.array_equal(ours, read)
    with pytest.raises(InputError, match="coded otherwise can only be read"):
        theirs.write_view(2, views[0][0], views[1][0])
