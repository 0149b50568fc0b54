"""Fits that read a store part by part: the same bytes as from memory, whatever may be kept for the next pass."""

import hashlib

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.errors import InputError
from btfref.registry import method, methods
from btfref.representations import between
from btfref.representations.fit_memory import FIT_BASE, UNKNOWN, least_budget, read_within, stated
from btfref.representations.gbrdf.decomposition import samples
from btfref.sampling import SampledBTF, open_store
from btfref.sampling.blocks import BTFBlocks, StreamedBTF, texel_values

#: Methods whose fits are quick on few texels.
QUICK = ("raw", "svd", "lpca", "laplacian", "rf_poly")

STREAMING = [key for key in methods() if stated(method(key)).streams]


@pytest.fixture(scope="module")
def btf():
    return oracle_btf((10, 7), views="6x3", lights="8x3")


@pytest.fixture(scope="module")
def path(btf, tmp_path_factory):
    """Tiles, so that rows are read from several chunks."""
    path = tmp_path_factory.mktemp("streaming") / "x.btf.zarr"
    btf.save(path, tile=4)
    return path


def digest(made):
    result = hashlib.sha256(repr(sorted(made.meta.get("fit", {}).items())).encode())
    for name, array in sorted(made.arrays().items()):
        result.update(name.encode() + array.tobytes())
    return result.hexdigest()


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in QUICK else pytest.mark.long) for key in STREAMING]
)
def test_streamed_fits_are_those_from_memory(btf, path, key):
    expected = digest(method(key).fit(btf))
    for spare in (0, 1 << 17):
        source = StreamedBTF(path, spare=spare)
        assert digest(method(key).fit(source)) == expected
        assert round(source.passes, 6) >= 1


def test_points_that_are_looked_up_together_change_no_byte(btf, path, monkeypatch):
    """g-BRDFs: few texels at a time from memory; of a store as many as there is room for, or all views are kept."""
    monkeypatch.setattr(samples, "BLOCK", 8)
    monkeypatch.setattr(samples, "GROUP", 16)
    few = {"pairs": 8, "layers": 4, "iterations": 2, "ndf_size": 8, "largest": 2}
    expected, read = digest(method("gbrdf").fit(btf, **few)), []
    step = 12 * 16 * len(btf.lights) * (len(btf.views) + samples.PER_VIEW)
    for spare, together in ((0, 16), (step, 32), (1 << 30, 16)):
        assert samples.texels_together(StreamedBTF(path, spare=spare)) == together
        source = StreamedBTF(path, spare=spare)
        assert digest(method("gbrdf").fit(source, **few)) == expected
        read.append(source.passes)
    assert samples.texels_together(btf) == 8
    assert read[0] > read[1] > round(read[2]) == 1


def test_memory_to_spare_saves_passes(path):
    read = []
    for spare in (0, 1 << 30):
        source = StreamedBTF(path, spare=spare)
        method("laplacian").fit(source)
        read.append(source.passes)
    assert read[0] > 2 * read[1]
    assert round(read[1]) == 1


def test_figures_between_the_samples_are_those_from_memory(btf, path):
    made = method("svd").fit(btf, components=2)
    assert between.measure(made, StreamedBTF(path)) == between.measure(made, btf)


def test_views_rows_and_texels_are_the_values(btf, path):
    for spare in (0, 1 << 30):
        source = StreamedBTF(path, spare=spare)
        assert isinstance(source, BTFBlocks)
        assert isinstance(btf, BTFBlocks)
        np.testing.assert_array_equal(source.view(3), btf.values[3])
        for first, last in ((0, 1), (3, 5), (9, 10), (0, 10)):
            np.testing.assert_array_equal(source.rows(first, last), btf.values[:, :, first:last])
        flat = btf.values.reshape(*btf.values.shape[:2], -1, 3)
        for texels in (np.arange(5, 9), np.array([0, 3, 66])):
            np.testing.assert_array_equal(texel_values(source, texels), flat[:, :, texels])


def test_what_does_not_stream_is_read_whole(path, monkeypatch):
    store, whole = open_store(path), method("neural")
    assert isinstance(read_within(whole, store, None), StreamedBTF)
    monkeypatch.setattr(whole.fitting, "FIT_MEMORY", UNKNOWN)
    assert isinstance(read_within(whole, store, None), SampledBTF)
    assert isinstance(read_within(method("svd"), store, None), StreamedBTF)
    with pytest.raises(InputError, match="memory budget too small to fit svd"):
        read_within(method("svd"), store, FIT_BASE)


def test_a_large_btf_needs_little_of_its_size(path):
    """At 400² texels and 151² directions, 21.9 GB of half floats."""
    store = open_store(path)
    store.texels, store.views, store.lights = (400, 400), [None] * 151, [None] * 151
    for key in ("svd", "lpca", "laplacian", "gbrdf", "neural"):
        assert least_budget(method(key), store) < 6 << 30


def test_a_part_that_is_missing_is_said(btf, tmp_path):
    btf.save(tmp_path / "x.btf.zarr", tile=4)
    next(p for p in (tmp_path / "x.btf.zarr" / "values" / "c" / "2").rglob("*") if p.is_file()).unlink()
    source = StreamedBTF(tmp_path / "x.btf.zarr")
    with pytest.raises(InputError, match="damaged store"):
        method("svd").fit(source)
