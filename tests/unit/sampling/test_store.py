"""The Zarr store: lossless, partial, atomic, and clear about what is wrong."""

import json
import os
import shutil

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.numerics.sphere.directions import directions
from btfref.sampling import SampledBTF, open_store
from btfref.sampling.store.layout import TILE, remove_leftovers, side_of
from btfref.sampling.store.store import BTFStore, create_store

VIEWS, LIGHTS = directions("2x3"), directions("2x4")


def _btf(rng, dtype="float16", rows=6, columns=10, variance=True):
    values = rng.gamma(2.0, 0.05, (len(VIEWS), len(LIGHTS), rows, columns, 3)).astype(dtype)
    spread = rng.gamma(1.0, 1e-4, values.shape).astype(np.float32) if variance else None
    attributes = {
        "seed": 7,
        "parameters": {"spp": 4},
        "parent": {"kind": "test"},
        "versions": {"btfref": "0"},
    }
    return SampledBTF(values, VIEWS, LIGHTS, spread, attributes)


@pytest.mark.parametrize(
    ("texels", "side", "padded"),
    [(400, 58, 406), (256, 64, 256), (64, 64, 64), (65, 33, 66), (100, 50, 100), (7, 7, 7), (129, 43, 129)],
)
def test_chunks_are_as_alike_as_they_can_be(texels, side, padded):
    assert side_of(texels, TILE) == side <= TILE
    count = -(-texels // side)
    # No more chunks than those of the largest size would be, and less beyond the last texel than a row a chunk.
    assert count == -(-texels // TILE)
    assert side * count == padded < texels + count


def test_a_store_is_little_larger_than_its_values(tmp_path, rng):
    btf = _btf(rng, rows=10, columns=5, variance=False)
    sizes = []
    for name, most in (("alike", 8), ("whole", 50)):
        btf.save(tmp_path / name, tile=most)
        assert open_store(tmp_path / name).tile == (5 if most == 8 else 10, 5)
        files = (tmp_path / name / "values" / "c").rglob("*")
        sizes.append(sum(path.stat().st_size for path in files if path.is_file()))
        np.testing.assert_array_equal(SampledBTF.load(tmp_path / name).values, btf.values)
    # A checksum and a place more for each chunk.
    assert sizes[0] - sizes[1] == len(VIEWS) * len(LIGHTS) * 20


def test_stores_of_earlier_versions_are_read_and_finished(tmp_path, rng, monkeypatch):
    """Their chunks were of the largest size, the last ones partly beyond the texels."""
    btf, path = _btf(rng, rows=10, columns=5, variance=False), tmp_path / "a.btf.zarr"
    with monkeypatch.context() as patch:
        patch.setattr("btfref.sampling.store.layout.side_of", min)
        store = create_store(path, views=VIEWS, lights=LIGHTS, texels=(10, 5), variance=False, tile=8)
        store.write_view(0, btf.values[0])
    store = open_store(path)
    assert store.tile == (8, 5)
    for view in range(1, len(VIEWS)):
        store.write_view(view, btf.values[view])
    np.testing.assert_array_equal(SampledBTF.load(path).values, btf.values)


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("variance", [True, False])
def test_round_trip_is_lossless(tmp_path, rng, dtype, variance):
    btf = _btf(rng, dtype, variance=variance)
    btf.save(tmp_path / "a.btf.zarr", tile=4)
    back = SampledBTF.load(tmp_path / "a.btf.zarr")
    assert back.values.dtype == btf.values.dtype
    assert np.array_equal(back.values, btf.values)
    assert back.variance is None if not variance else np.array_equal(back.variance, btf.variance)
    assert np.array_equal(back.views.vectors, VIEWS.vectors)
    assert np.array_equal(back.lights.vectors, LIGHTS.vectors)
    assert (back.views.name, back.lights.name) == ("2x3", "2x4")
    for key, value in btf.attributes.items():
        assert back.attributes[key] == value


def test_every_convention_is_an_attribute(tmp_path, rng):
    from btfref.conventions import AXES, COLOUR_SPACE, COSINE_CONVENTION, SCHEMA_VERSION, UNITS

    _btf(rng).save(tmp_path / "a.btf.zarr")
    attributes = open_store(tmp_path / "a.btf.zarr").attributes
    assert attributes["schema_version"] == SCHEMA_VERSION
    assert attributes["cosine_convention"] == COSINE_CONVENTION
    assert attributes["colour_space"] == COLOUR_SPACE
    assert attributes["axes"] == list(AXES)
    assert attributes["units"] == UNITS
    assert {"texels", "interpolation", "variance", "directions"} <= set(attributes)


@pytest.mark.parametrize(
    "part",
    [
        {"views": 2},
        {"lights": 3},
        {"views": [4, 1], "lights": slice(1, 4)},
        {"rows": slice(4, 6), "columns": slice(0, 4)},
        {"views": slice(None, None, 2), "columns": [9, 0, 5]},
        {"lights": -1},
    ],
)
def test_parts_equal_the_whole(tmp_path, rng, part):
    btf = _btf(rng)
    btf.save(tmp_path / "a.btf.zarr", tile=4)
    got = SampledBTF.load(tmp_path / "a.btf.zarr", **part)
    index = [
        np.atleast_1d(np.arange(n)[part.get(key, slice(None))])
        for key, n in zip(("views", "lights", "rows", "columns"), btf.values.shape[:4], strict=True)
    ]
    assert np.array_equal(got.values, btf.values[np.ix_(*index)])
    assert np.array_equal(got.variance, btf.variance[np.ix_(*index)])
    assert np.array_equal(got.views.vectors, VIEWS.vectors[index[0]])
    assert np.array_equal(got.lights.vectors, LIGHTS.vectors[index[1]])


def _counting(path):
    """A read-only Zarr store that notes which bytes of which file are read."""
    from zarr.storage import LocalStore, WrapperStore

    log = []

    class Counting(WrapperStore):
        async def get(self, key, prototype, byte_range=None):
            result = await self._store.get(key, prototype, byte_range)
            log.append((key, 0 if result is None else len(result)))
            return result

    return Counting(LocalStore(path)), log


@pytest.mark.parametrize(
    ("part", "files", "chunks"),
    [
        ({"views": 1}, 1, None),
        ({"lights": 3}, 6, 6 * 6),
        ({"views": 2, "lights": 5}, 1, 6),
        ({"rows": slice(0, 3), "columns": slice(4, 8)}, 6, 6 * 8),
        ({"views": 0, "lights": 0, "rows": 5, "columns": 9}, 1, 1),
    ],
)
def test_parts_touch_only_their_chunks(tmp_path, rng, part, files, chunks):
    path = tmp_path / "a.btf.zarr"
    _btf(rng).save(path, tile=4)
    zarr_store, log = _counting(path)
    store = BTFStore(path, store=zarr_store)
    log.clear()
    store.read(variance=False, **part)
    reads = [(key, size) for key, size in log if key.startswith("values/c/")]
    assert len({key for key, _ in reads}) == files
    assert not any(key.startswith("variance/") for key, _ in log)
    chunk = 3 * 4 * 3 * 2 + 4
    if chunks is not None:
        # An index is read of each file (16 bytes a chunk and a checksum), then the chunks alone.
        index = 16 * 8 * 6 + 4
        assert sorted(size for _, size in reads if size == chunk) == [chunk] * chunks
        assert sum(size for _, size in reads) == files * index + chunks * chunk


def test_an_interrupted_store_is_refused_until_it_is_complete(tmp_path, rng):
    btf = _btf(rng)
    path = tmp_path / "a.btf.zarr"
    store = create_store(path, views=VIEWS, lights=LIGHTS, texels=(6, 10), tile=4)
    for view in (0, 2):
        store.write_view(view, btf.values[view], btf.variance[view])
    assert not store.complete
    assert store.coverage.mean() == 2 / 6
    with pytest.raises(InputError, match="incomplete") as error:
        SampledBTF.load(path)
    assert error.value.field == "coverage"
    assert np.array_equal(SampledBTF.load(path, views=[0, 2], partial=True).values, btf.values[[0, 2]])
    with pytest.raises(InputError, match="not there"):
        SampledBTF.load(path, views=[0, 1], partial=True)
    for view in (1, 3, 4, 5):
        store.write_view(view, btf.values[view], btf.variance[view])
    assert np.array_equal(SampledBTF.load(path).values, btf.values)


def test_info_reads_headers_only(tmp_path, rng):
    path = tmp_path / "a.btf.zarr"
    _btf(rng).save(path, tile=4)
    zarr_store, log = _counting(path)
    info = BTFStore(path, store=zarr_store).info()
    json.dumps(info)
    assert not [key for key, _ in log if key.startswith(("values/c/", "variance/c/"))]
    assert info["shape"] == [6, 8, 6, 10, 3]
    assert info["payload_bytes"] == 6 * 8 * 6 * 10 * 3 * 2
    assert info["complete"] is True
    assert info["file_bytes"] == sum(f.stat().st_size for f in path.rglob("*") if f.is_file())


def _saved(tmp_path, rng):
    path = tmp_path / "a.btf.zarr"
    _btf(rng).save(path, tile=4)
    return path, path / "values/c/3/0/0/0/0"


@pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "remove"])
def test_damaged_values_are_refused(tmp_path, rng, damage):
    path, file = _saved(tmp_path, rng)
    content = bytearray(file.read_bytes())
    if damage == "flip":
        content[20] ^= 0x10
    elif damage == "truncate":
        content = content[: len(content) // 2]
    elif damage == "empty":
        content = b""
    file.unlink()
    if damage != "remove":
        file.write_bytes(content)
    with pytest.raises(InputError) as error:
        SampledBTF.load(path)
    assert error.value.file == path
    assert error.value.field.startswith("values")
    assert "\n" not in str(error.value)
    # Views in other files stay readable.
    SampledBTF.load(path, views=[0, 1])


@pytest.mark.parametrize("name", ["values", "variance", "coverage", "views", "lights"])
def test_a_lost_array_is_named(tmp_path, rng, name):
    path, _ = _saved(tmp_path, rng)
    shutil.rmtree(path / name)
    with pytest.raises(InputError) as error:
        SampledBTF.load(path)
    assert (error.value.file, error.value.field) == (path, name)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["values", "variance"])
def test_values_that_are_not_finite_are_refused_at_load(tmp_path, rng, bad, field):
    import zarr

    path, _ = _saved(tmp_path, rng)
    zarr.open_group(str(path), mode="r+")[field][2, 1, 3, 4, 0] = bad
    with pytest.raises(InputError) as error:
        SampledBTF.load(path)
    assert error.value.file == path
    assert error.value.field == f"{field}[2, 1, 3, 4, 0]"


def test_negative_variance_is_refused(tmp_path, rng):
    import zarr

    path, _ = _saved(tmp_path, rng)
    zarr.open_group(str(path), mode="r+")["variance"][0, 0, 0, 0, 0] = -1.0
    with pytest.raises(InputError, match="negative variance"):
        SampledBTF.load(path)


def test_values_that_do_not_fit_are_not_written(tmp_path, rng):
    store = create_store(tmp_path / "a.btf.zarr", views=VIEWS, lights=LIGHTS, texels=(6, 10), variance=False)
    good = np.full((8, 6, 10, 3), 0.1)
    for bad in (np.nan, 1e6):
        values = good.copy()
        values[1, 2, 3, 0] = bad
        with pytest.raises(InputError, match="finite"):
            store.write_view(0, values)
    with pytest.raises(InputError, match="shape"):
        store.write_view(0, good[:, :3])
    with pytest.raises(InputError, match="variance"):
        store.write_view(0, good, good)
    assert not store.coverage.any()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing", None),
        ("empty", b""),
        ("text", b"hello"),
        ("list", b"[]"),
        ("other", b'{"attributes": {"kind": "x"}}'),
    ],
)
def test_files_that_are_no_store_are_refused(tmp_path, name, content):
    path = tmp_path / f"{name}.btf.zarr"
    if content is not None:
        path.mkdir()
        (path / "zarr.json").write_bytes(content)
    with pytest.raises(InputError) as error:
        SampledBTF.load(path)
    assert error.value.file == path
    file = tmp_path / "file.btf.zarr"
    file.write_bytes(b"x")
    with pytest.raises(InputError, match="not a BTF store"):
        SampledBTF.load(file)


@pytest.mark.parametrize(
    ("key", "value"), [("schema_version", 99), ("cosine_convention", "without"), ("axes", ["light", "view"])]
)
def test_other_conventions_and_newer_schemas_are_refused(tmp_path, rng, key, value):
    path, _ = _saved(tmp_path, rng)
    header = json.loads((path / "zarr.json").read_text())
    header["attributes"][key] = value
    (path / "zarr.json").write_text(json.dumps(header))
    with pytest.raises(InputError) as error:
        SampledBTF.load(path)
    assert error.value.field == key


def test_nothing_is_overwritten_silently(tmp_path, rng):
    btf = _btf(rng)
    path = tmp_path / "a.btf.zarr"
    btf.save(path)
    with pytest.raises(InputError, match="exists"):
        btf.save(path)
    changed = SampledBTF(btf.values + np.float16(1), VIEWS, LIGHTS)
    changed.save(path, overwrite=True)
    assert np.array_equal(SampledBTF.load(path).values, changed.values)
    folder = tmp_path / "precious.btf.zarr"
    folder.mkdir()
    (folder / "thesis.tex").write_text("words")
    with pytest.raises(InputError, match="left alone"):
        btf.save(folder, overwrite=True)
    assert (folder / "thesis.tex").read_text() == "words"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.btf.zarr", "precious.btf.zarr"]
    with pytest.raises(InputError, match="folder"):
        btf.save(tmp_path / "nowhere" / "a.btf.zarr")


def test_leftovers_are_removed_and_nothing_else(tmp_path, rng):
    path, file = _saved(tmp_path, rng)
    before = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    (file.parent / "0.abc.partial").write_bytes(b"x")
    (tmp_path / "a.btf.zarr.saving.partial").mkdir()
    (tmp_path / "other.btf.zarr.partial").mkdir()
    remove_leftovers(path)
    assert sorted(p for p in tmp_path.rglob("*") if p.is_file()) == before
    assert sorted(os.listdir(tmp_path)) == ["a.btf.zarr", "other.btf.zarr.partial"]


def test_bad_parts_are_named(tmp_path, rng):
    path, _ = _saved(tmp_path, rng)
    for part in ({"views": 6}, {"rows": slice(9, 9)}, {"columns": [0.5]}):
        with pytest.raises(InputError) as error:
            SampledBTF.load(path, **part)
        assert error.value.field == next(iter(part))
