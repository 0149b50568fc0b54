"""Folders of maps as libraries of assets ship them: found by name, of any depth, upright; the rest is named."""

import shutil

import numpy as np
import pytest
from PIL import Image

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.mesostructure.materials import load_bsdf, read_image

N = 8


def _waves(n=N, shift=0.0):
    x = (np.arange(n) + 0.5) / n
    return 0.5 + 0.2 * (np.sin(2 * np.pi * (x + shift))[None] + np.cos(2 * np.pi * x)[:, None])


def _colours():
    return np.stack([_waves(shift=s) for s in (0, 0.3, 0.7)], -1)


def _codes(values, top=255):
    return np.round(values * top).astype(np.uint16 if top > 255 else np.uint8)


def _normals():
    """Codes of a normal map that leans to the right and up of the picture."""
    n = np.broadcast_to(np.array([0.3, 0.4, 0.8660254]), (N, N, 3))
    return _codes((n + 1) / 2)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "Rock_2K"
    path.mkdir()
    Image.fromarray(_codes(_colours())).save(path / "Rock_2K_Color.png")
    Image.fromarray(_codes(_waves(), 65535)).save(path / "Rock_2K_Displacement.png")
    Image.fromarray(_codes(_waves(shift=0.5))).save(path / "Rock_2K_Roughness.png")
    return path


def test_maps_reach_the_surface_upright(folder, llvm):
    (part,) = build(folder, amplitude=0.2).parts
    heights = _codes(_waves(), 65535)[::-1] / 65535
    place = {(round(x * N - 0.5), round(y * N - 0.5)): z for x, y, z in part.vertices}
    z = np.array([[place[column, row] for column in range(N)] for row in range(N)])
    assert np.array_equal(z, 0.2 * (heights - heights.max()))
    si = llvm.SurfaceInteraction3f()
    row, column = np.mgrid[0:N, 0:N]
    si.uv = llvm.Point2f(((column + 0.5) / N).ravel(), ((row + 0.5) / N).ravel())
    got = np.array(load_bsdf(part).eval_diffuse_reflectance(si)).T.reshape(N, N, 3)
    c = _codes(_colours())[::-1] / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    assert np.abs(got - linear).max() <= tolerance("mesostructure.texture")
    down = build(folder, amplitude=0.2, rows="down").parts[0].textures
    for name, image in part.textures.items():
        assert np.array_equal(image[::-1], down[name])


@pytest.mark.parametrize(
    ("kind", "top"),
    [(".png", 255), (".png", 65535), (".tif", 255), (".tif", 65535), (".jpg", 255), (".exr", 0)],
)
def test_colours_of_any_depth_and_kind(tmp_path, kind, top):
    """16-bit colours keep their bits; Pillow by itself cuts them to 8."""
    path = tmp_path / f"a{kind}"
    if kind == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": _colours().astype(np.float32)}) as file:
            file.write(str(path))
        assert np.array_equal(read_image(path), _colours().astype(np.float32))
        return
    codes = _codes(_colours(), top)
    if top == 255:
        Image.fromarray(codes).save(path, **({"quality": 95, "subsampling": 0} if kind == ".jpg" else {}))
    elif kind == ".tif":
        import tifffile

        tifffile.imwrite(path, codes, photometric="rgb")
    else:
        _write_png16(path, codes)
    found = read_image(path)
    assert found.dtype == codes.dtype
    if kind == ".jpg":
        codes = np.asarray(Image.open(path))
    assert np.array_equal(found, codes)


def _write_png16(path, codes):
    """Pillow cannot: rows without a filter, big-endian."""
    import struct
    import zlib

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in codes)
    head = struct.pack(">IIBBBBB", codes.shape[1], codes.shape[0], 16, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_what_is_ignored_is_named(folder):
    Image.fromarray(_normals()).save(folder / "Rock_2K_NormalGL.png")
    Image.fromarray(_normals()).save(folder / "Rock_2K_NormalDX.png")
    Image.fromarray(_codes(_waves())).save(folder / "Rock_2K_AmbientOcclusion.jpg")
    (folder / "Rock.blend").write_text("x")
    (folder / ".DS_Store").write_text("x")
    assert build(folder).ignored == (
        "files that are no map of a known name (Rock.blend)",
        "normal map whose green points down; *_NormalGL is read (Rock_2K_NormalDX.png)",
        "ambient occlusion: paths find it themselves (Rock_2K_AmbientOcclusion.jpg)",
        "normal map beside a displacement, which has its slopes (Rock_2K_NormalGL.png)",
    )


def test_without_a_displacement_the_normal_map_turns_the_normals(folder, llvm):
    (folder / "Rock_2K_Displacement.png").unlink()
    Image.fromarray(_normals()).save(folder / "Rock_2K_NormalGL.png")
    for rows, up in (("up", 1), ("down", -1)):
        tile = build(folder, rows=rows)
        assert tile.height == (0, 0)
        assert not tile.ignored
        codes = np.round(tile.parts[0].textures["normal"][3, 3] * 255)
        assert codes.tolist() == [166, 178 if up > 0 else 77, 238]
        load_bsdf(tile.parts[0])


def test_other_libraries_names(folder, tmp_path):
    other = tmp_path / "poly"
    other.mkdir()
    for old, new in (
        ("Color", "rock_wall_diff_1k"),
        ("Displacement", "rock_wall_disp_1k"),
        ("Roughness", "rock_wall_rough_1k"),
    ):
        shutil.copy(folder / f"Rock_2K_{old}.png", other / f"{new}.png")
    first, second = (build(path).parts[0] for path in (folder, other))
    assert np.array_equal(first.vertices, second.vertices)
    assert all(np.array_equal(image, second.textures[name]) for name, image in first.textures.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: shutil.copy(f / "Rock_2K_Color.png", f / "Rock_Albedo.png"), "two maps of colour.*Rock_Albedo"),
        (lambda f: shutil.copy(f / "Rock_2K_Color.png", f / "Rock_Emission.png"), "map of emission"),
        (lambda f: shutil.copy(f / "Rock_2K_Color.png", f / "Rock_Opacity.png"), "map of opacity"),
        (lambda f: [p.unlink() for p in f.iterdir()], r"no maps in the folder.*\*_Displacement"),
        (lambda f: (f / "Rock_2K_Color.png").write_bytes(b"x"), "cannot read the image.*colour"),
        (lambda f: Image.fromarray(_codes(np.linspace(0, 1, 64).reshape(8, 8))).save(f / "Rock_2K_Roughness.png"),
         "does not tile: roughness"),
    ],
)  # fmt: skip
def test_a_folder_that_cannot_be_used_is_one_line(folder, change, message):
    change(folder)
    with pytest.raises(InputError, match=message) as error:
        build(folder)
    assert "\n" not in str(error.value)
