"""Pictures in files."""

import numpy as np
import pytest

from btfref.comparison import Display
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.images import load_image, save_image


@pytest.fixture
def picture(rng):
    return (rng.random((9, 14, 3)) * [4, 1, 0.1]).astype(np.float32)


def test_exr_round_trip_is_exact(tmp_path, picture):
    picture[0, 0] = [np.nan, np.inf, -1]
    save_image(tmp_path / "a.exr", picture, attributes={"comments": "a test"})
    np.testing.assert_array_equal(load_image(tmp_path / "a.exr"), picture)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    with pytest.raises(InputError, match="not finite"):
        load_image(tmp_path / "a.exr", finite=True)


def test_png_round_trip_is_within_half_a_step(tmp_path, picture):
    display = Display(-2.0)
    save_image(tmp_path / "a.png", picture, display=display)
    error = Display().encoded(load_image(tmp_path / "a.png")) - display.encoded(picture)
    assert np.abs(error).max() <= tolerance("metric.display_step.max")


def test_png_reads_other_modes(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((2, 3, 4), [255, 0, 0, 128], np.uint8), "RGBA").save(tmp_path / "rgba.png")
    assert load_image(tmp_path / "rgba.png")[0, 0].tolist() == [1, 0, 0]
    Image.fromarray(np.full((2, 3), 65535, np.uint16)).save(tmp_path / "deep.png")
    assert load_image(tmp_path / "deep.png").tolist() == np.ones((2, 3, 3)).tolist()


def test_exr_with_half_grey_and_windows(tmp_path):
    import OpenEXR

    grey = np.arange(6, dtype=np.float16).reshape(2, 3)
    header = {
        "dataWindow": (np.array([1, 2], np.int32), np.array([3, 3], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([3, 4], np.int32)),
    }
    OpenEXR.File(header, {"Y": grey}).write(str(tmp_path / "grey.exr"))
    image = load_image(tmp_path / "grey.exr")
    assert image.shape == (5, 4, 3)
    np.testing.assert_array_equal(image[2:4, 1:4, 1], grey)
    assert np.count_nonzero(image) == 15
    OpenEXR.File({}, {"depth": grey}).write(str(tmp_path / "depth.exr"))
    with pytest.raises(InputError, match="depth"):
        load_image(tmp_path / "depth.exr")


@pytest.mark.parametrize("ending", [".exr", ".png"])
@pytest.mark.parametrize("damage", ["missing", "empty", "foreign", "truncated"])
def test_unreadable_pictures_are_one_clear_line(tmp_path, picture, ending, damage):
    path = tmp_path / f"broken{ending}"
    save_image(path, picture)
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(
            {"empty": b"", "foreign": b"GIF89a not this", "truncated": data[: len(data) // 2]}[damage]
        )
    with pytest.raises(InputError, match="broken") as error:
        load_image(path)
    assert "\n" not in str(error.value)


def test_nothing_is_written_for_bad_input(tmp_path, picture):
    for path, image in (
        (tmp_path / "a.gif", picture),
        (tmp_path / "a.exr", picture[..., 0]),
        (tmp_path / "none" / "a.exr", picture),
        (tmp_path / "a.png", picture[:0]),
    ):
        with pytest.raises(InputError):
            save_image(path, image)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="kind"):
        load_image(tmp_path / "a.gif")


def test_a_failing_write_leaves_the_old_file(tmp_path, picture, monkeypatch):
    path = tmp_path / "a.png"
    save_image(path, picture)
    before = path.read_bytes()

    def fail(pixels):
        raise MemoryError

    monkeypatch.setattr("btfref.images.png.encode_png", fail)
    with pytest.raises(MemoryError):
        save_image(path, picture * 2)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.png"]
