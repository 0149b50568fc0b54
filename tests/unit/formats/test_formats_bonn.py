"""Bonn's binary BTFs: every family and colour model against files written from the format's definition."""

import struct

import formats_material as material
import numpy as np
import pytest
from stores import imported

from btfref.errors import InputError
from btfref.formats import export_btf, identify, import_btf, open_source
from btfref.gates import tolerance
from btfref.numerics.solvers.lowrank import texel_matrix
from btfref.numerics.sphere.directions import directions
from btfref.sampling import SampledBTF

MODELS = tolerance("formats.models.rtol")
FLOAT = "formats.float_factors"


def written(tmp_path, data, name="x.btf"):
    path = tmp_path / name
    path.write_bytes(data)
    return path


def check(btf, expected, gate=FLOAT):
    error = np.abs(btf.values - expected).max() / np.abs(expected).max()
    assert error <= tolerance(f"{gate}.max"), error


@pytest.mark.parametrize("model", sorted(material.FORWARD))
def test_colour_models(model, tmp_path):
    values = material.pictures()
    check(imported(written(tmp_path, material.dfmf(values, model=model))), material.stored(values))


def test_reflectance_above_one_survives_every_model():
    assert material.pictures().max() == 2


def test_lab_of_a_known_colour(tmp_path):
    """L* = 100 is white, and mid grey L* = 50 is Y = 0.184 (CIE 15); a* and b* of 0 stay grey."""
    values = np.zeros((5, 5, 1, 2, 3))
    values[..., 0, :] = 100, 0, 0
    values[..., 1, :] = 50, 0, 0
    found = imported(written(tmp_path, material.dfmf(values, model=2))).values
    np.testing.assert_allclose(found[0, 0, 0], [[1] * 3, [((50 + 16) / 116) ** 3] * 3], rtol=MODELS)


def test_linear_spectral_model_is_the_owners(tmp_path):
    """Model 6 as btflib has it: total·3 − Σ rest/3 first, total·3·(1 + rest) for the others."""
    values = np.broadcast_to([0.5, 0.25, -0.25], (5, 5, 1, 2, 3)).copy()
    data = bytearray(material.dfmf(values, model=0))
    at = data.index(struct.pack("<Ii", 99, 0)) + 4
    data[at : at + 4] = struct.pack("<i", 6)
    found = imported(written(tmp_path, bytes(data))).values
    np.testing.assert_allclose(found[0, 0, 0, 0], [1.5, 1.875, 1.125], rtol=tolerance("formats.decoded.rtol"))


@pytest.mark.parametrize(
    "make",
    [
        lambda v: material.dfmf(v, transposed=True),
        lambda v: material.dfmf(v, rotations=3),
        lambda v: material.dfmf(v, version=1),
        lambda v: material.dfmf(v, version=2),
        lambda v: material.dfmf(v, version=3),
        lambda v: material.dfmf(v, scalar=8),
        material.fmf,
        lambda v: material.fmf(v, transposed=True),
        lambda v: material.fmf(v, log=False),
        lambda v: material.fmf(v, version=0),
        lambda v: material.fmf(v, version=1),
        lambda v: material.fmf(v, signature=b"!FMF06FCR"),
        lambda v: material.fmf(v, signature=b"!FMF06FC", transposed=True),
        material.pvf,
        lambda v: material.pvf(v, of_lights=False),
        lambda v: material.pvf(v, signature=b"!PVF06FC"),
        lambda v: material.pvf(v, legacy=True),
        material.bdi,
        lambda v: material.bdi(v, filled=True),
        lambda v: material.bdi(v, compression=1, lines=4),
        lambda v: material.bdi(v, compression=2, lines=1),
    ],
)
def test_families(make, tmp_path):
    values = material.pictures()
    path = written(tmp_path, make(values))
    assert identify(path) == "bonn"
    source = open_source(path)
    included = source.cosine_included
    check(imported(path), material.stored(values, cosine_included=included))


@pytest.mark.parametrize("flag", [0, 1])
def test_cosine_flag(flag, tmp_path):
    values = material.pictures()
    btf = imported(written(tmp_path, material.dfmf(values, cosine=flag)))
    check(btf, material.stored(values, cosine_included=bool(flag)))


def test_half_factors_keep_their_precision(tmp_path):
    values = material.pictures()
    btf = imported(written(tmp_path, material.dfmf(values, scalar=2)))
    check(btf, material.stored(values), "formats.half_factors")


def test_header_limits_the_components_of_fmf(tmp_path):
    values = material.pictures()
    path = written(tmp_path, material.fmf(values, components=2, log=False))
    assert open_source(path).facts["components"] == 2


def test_sparse_texels_without_data_are_black_and_counted(tmp_path):
    values, mask = material.pictures(), np.ones((3, 4), np.uint8)
    mask[1, 2] = mask[0, 3] = 0
    path = written(tmp_path, material.bdi(values, compression=2, mask=mask))
    assert open_source(path).facts["texels_without_data"] == 2
    check(imported(path), material.stored(values * mask[..., None]))


def test_spectral_channels(tmp_path):
    """A grey spectrum is grey; a file of one long wavelength more than short ones is red."""
    grey = np.repeat(material.pictures()[..., :1], 5, -1)
    names = ("400", "500", "550", "600", "700")
    btf = imported(written(tmp_path, material.dfmf(grey, channels=names)))
    check(btf, material.stored(np.repeat(grey[..., :1], 3, -1)))
    red = grey * [0, 0, 0, 1, 1]
    found = imported(written(tmp_path, material.dfmf(red, channels=names), "red.btf")).values
    assert (found[..., 0] > 2 * found[..., 1:].max(-1)).all()


def test_channels_in_another_order(tmp_path):
    values = material.pictures()
    btf = imported(
        written(
            tmp_path,
            material.bdi(values[..., ::-1]).replace(
                b"\x01\0\0\0R\x01\0\0\0G\x01\0\0\0B", b"\x01\0\0\0B\x01\0\0\0G\x01\0\0\0R"
            ),
        )
    )
    check(btf, material.stored(values))


def test_orientation(tmp_path):
    """The first texel of the file is the top left corner: the last row and first column of the store."""
    values = np.full((5, 5, 3, 4, 3), 0.125)
    values[:, :, 0, 0] = 1, 0.5, 0.25
    path = written(tmp_path, material.bdi(values))
    found = imported(path).values[2, 3]
    assert found[-1, 0].tolist() == [1, 0.5, 0.25]
    assert found[0, 0].tolist() == [0.125] * 3
    down = SampledBTF.load(import_btf(path, tmp_path / "down.btf.zarr", rows="down").path).values[2, 3]
    assert down[0, 0].tolist() == [1, 0.5, 0.25]


def test_lights_are_the_fastest_index(tmp_path):
    values = np.broadcast_to(0.125 * np.arange(1, 26).reshape(5, 5, 1, 1, 1), (5, 5, 1, 2, 3)).copy()
    for name, make in (("a", material.dfmf), ("b", material.bdi), ("c", material.fmf), ("d", material.pvf)):
        found = imported(written(tmp_path, make(values), f"{name}.btf")).values
        np.testing.assert_allclose(found[3, 1, 0, 0], 0.125 * 17, rtol=MODELS)


FILES = {
    "dfmf": material.dfmf,
    "fmf": material.fmf,
    "pvf": material.pvf,
    "bdi": material.bdi,
    "bzip": lambda v: material.bdi(v, compression=1),
}


@pytest.mark.parametrize("kind", sorted(FILES))
def test_truncated_anywhere(kind, tmp_path):
    """Cut at any length: a message with a field and its offset, and no store."""
    data = FILES[kind](material.pictures(1, 2))
    out = tmp_path / "out.btf.zarr"
    for length in sorted({*range(1, 400, 7), *range(400, len(data), 97), len(data) - 1}):
        path = written(tmp_path, data[:length])
        with pytest.raises(InputError, match=r"at byte \d+|not a BTF of a known format"):
            import_btf(path, out)
        assert not out.exists()


@pytest.mark.parametrize("kind", sorted(FILES))
def test_bytes_that_nothing_explains(kind, tmp_path):
    path = written(tmp_path, FILES[kind](material.pictures(1, 2)) + b"x")
    with pytest.raises(InputError, match="more bytes"):
        open_source(path)


def test_sizes_are_checked_before_anything_is_made(tmp_path):
    """A header that promises 2³² × 2³² factors fails at once, whatever the memory."""
    data = bytearray(material.dfmf(material.pictures(1, 2)))
    at = data.index(struct.pack("<BI", 4, 2))
    data[at + 1 : at + 13] = struct.pack("<III", 65536, 25, 2)
    with pytest.raises(InputError, match=r"truncated file; field 'singular values of channel 0 at byte"):
        open_source(written(tmp_path, bytes(data)))
    data[at + 1 : at + 13] = struct.pack("<III", 2**32 - 1, 2**32 - 1, 2**32 - 1)
    with pytest.raises(InputError, match="components of channel 0"):
        open_source(written(tmp_path, bytes(data)))


def test_lights_that_differ_between_views(tmp_path):
    data = bytearray(material.bdi(material.pictures(1, 2)))
    table = material.directions(material.ANGLES)
    at = data.index(table) + len(table) - 4
    data[at : at + 4] = struct.pack("<f", 0.1)
    with pytest.raises(InputError, match="differ from view to view"):
        open_source(written(tmp_path, bytes(data)))


@pytest.mark.parametrize(
    ("kind", "message"), [("nan", "not finite"), ("inf", "not finite"), ("big", "float16")]
)
def test_values_that_no_store_holds(kind, message, tmp_path):
    data = bytearray(material.dfmf(material.pictures(1, 2)))
    data[-4:] = struct.pack("<f", {"nan": np.nan, "inf": np.inf, "big": 1e9}[kind])
    out = tmp_path / "out.btf.zarr"
    with pytest.raises(InputError, match=message):
        import_btf(written(tmp_path, bytes(data)), out)
    assert not out.exists()


@pytest.fixture(scope="module")
def sampled():
    grid = directions("ubo81")
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 1, (6, 81 * 81)).T @ rng.uniform(0, 0.6, (6, 6 * 9 * 3))
    return SampledBTF(values.reshape(81, 81, 6, 9, 3).astype(np.float16), grid, grid, None, {})


def test_bdi_round_trip_is_exact(sampled, tmp_path):
    export_btf(sampled, tmp_path / "x.btf", "bonn", family="BDI", memory=6 << 20)
    back = SampledBTF.load(import_btf(tmp_path / "x.btf", tmp_path / "x.btf.zarr", memory=64 << 20).path)
    assert np.array_equal(back.values, sampled.values)
    assert back.views == sampled.views
    assert back.lights.name == "ubo81"


@pytest.mark.parametrize("model", [0, 11])
def test_dfmf_error_is_what_it_says(model, sampled, tmp_path):
    """The stated error per channel is the one found, in the colour model's values; here of rank 3 of 6."""
    facts = export_btf(sampled, tmp_path / "x.btf", "bonn", components=3, scalar=4, colour_model=model)
    back = SampledBTF.load(import_btf(tmp_path / "x.btf", tmp_path / "x.btf.zarr", dtype="float32").path)
    if model == 0:
        original = sampled.values.astype(float)
        error = np.sqrt(((back.values - original) ** 2).sum((0, 1, 2, 3)) / (original**2).sum((0, 1, 2, 3)))
        np.testing.assert_allclose(error, facts["error"], rtol=tolerance("formats.stated.rtol"))
        best = np.linalg.svd(
            texel_matrix(sampled.values[..., :1].repeat(3, -1))[:, ::3].astype(float), compute_uv=False
        )
        optimum = np.sqrt((best[3:] ** 2).sum() / (best**2).sum())
        assert optimum <= facts["error"][0] * (1 + tolerance("formats.dfmf_best.below"))
        assert facts["error"][0] <= optimum * tolerance("formats.dfmf_optimum.ratio")
    assert facts["components"] == [3, 3, 3]


def test_a_tile_is_repeated(sampled, tmp_path):
    """A file larger than the BTF, which is what it says: the error against the repeated tile is the stated one."""
    facts = export_btf(sampled, tmp_path / "x.btf", "bonn", components=3, scalar=4, texels=13)
    back = SampledBTF.load(import_btf(tmp_path / "x.btf", tmp_path / "x.btf.zarr", dtype="float32").path)
    rows, columns = (np.arange(13) % n for n in sampled.texels)
    original = sampled.values[:, :, rows[:, None], columns].astype(float)
    error = np.sqrt(((back.values - original) ** 2).sum((0, 1, 2, 3)) / (original**2).sum((0, 1, 2, 3)))
    np.testing.assert_allclose(error, facts["error"], rtol=tolerance("formats.stated.rtol"))
    export_btf(sampled, tmp_path / "y.btf", "bonn", family="BDI", texels=13)
    back = SampledBTF.load(import_btf(tmp_path / "y.btf", tmp_path / "y.btf.zarr").path)
    assert np.array_equal(back.values, original.astype(np.float16))


def test_dfmf_for_a_target_error(sampled, tmp_path):
    wanted = 0.05
    facts = export_btf(sampled, tmp_path / "x.btf", "bonn", error=wanted, scalar=4)
    assert max(facts["error"]) <= wanted
    fewer = export_btf(sampled, tmp_path / "y.btf", "bonn", components=min(facts["components"]) - 1)
    assert max(fewer["error"]) > wanted


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"family": "FMF"}, "family"),
        ({"colour_model": 3}, "colour_model"),
        ({"scalar": 8}, "scalar"),
        ({"components": 0}, "components"),
        ({"texels": 0}, "texels"),
        ({"error": 2}, "error"),
        ({"error": 0.1, "components": 2}, "components"),
        ({"nonsense": 1}, "nonsense"),
    ],
)
def test_bad_settings(settings, field, sampled, tmp_path):
    with pytest.raises(InputError) as caught:
        export_btf(sampled, tmp_path / "x.btf", "bonn", **settings)
    assert caught.value.field == field
    assert list(tmp_path.iterdir()) == []


def test_black_has_no_logarithm(sampled, tmp_path):
    black = SampledBTF(sampled.values - np.float16(1), sampled.views, sampled.lights, None, {})
    with pytest.raises(InputError, match="luminance"):
        export_btf(black, tmp_path / "x.btf", "bonn", colour_model=11)
    assert list(tmp_path.iterdir()) == []
