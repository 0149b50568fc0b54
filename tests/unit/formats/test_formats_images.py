"""Folders and archives of pictures: names, moved lights, missing pictures, colours, orientation, hostile archives."""

import io
import json
import struct
import tempfile
import zipfile
import zlib

import formats_material as material
import numpy as np
import pytest
from PIL import Image
from stores import imported

from btfref.errors import InputError
from btfref.formats import export_btf, identify, import_btf, open_source
from btfref.formats.image_sets.angles import angles_of, grid
from btfref.gates import tolerance
from btfref.images import decoding, radiance
from btfref.numerics.colour import RGB_TO_XYZ, decode_srgb
from btfref.numerics.sphere.directions import DirectionSet, directions, spherical
from btfref.sampling import SampledBTF

ANGLES = material.ANGLES
DECODED = tolerance("formats.decoded.rtol")


def ubo_name(light, view, end="png", number=0):
    return "tv{2:03d}_pv{3:03d}/{4:05d} tl{0:03d} pl{1:03d} tv{2:03d} pv{3:03d}.{5}".format(
        *light, *view, number, end
    )


def utia_name(light, view, end="png"):
    return "tv{2:03d}_pv{3:03d}/tl{0:03d}_pl{1:03d}_tv{2:03d}_pv{3:03d}.{4}".format(*light, *view, end)


def spectral_name(light, view):
    return "tv{2:05.1f}_pv{3:05.1f}_tl{0:05.1f}_pl{1:05.1f}.exr".format(*light, *view)


def folder(path, name=ubo_name, make=None, values=None, skip=()):
    """A folder of pictures; ``values`` (view, light, row, column, 3) in the pictures' own quantity."""
    values = material.pictures(largest=1) if values is None else values
    make = make or (lambda colours: material.picture(colours))
    for v, view in enumerate(ANGLES):
        for number, light in enumerate(ANGLES):
            if (light, view) in skip:
                continue
            target = path / name(light, view)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(make(values[v, number]))
    return path


def archive(path, source):
    with zipfile.ZipFile(path, "w") as target:
        for entry in sorted(source.rglob("*")):
            if entry.is_file():
                target.write(entry, f"MANYFILES/{entry.relative_to(source)}")
    return path


def exr(planes):
    def make(colours):
        with tempfile.NamedTemporaryFile(suffix=".exr") as stream:
            decoding.write_exr(planes(colours), stream.name)
            return stream.read()

    return make


def rgb(colours):
    return dict(zip("RGB", np.moveaxis(colours, -1, 0), strict=True))


def xyz(colours):
    return dict(zip("XYZ", np.moveaxis(colours @ RGB_TO_XYZ.T * 100, -1, 0), strict=True))


def codes(values):
    return np.round(np.clip(values, 0, 1) * 255) / 255


@pytest.mark.parametrize("zipped", [False, True])
def test_ubo(zipped, tmp_path):
    values = material.pictures(largest=1)
    path = folder(tmp_path / "ubo", values=values)
    path = archive(tmp_path / "ubo.zip", path) if zipped else path
    assert identify(path) == "ubo"
    np.testing.assert_allclose(imported(path).values, material.stored(codes(values) ** 2.2), rtol=DECODED)
    other = imported(path, tmp_path / "other.btf.zarr", gamma=1.0, cosine="excluded", scale=0.5)
    expected = material.stored(codes(values), cosine_included=False, scale=0.5)
    np.testing.assert_allclose(other.values, expected, rtol=DECODED)


def test_utia(tmp_path):
    """Reflectance factors: f = value / π, times the light's cosine."""
    values = material.pictures()
    path = folder(tmp_path / "png", utia_name, values=values / 2)
    assert identify(path) == "utia"
    expected = material.stored(decode_srgb(codes(values / 2)), cosine_included=False, scale=1 / np.pi)
    np.testing.assert_allclose(imported(path).values, expected, rtol=DECODED)
    path = folder(tmp_path / "exr", lambda *pair: utia_name(*pair, end="exr"), exr(xyz), values)
    found = imported(path).values
    expected = material.stored(values, cosine_included=False, scale=1 / np.pi)
    assert np.abs(found - expected).max() <= tolerance("formats.half_xyz.max") * expected.max()
    assert found.max() > 1 / np.pi  # reflectance above 1 survives


def test_colours_outside_the_gamut_keep_their_negative_channel(tmp_path):
    green = np.broadcast_to([-0.25, 0.5, 0.0], (5, 5, 2, 2, 3))
    path = folder(tmp_path / "exr", lambda *pair: utia_name(*pair, end="exr"), exr(xyz), green)
    assert imported(path).values[0, 0, 0, 0, 0] == pytest.approx(
        -0.25 / np.pi, rel=tolerance("formats.half_negative.rtol")
    )


def test_spectral(tmp_path):
    """A spectrum that is 0.5 everywhere is grey 0.5 under D65, whatever the wavelengths."""
    names = ("400", "475.5", "550", "610", "700nm")

    def planes(colours):
        return {name: colours[..., 0] for name in names}

    values = material.pictures()
    path = folder(tmp_path / "s", spectral_name, exr(planes), values)
    assert identify(path) == "spectral"
    expected = material.stored(np.repeat(values[..., :1], 3, -1), cosine_included=False)
    np.testing.assert_allclose(imported(path).values, expected, rtol=tolerance("formats.spectrum.rtol"))


def test_spectral_refuses_colours(tmp_path):
    path = folder(tmp_path / "s", spectral_name, exr(rgb))
    with pytest.raises(InputError, match="wavelengths"):
        imported(path)


def test_atrium_hdr(tmp_path):
    """Its reversed resolution line: scan lines are rows from the bottom to the top."""
    values = material.pictures()
    name = lambda *pair: ubo_name(*pair, end="hdr")  # noqa: E731
    path = folder(tmp_path / "hdr", name, lambda v: radiance.encode(v, reversed_line=True), values)
    found = imported(path).values
    assert b"+X 4 -Y 3\n" in (path / name(ANGLES[0], ANGLES[0])).read_bytes()
    error = np.abs(found - material.stored(values)).max(-1) / material.stored(values).max(-1)
    assert error.max() <= tolerance("formats.radiance.max")
    usual = folder(tmp_path / "usual", name, radiance.encode, values)
    np.testing.assert_array_equal(imported(usual).values, found)


def test_radiance_run_lengths():
    """Runs and literals, as Radiance writes lines of 8 pixels and more."""
    line = b"\x02\x02\x00\x0a" + b"\x8a\x40" + b"\x04\x01\x02\x03\x04\x86\x20" + b"\x8a\x80" + b"\x8a\x81"
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 10\n" + 2 * line
    found = radiance.decode(data, "x.hdr")
    assert found.shape == (2, 10, 3)
    np.testing.assert_allclose(found[1, :5, 1] * 128, np.array([1, 2, 3, 4, 32]) + 0.5)
    np.testing.assert_allclose(found[..., 2] * 128, 128.5)
    for length in range(len(data)):
        with pytest.raises(InputError):
            radiance.decode(data[:length], "x.hdr")


@pytest.mark.parametrize("end", ["jpg", "png", "exr", "hdr"])
def test_orientation(end, tmp_path):
    """The top left corner of a picture is the last row and first column of the store."""
    values = np.full((5, 5, 16, 24, 3), 0.25)
    values[:, :, :8, :8] = 1, 0.5, 0
    make = {
        "jpg": lambda v: material.picture(v, "jpg"),
        "png": material.picture,
        "exr": exr(rgb),
        "hdr": lambda v: radiance.encode(v, reversed_line=True),
    }[end]
    found = imported(
        folder(tmp_path / end, lambda *pair: ubo_name(*pair, end=end), make, values), gamma=1.0
    ).values[1, 2]
    assert found.shape == (16, 24, 3)
    np.testing.assert_allclose(found[-1, 0], [1, 0.5, 0], atol=tolerance("formats.corner.max_abs"))
    for corner in (found[0, 0], found[0, -1], found[-1, -1]):
        np.testing.assert_allclose(corner, 0.25, atol=tolerance("formats.corner.max_abs"))


def test_directions_come_from_the_names(tmp_path):
    source = open_source(folder(tmp_path / "ubo"))
    expected = spherical(*np.radians(np.array(ANGLES, float)).T)
    np.testing.assert_allclose(source.lights.vectors, expected, atol=tolerance("formats.names.max_abs"))
    ubo = [ubo_name(light, view) for light in full_ubo() for view in full_ubo()[:2]]
    assert grid(ubo, "x").lights == directions("ubo81")


def full_ubo():
    angles = np.degrees([directions("ubo81").theta, directions("ubo81").phi]).round().astype(int).T
    return [tuple(pair) for pair in angles.tolist()]


def test_angles_of_names():
    assert angles_of("a/00008 tl015 pl360 tv000 pv090.jpg") == (15, 0, 0, 0)
    assert angles_of("tv045.0_pv020.0_tl015.5_pl120.0.exr") == (15.5, 120, 45, 20)
    for name in (
        "readme.jpg",
        "tl015 pl000 tv000.jpg",
        "tl015 tl015 tv000 pv000.jpg",
        "tl1234 pl000 tv000 pv000.jpg",
    ):
        assert angles_of(name) is None


def test_moved_light(tmp_path):
    """The picture under the moved light takes its pair's place; what the cosine's change does is undone."""
    values = material.pictures(largest=1)

    def name(light, view):
        return ubo_name((light[0] + 10, light[1]) if light == view else light, view)

    path = folder(tmp_path / "moved", name, values=values)
    source = open_source(path)
    assert len(source.lights) == len(ANGLES)
    assert source.moved == {(i, i): (theta + 10, phi) for i, (theta, phi) in enumerate(ANGLES)}
    expected = material.stored(codes(values) ** 2.2)
    for i, (theta, _) in enumerate(ANGLES):
        expected[i, i] *= np.cos(np.radians(theta)) / np.cos(np.radians(theta + 10))
    store = import_btf(path, tmp_path / "m.btf.zarr", dtype="float32")
    np.testing.assert_allclose(SampledBTF.load(store.path).values, expected, rtol=DECODED)
    assert len(store.attributes["parent"]["lights_moved"]) == 5
    # Where the values do not hold the cosine, f is taken as it is.
    other = imported(path, tmp_path / "n.btf.zarr", cosine="excluded").values
    np.testing.assert_allclose(
        other, material.stored(codes(values) ** 2.2, cosine_included=False), rtol=DECODED
    )


def test_two_lights_moved_for_one_camera(tmp_path):
    path = folder(tmp_path / "x", skip={(ANGLES[0], ANGLES[0])})
    for light in ((10, 0), (12, 0)):
        (path / ubo_name(light, ANGLES[0])).write_bytes(material.picture(np.ones((3, 4, 3))))
    with pytest.raises(InputError, match="several lights"):
        open_source(path)


def test_missing_pictures(tmp_path):
    gone = {(ANGLES[1], ANGLES[2]), (ANGLES[4], ANGLES[2])}
    path = folder(tmp_path / "gaps", skip=gone)
    with pytest.raises(InputError, match=r"light 30° 0°, camera 30° 90°.*2 of 25 missing"):
        import_btf(path, tmp_path / "x.btf.zarr")
    store = import_btf(path, tmp_path / "x.btf.zarr", allow_missing=True)
    assert not store.complete
    covered = store.coverage.all(axis=(2, 3))
    assert np.argwhere(~covered).tolist() == [[2, 1], [2, 4]]
    assert store.read(views=2, lights=[0, 2, 3])[0].shape[1] == 3
    with pytest.raises(InputError, match="not there"):
        store.read(views=2)
    with pytest.raises(InputError, match="2 images are missing"):
        SampledBTF.load(store.path)
    assert np.array_equal(import_btf(path, store.path, allow_missing=True).coverage, store.coverage)


def test_the_same_pair_twice(tmp_path):
    path = folder(tmp_path / "x")
    (path / ubo_name(ANGLES[1], ANGLES[2], number=7)).write_bytes(b"")
    with pytest.raises(InputError, match="two images of one pair"):
        open_source(path)


def test_pictures_of_different_sizes(tmp_path):
    path = folder(tmp_path / "x")
    (path / ubo_name(ANGLES[1], ANGLES[2])).write_bytes(material.picture(np.ones((4, 3, 3))))
    with pytest.raises(InputError, match=r"tv030 pv090\.png: picture of another size.*4 × 3.*3 × 4"):
        import_btf(path, tmp_path / "x.btf.zarr")
    assert not (tmp_path / "x.btf.zarr").exists()


def test_a_picture_that_promises_too_much(tmp_path):
    """Sizes are compared before a picture is decoded."""
    path = folder(tmp_path / "x")
    data = bytearray(material.picture(np.ones((3, 4, 3))))
    data[16:24] = struct.pack(">II", 60000, 60000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    for target in path.rglob("*.png"):
        target.write_bytes(data)
    with pytest.raises(InputError, match=r"size of a picture|cannot be read"):
        open_source(path)


@pytest.mark.parametrize(
    "name",
    [
        "/tmp/tl000 pl000 tv000 pv000.png",
        "../tl000 pl000 tv000 pv000.png",
        "a/../../tl000 pl000 tv000 pv000.png",
        "C:/tl000 pl000 tv000 pv000.png",
        "..\\tl000 pl000 tv000 pv000.png",
    ],
)
def test_names_that_leave_the_archive(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as target:
        target.writestr(zipfile.ZipInfo(name), b"x")
    with pytest.raises(InputError, match="leaves the archive"):
        open_source(tmp_path / "x.zip")


def test_bomb(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr(ubo_name(ANGLES[0], ANGLES[0]), bytes(64 << 20))
    with pytest.raises(InputError, match="unpacks to too much"):
        open_source(path)


def test_entries_that_lie_about_their_size(tmp_path):
    """More bytes than the directory says are never unpacked."""
    path = archive(tmp_path / "x.zip", folder(tmp_path / "x"))
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 20)
    path.write_bytes(data)
    with pytest.raises(InputError):
        import_btf(path, tmp_path / "out.btf.zarr")
    assert not (tmp_path / "out.btf.zarr").exists()


def test_entries_that_share_their_bytes(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as target:
        target.writestr("a.png", bytes(1000))
        first = target.getinfo("a.png")
        for number in range(50):
            copy = zipfile.ZipInfo(f"{number}.png")
            copy.file_size = copy.compress_size = 1000
            copy.CRC, copy.header_offset = first.CRC, first.header_offset
            target.filelist.append(copy)
    with pytest.raises(InputError, match="overlap"):
        open_source(path)


@pytest.fixture(scope="module")
def sampled():
    """A small BTF on directions of whole degrees."""
    grid = DirectionSet(spherical(*np.radians(np.array(ANGLES, float)).T))
    return SampledBTF(material.pictures(8, 12).astype(np.float16), grid, grid, None, {})


@pytest.mark.parametrize("name", ["out", "out.zip"])
@pytest.mark.parametrize(
    ("format", "settings", "gate"),
    [
        ("ubo", {"image": "exr"}, "formats.half_rgb"),
        ("ubo", {"image": "hdr"}, "formats.radiance"),
        ("ubo", {"image": "png", "scale": 2}, "formats.code_gamma"),
        ("utia", {"image": "exr"}, "formats.half_xyz"),
        ("utia", {"image": "png", "scale": 10}, "formats.code_srgb"),
    ],
)
def test_round_trip(format, settings, gate, name, sampled, tmp_path):
    facts = export_btf(sampled, tmp_path / name, format, **settings)
    assert facts["images"] == 25
    assert facts["clipped"] == 0
    found = imported(tmp_path / name)
    np.testing.assert_allclose(
        found.views.vectors, sampled.views.vectors, atol=tolerance("interpolation.exact.max")
    )
    error = np.abs(found.values - sampled.values.astype(float)).max() / sampled.values.max()
    assert error <= tolerance(f"{gate}.max")
    again = tmp_path / f"again_{name}"
    export_btf(sampled, again, format, **settings)
    assert [entry.name for entry in tmp_path.glob(".*")] == []
    if name.endswith(".zip"):
        assert again.read_bytes() == (tmp_path / name).read_bytes()


def test_jpeg_errs_as_jpeg_does(sampled, tmp_path):
    """What comes back is what Pillow makes of the same codes, and nothing is added to that."""
    export_btf(sampled, tmp_path / "x", "ubo", image="jpg", scale=2, quality=90)
    found = imported(tmp_path / "x").values
    codes = np.round(255 * (sampled.values.astype(np.float32) / 2) ** (1 / 2.2)).astype(np.uint8)[:, :, ::-1]
    for pair in ((0, 0), (2, 3), (4, 1)):
        stream = io.BytesIO()
        Image.fromarray(codes[pair]).save(stream, "JPEG", quality=90, subsampling=0)
        expected = 2 * (np.asarray(Image.open(stream)) / 255) ** 2.2
        np.testing.assert_allclose(
            found[pair][::-1], expected, rtol=DECODED, atol=tolerance("formats.decoded.atol")
        )


def test_clipped_values_are_counted(sampled, tmp_path):
    facts = export_btf(sampled, tmp_path / "x", "ubo", image="png")
    assert facts["clipped"] == pytest.approx((sampled.values > 1).mean())


def test_lights_moved_on_export(sampled, tmp_path):
    export_btf(sampled, tmp_path / "x", "ubo", image="exr", moved=10)
    source = open_source(tmp_path / "x")
    assert source.moved == {(i, i): (theta + 10, phi) for i, (theta, phi) in enumerate(ANGLES)}
    assert len(list((tmp_path / "x").rglob("*.exr"))) == 25


@pytest.mark.parametrize(
    ("format", "settings", "message"),
    [
        ("ubo", {"image": "tif"}, "image"),
        ("utia", {"image": "jpg"}, "image"),
        ("ubo", {"quality": 101}, "quality"),
        ("ubo", {"scale": -1}, "scale"),
        ("spectral", {}, "only read"),
        ("nonsense", {}, "unknown format"),
    ],
)
def test_bad_settings(format, settings, message, sampled, tmp_path):
    with pytest.raises(InputError, match=message):
        export_btf(sampled, tmp_path / "x", format, **settings)
    assert list(tmp_path.iterdir()) == []


def test_directions_that_names_cannot_say(tmp_path):
    grid = directions("2x5")
    btf = SampledBTF(np.zeros((10, 10, 2, 2, 3), np.float16), grid, grid, None, {})
    with pytest.raises(InputError, match=r"cannot name.*22\.5"):
        export_btf(btf, tmp_path / "x", "ubo")


def test_what_exists_is_kept(sampled, tmp_path):
    (tmp_path / "x").write_bytes(b"precious")
    with pytest.raises(InputError, match="exists"):
        export_btf(sampled, tmp_path / "x", "ubo")
    assert (tmp_path / "x").read_bytes() == b"precious"


@pytest.mark.parametrize(
    "note", ["{}", "[", json.dumps({"scale": "nan", "cosine_included": True}), "[" * 100000]
)
def test_damaged_note(note, tmp_path):
    path = folder(tmp_path / "x")
    (path / "btfref.json").write_text(note)
    with pytest.raises(InputError, match="note"):
        open_source(path)
