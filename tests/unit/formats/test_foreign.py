"""Files that people take for BTFs: what they are is said, and what to do; a lab's own names of pictures."""

import io
import json
import struct
import zipfile

import formats_material as material
import numpy as np
import pytest
from PIL import Image

from btfref.cli import main
from btfref.errors import InputError
from btfref.formats import identify, import_btf, open_source
from btfref.formats.image_sets.pattern import angles_by
from btfref.sampling import SampledBTF

ANGLES = material.ANGLES


def _zip(path, names):
    with zipfile.ZipFile(path, "w") as target:
        for name in names:
            target.writestr(name, b"x")
    return path


def _bytes(path, data):
    path.write_bytes(data)
    return path


def _rtif(path):
    return _bytes(path, b"#HSH1.2\n3\n512 512 3\n")


FOREIGN = {
    "rgl.bsdf": (lambda p: _bytes(p, b"tensor_file\0\x01\0" + bytes(50)), "measured BRDF of RGL", "measured"),
    "m003_carpet.bin": (lambda p: _bytes(p, bytes(1990656)), "BRDF of UTIA", "SampledBTF"),
    "coin.ptm": (
        lambda p: _bytes(p, b"PTM_1.2\nPTM_FORMAT_LRGB\n"),
        "polynomial texture map",
        "several cameras",
    ),
    "coin.rti": (_rtif, "hemispherical harmonics", "several cameras"),
    "vmlinux.btf": (
        lambda p: _bytes(p, struct.pack("<HBB", 0xEB9F, 1, 0) + bytes(40)),
        "Linux kernel",
        "Bonn",
    ),
    "a.h5": (lambda p: _bytes(p, b"\x89HDF\r\n\x1a\n" + bytes(40)), "HDF5", "SampledBTF"),
    "a.tar.gz": (lambda p: _bytes(p, b"\x1f\x8b" + bytes(40)), "archive of another kind", "unpack"),
    "pictures.zip": (
        lambda p: _zip(p, ["a/IMG_001.jpg", "a/IMG_002.jpg"]),
        "2 pictures.*IMG_001",
        "--pattern",
    ),
    "packed.zip": (lambda p: _zip(p, ["a/felt.btf"]), "felt.btf", "unpack"),
    "maps.zip": (lambda p: _zip(p, ["R_Color.png", "R_NormalGL.png"]), "maps of one material", "synth"),
    "text.zip": (lambda p: _zip(p, ["readme.txt"]), "without a picture.*readme.txt", "ubo"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_what_a_file_is_and_what_to_do(name, tmp_path, capsys):
    make, what, cure = FOREIGN[name]
    path = make(tmp_path / name)
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "foreign"
    with pytest.raises(InputError, match=rf"not a BTF of a known format: .*{what}.*{cure}") as error:
        open_source(path)
    assert "\n" not in str(error.value)
    assert facts["what"] in str(error.value)
    assert facts["instead"] in str(error.value)
    assert main(["import", str(path), "-o", str(tmp_path / "out.btf.zarr")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_file_that_nobody_knows_is_no_foreign_format(tmp_path, capsys):
    path = _bytes(tmp_path / "x.bin", bytes(100))
    assert main(["info", str(path)]) == 2
    with pytest.raises(InputError, match="not a BTF of a known format"):
        open_source(path)
    folder = tmp_path / "folder"
    folder.mkdir()
    assert main(["info", str(folder)]) == 2
    capsys.readouterr()
    _bytes(folder / "IMG_1.jpg", b"x")
    assert main(["info", str(folder)]) == 2
    assert "--pattern" in capsys.readouterr().err
    (folder / "IMG_1.jpg").rename(folder / "Rock_Color.jpg")
    assert main(["info", str(folder)]) == 0
    assert "btfref synth FOLDER" in capsys.readouterr().out


# --- pictures under other names


def _folder(path, name, values):
    for v, view in enumerate(ANGLES):
        for k, light in enumerate(ANGLES):
            target = path / name(light, view)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(material.picture(values[v, k]))
    return path


def _ubo(light, view):
    return "tl{:03.0f} pl{:03.0f} tv{:03.0f} pv{:03.0f}.png".format(*light, *view)


@pytest.fixture(scope="module")
def values():
    return material.pictures(largest=1)


@pytest.fixture(scope="module")
def plain(tmp_path_factory, values):
    folder = tmp_path_factory.mktemp("plain")
    import_btf(_folder(folder / "ubo", _ubo, values), folder / "out.btf.zarr")
    return SampledBTF.load(folder / "out.btf.zarr")


def test_names_with_the_camera_first_are_photographs_unless_they_are_openexr(tmp_path, values, plain):
    path = _folder(
        tmp_path / "a",
        lambda light, view: "img_tv{2:g}_pv{3:g}_tl{0:g}_pl{1:g}.png".format(*light, *view),
        values,
    )
    assert identify(path) == "ubo"
    import_btf(path, tmp_path / "out.btf.zarr")
    assert np.array_equal(SampledBTF.load(tmp_path / "out.btf.zarr").values, plain.values)


def test_a_pattern_says_where_the_angles_stand(tmp_path, values, plain, capsys):
    path = _folder(
        tmp_path / "a",
        lambda light, view: "x/cam_{2:g}_{3:g}/light_{0:.1f}_{1:g}.png".format(*light, *view),
        values,
    )
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(path / "overview.png")
    out = tmp_path / "out.btf.zarr"
    arguments = ["import", str(path), "-o", str(out), "--pattern", "cam_{tv}_{pv}/light_{tl}_{pl}.*"]
    assert main(arguments) == 0
    found = SampledBTF.load(out)
    assert np.array_equal(found.values, plain.values)
    assert found.attributes["parameters"]["pattern"] == arguments[-1]
    assert (
        main([*arguments[:2], "-o", str(tmp_path / "no.btf.zarr"), "--pattern", "c_{tv}_{pv}_{tl}_{pl}.png"])
        == 2
    )
    assert (
        "no image whose name is of the pattern; field 'pattern'; got overview.png" in capsys.readouterr().err
    )


def test_patterns():
    found = angles_by("cam_{tv}_{pv}_light_{tl}_{pl}.jpg")
    assert found("a/b/cam_30_-90_light_7.5_360.jpg") == (7.5, 0, 30, 270)
    assert found("cam_30_-90_light_7.5_360.png") is None
    assert found("xcam_30_-90_light_7.5_360.jpg") is None
    assert angles_by("*_{tl}-{pl}.{tv}+{pv}*")("k_1-2.3+4.png") == (1, 2, 3, 4)


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("{tv}_{pv}_{tl}_{phi}.jpg", r"unknown field of a pattern.*\{phi\}.*\{pl\} \(light\)"),
        ("{tv}_{pv}_{tl}.jpg", "each once"),
        ("{tv}_{pv}_{tl}_{pl}_{tv}.jpg", "each once"),
        ("{tv:03d}_{pv}_{tl}_{pl}.jpg", r"unknown field.*\{tv:03d\}"),
        ("{tv}_{pv}_{tl}_{}.jpg", "unknown field"),
        ("{tv}_{pv}_{tl}_{pl.jpg", "pattern of names"),
    ],
)
def test_a_bad_pattern_is_one_line(pattern, message):
    with pytest.raises(InputError, match=message) as error:
        angles_by(pattern)
    assert "\n" not in str(error.value)


def test_what_macos_and_file_managers_leave_is_passed_over(tmp_path, values, plain):
    folder = _folder(tmp_path / "a", _ubo, values)
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as target:
        for entry in sorted(folder.iterdir()):
            target.write(entry, f"set/{entry.name}")
            target.writestr(f"__MACOSX/set/._{entry.name}", b"\0\5\x16\7")
            target.writestr(f"set/._{entry.name}", b"\0\5\x16\7")
        target.writestr("set/.DS_Store", b"x")
    import_btf(path, tmp_path / "out.btf.zarr")
    assert np.array_equal(SampledBTF.load(tmp_path / "out.btf.zarr").values, plain.values)
    (folder / f".{_ubo(ANGLES[0], ANGLES[0])}").write_bytes(b"x")
    import_btf(folder, tmp_path / "other.btf.zarr")
    # The archive is still looked at as a whole.
    with zipfile.ZipFile(path, "a") as target:
        target.writestr("../__MACOSX/x.png", io.BytesIO().getvalue())
    with pytest.raises(InputError, match="leaves the archive"):
        open_source(path)
