"""MERL tables and MIF containers, the conversion itself, and the commands."""

import json
import os
import struct

import formats_material as material
import numpy as np
import pytest
from stores import imported

from btfref.cli import main
from btfref.errors import InputError
from btfref.formats import FORMATS, format_named, identify, import_btf, merl, names, open_source
from btfref.formats.convert import import_btf as convert
from btfref.gates import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.sampling import SampledBTF, open_store


def test_every_format_is_named_and_titled():
    assert names()[: len(FORMATS)] == list(FORMATS)
    for name in names():
        row = format_named(name)
        assert row.name == name
        assert row.title


# --- MERL ---------------------------------------------------------------------------------------------------------


def test_merl_constant(tmp_path):
    """A Lambertian table: B = ρ/π · cos θ_light for every pair, exactly."""
    path = tmp_path / "x.binary"
    albedo = np.array([0.8, 0.5, 0.25])
    path.write_bytes(material.merl(lambda h, d, p: np.broadcast_to(albedo / np.pi, (*h.shape, 3))))
    assert identify(path) == "merl"
    btf = imported(path)
    assert btf.values.shape == (81, 81, 1, 1, 3)
    expected = albedo / np.pi * btf.lights.vectors[:, 2:]
    np.testing.assert_allclose(
        btf.values[:, :, 0, 0], np.broadcast_to(expected, (81, 81, 3)), rtol=tolerance("formats.float32.rtol")
    )


def test_merl_coordinates(tmp_path):
    """A table of half and difference angles gives those angles back, to half a cell."""
    path, counts = tmp_path / "x.binary", (90, 90, 180)
    path.write_bytes(material.merl(lambda h, d, p: np.stack([h, d, p], -1) + 1, counts))
    source = open_source(path, views="4x9", lights="5x7")
    rng = np.random.default_rng(0)
    for view in rng.integers(0, len(source.views), 6):
        found = source.colours(int(view), 0, len(source.lights))[:, 0, 0] - 1
        light, w_view = source.lights.vectors, source.views.vectors[view]
        half = light + w_view
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        theta_h, theta_d = np.arccos(half[:, 2]), np.arccos(np.clip((half * light).sum(1), -1, 1))
        # Cells of θ_h widen towards the horizon: θ = (i/n)² π/2 has the step π i/n².
        cell = np.pi / 90 * np.sqrt(theta_h / (np.pi / 2))
        assert (np.abs(found[:, 0] - theta_h) <= cell + tolerance("formats.merl_cells.half")).all()
        assert (
            np.abs(found[:, 1] - theta_d) <= np.pi / 360 + tolerance("formats.merl_cells.difference")
        ).all()


def test_merl_is_reciprocal_and_isotropic():
    """Swapping the directions, or turning both, stays in the cell."""
    rng = np.random.default_rng(1)
    w = rng.normal(size=(2, 500, 3))
    w[..., 2] = np.abs(w[..., 2]) + 0.05
    w /= np.linalg.norm(w, axis=-1, keepdims=True)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    fine = 10**6, 10**6, 10**6  # cells so small that the cell is the angle
    cells = np.array(merl.cell(w[0], w[1], fine))
    for other in (merl.cell(w[1], w[0], fine), merl.cell(w[0] @ turn.T, w[1] @ turn.T, fine)):
        difference = np.abs(cells - np.array(other))
        assert np.minimum(difference, 10**6 - difference).max() <= 1
    assert len(np.unique(cells[2] // 10**4)) > 50


def test_merl_truncated_and_padded(tmp_path):
    data = material.merl(lambda h, d, p: np.ones((*h.shape, 3)))
    for wrong in (data[:-1], data[:11], data + b"x", struct.pack("<3i", -1, 8, 16) + data[12:]):
        (tmp_path / "x.binary").write_bytes(wrong)
        with pytest.raises(InputError, match=r"at byte|known format"):
            open_source(tmp_path / "x.binary")


def test_negative_entries_count_as_black(tmp_path):
    (tmp_path / "x.binary").write_bytes(material.merl(lambda h, d, p: np.full((*h.shape, 3), -1.0)))
    assert not imported(tmp_path / "x.binary", views="2x4", lights="2x4").values.any()


# --- MIF ----------------------------------------------------------------------------------------------------------

PAIRS = [(light, view) for view in material.ANGLES for light in material.ANGLES]


def mif_of(values, **options):
    images = [image.astype(np.float32) for image in values.reshape(25, *values.shape[2:])]
    return material.mif(images, PAIRS, **options)


@pytest.mark.parametrize("reference", [False, True])
def test_mif(reference, tmp_path):
    from btfref.numerics.colour import RGB_TO_XYZ

    values = material.pictures()
    path = tmp_path / "x.mif"
    path.write_bytes(mif_of(values @ RGB_TO_XYZ.T * 100, reference=reference))
    assert identify(path) == "mif"
    expected = material.stored(values, cosine_included=False, scale=1 / np.pi)
    np.testing.assert_allclose(
        imported(path).values,
        expected,
        rtol=tolerance("formats.spectral_mif.rtol"),
        atol=tolerance("formats.spectral_mif.atol"),
    )


def test_mif_index_map_and_types(tmp_path):
    values = material.pictures(largest=1)
    order = np.random.default_rng(0).permutation(25)
    codes = np.round(values.reshape(25, 3, 4, 3) * 255).astype(np.uint8)
    images = [None] * 25
    for pair, index in enumerate(order):
        images[index] = codes[pair]
    (tmp_path / "x.mif").write_bytes(material.mif(images, PAIRS, space="sRGB", order=order.tolist()))
    from btfref.numerics.colour import decode_srgb

    linear = decode_srgb(codes / 255).reshape(values.shape)
    expected = material.stored(linear, cosine_included=False, scale=1 / np.pi)
    np.testing.assert_allclose(
        imported(tmp_path / "x.mif").values, expected, rtol=tolerance("formats.decoded.rtol")
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:-9], "truncated"),
        (lambda d: d + b"abc", "truncated"),
        (lambda d: d.replace(b"<mif>", b"<!DOCTYPE a><mif>"), "truncated|document type"),
        (lambda d: d.replace(b'<?xml version="1.0"?>', b"<!DOCTYPE a []>      "), "document type"),
        (lambda d: d.replace(b"<mif>", b"<mif "), "XML"),
        (lambda d: d.replace(b'type="source"', b'type="sensor"'), "directions"),
        (lambda d: d.replace(b'theta="30"', b'theta="99"', 1), "directions"),
        (lambda d: d.replace(b"<color_space>XYZ", b"<color_space>LAB"), "colour space"),
        (lambda d: d[:8] + struct.pack("<Q", 9) + d[16:], "no MIF file"),
        (lambda d: d[:16] + struct.pack("<Q", 2) + d[24:], "version"),
    ],
)
def test_damaged_mif(change, message, tmp_path):
    (tmp_path / "x.mif").write_bytes(change(mif_of(material.pictures())))
    with pytest.raises(InputError, match=message):
        import_btf(tmp_path / "x.mif", tmp_path / "x.btf.zarr")
    assert not (tmp_path / "x.btf.zarr").exists()


def test_mif_with_a_signalling_nan(tmp_path):
    """Arithmetic with it raises an invalid operation; it is refused as any other NaN is."""
    data = bytearray(mif_of(material.pictures()))
    at = data.index(material.pictures()[0, 0].astype(np.float32).tobytes())
    data[at : at + 4] = struct.pack("<I", 0x7F800001)
    (tmp_path / "x.mif").write_bytes(data)
    with np.errstate(invalid="raise", over="raise"):
        assert np.isnan(open_source(tmp_path / "x.mif").colours(0, 0, 1)).any()
        with pytest.raises(InputError, match="view 0, light 0"):
            import_btf(tmp_path / "x.mif", tmp_path / "x.btf.zarr")


# --- the conversion -----------------------------------------------------------------------------------------------


@pytest.fixture
def bdi(tmp_path):
    path = tmp_path / "x.btf"
    path.write_bytes(material.bdi(material.pictures()))
    return path


class StopError(Exception):
    pass


def tree(store):
    return {entry.relative_to(store): entry.read_bytes() for entry in store.rglob("*") if entry.is_file()}


def test_an_interrupted_conversion_goes_on(bdi, tmp_path):
    def stop(done, total, label):
        assert (total, label) == (5, "import")
        if done == 2:
            raise StopError

    whole, part = tmp_path / "whole.btf.zarr", tmp_path / "part.btf.zarr"
    convert(bdi, whole)
    with pytest.raises(StopError):
        convert(bdi, part, progress=stop)
    assert open_store(part).coverage.any(axis=(1, 2, 3)).tolist() == [True, True, False, False, False]
    with pytest.raises(InputError, match="incomplete"):
        SampledBTF.load(part)
    seen = []
    convert(bdi, part, progress=lambda done, *_: seen.append(done))
    assert seen == [3, 4, 5]
    assert tree(part) == tree(whole)


def test_other_settings_are_refused(bdi, tmp_path):
    out = tmp_path / "x.btf.zarr"
    convert(bdi, out)
    before = tree(out)
    for settings in ({"scale": 2.0}, {"rows": "down"}, {"cosine": "excluded"}, {"dtype": "float32"}):
        with pytest.raises(InputError, match="other settings"):
            convert(bdi, out, **settings)
        assert tree(out) == before
    bdi.write_bytes(material.bdi(material.pictures(seed=1)))
    with pytest.raises(InputError, match="fingerprint"):
        convert(bdi, out)
    assert convert(bdi, out, overwrite=True).complete
    assert tree(out) != before


def test_an_error_half_way_leaves_nothing(tmp_path):
    values = material.pictures()
    values[3, 2] = np.nan
    path, out = tmp_path / "x.btf", tmp_path / "x.btf.zarr"
    path.write_bytes(material.bdi(values))
    with pytest.raises(InputError, match="view 3, light 2"):
        convert(path, out)
    assert not out.exists()


def test_memory_is_a_limit(bdi, tmp_path):
    big = tmp_path / "big.binary"
    big.write_bytes(material.merl(lambda h, d, p: np.ones((*h.shape, 3))))
    with pytest.raises(InputError, match="memory"):
        convert(bdi, tmp_path / "x.btf.zarr", memory=1000)
    values = material.pictures(64, 256)
    bdi.write_bytes(material.bdi(values))
    with pytest.raises(InputError, match="one view needs more memory"):
        convert(bdi, tmp_path / "x.btf.zarr", memory=1 << 20)
    assert not (tmp_path / "x.btf.zarr").exists()


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"dtype": "float64"}, "dtype"),
        ({"cosine": "yes"}, "cosine"),
        ({"rows": "left"}, "rows"),
        ({"scale": 0}, "scale"),
        ({"gamma": 2.2}, "gamma"),
        ({"format": "nonsense"}, "format"),
    ],
)
def test_bad_settings(settings, field, bdi, tmp_path):
    with pytest.raises(InputError) as caught:
        convert(bdi, tmp_path / "x.btf.zarr", **settings)
    assert caught.value.field == field
    assert not (tmp_path / "x.btf.zarr").exists()


# --- commands -----------------------------------------------------------------------------------------------------


def facts_of(capsys, *arguments):
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_commands(bdi, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    facts = facts_of(capsys, "info", "x.btf")
    assert (facts["kind"], facts["family"], facts["shape"]) == ("measured-btf", "BDI", [5, 5, 3, 4, 3])
    assert facts_of(capsys, "import", "x.btf", "-o", "x.btf.zarr")["parent"]["format"] == "bonn"
    assert (
        facts_of(capsys, "export", "x.btf.zarr", "-o", "y", "--format", "ubo", "--scale", "2")["images"] == 25
    )
    assert facts_of(capsys, "info", "y")["format"] == "ubo"
    assert facts_of(capsys, "import", "y", "-o", "y.btf.zarr")["complete"] is True
    assert (
        facts_of(capsys, "export", "x.btf.zarr", "-o", "z.btf", "--format", "bonn", "--error", "0.5")[
            "family"
        ]
        == "DFMF"
    )
    assert main(["info", "x.btf"]) == 0
    assert main(["import", "x.btf", "-o", "x.btf.zarr"]) == 0
    assert main(["fit", "raw", "x.btf.zarr", "-o", "x.raw.exr"]) == 0
    assert facts_of(capsys, "export", "x.raw.exr", "-o", "maps", "--format", "maps")["maps"] == len(
        list((tmp_path / "maps").glob("*.exr"))
    )
    image = facts_of(capsys, "info", next((tmp_path / "maps").glob("*.exr")))
    assert image["kind"] == "image"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["import", "none.btf", "-o", "o.btf.zarr"], "none.btf"),
        (["import", "text.txt", "-o", "o.btf.zarr"], "known format"),
        (["import", "empty.btf", "-o", "o.btf.zarr"], "empty"),
        (["import", "cut.btf", "-o", "o.btf.zarr"], "at byte"),
        (["import", "x.btf", "-o", "o.zip"], ".btf.zarr"),
        (["import", "x.btf", "-o", "none/o.btf.zarr"], "none"),
        (["import", "x.btf", "-o", "o.btf.zarr", "--gamma", "2"], "gamma"),
        (["import", "x.btf", "-o", "o.btf.zarr", "--scale", "nan"], "--scale"),
        (["import", "x.btf", "-o", "o.btf.zarr", "--format", "none"], "none"),
        (["import", "folder", "-o", "o.btf.zarr"], "known format"),
        (["info", "cut.btf"], "at byte"),
        (["info", "text.txt"], "text.txt"),
        (["export", "none.btf.zarr", "-o", "out", "--format", "ubo"], "none.btf.zarr"),
        (["export", "x.btf", "-o", "out", "--format", "ubo"], "x.btf"),
    ],
)
def test_bad_input(arguments, word, bdi, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.txt").write_text("no BTF")
    (tmp_path / "empty.btf").write_bytes(b"")
    (tmp_path / "cut.btf").write_bytes(bdi.read_bytes()[:-30])
    os.mkdir("folder")
    before = sorted(tmp_path.rglob("*"))
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("btfref: error: ")
    assert word in captured.err
    assert captured.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_help_names_every_format(capsys):
    assert main(["import", "--help"]) == 0
    text = capsys.readouterr().out
    for name in FORMATS:
        assert name in text


def test_ubo_directions_are_recognised_to_float32():
    grid = directions("ubo151")
    angles = np.stack([grid.theta, grid.phi]).astype(np.float32).astype(float)
    from btfref.formats.source import direction_set

    assert direction_set(*angles, "x") == grid
