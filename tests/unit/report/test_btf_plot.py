"""Pictures of sampled BTFs: every panel is there, also of a store that is not complete."""

import numpy as np
import pytest
from PIL import Image

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.report.btf_plot import _image, _spread, hemisphere, plot_btf
from btfref.sampling.store.store import create_store

VIEWS, LIGHTS = directions("3x4"), directions("ubo81")


@pytest.fixture
def store(tmp_path):
    """A Lambertian tile, half of it twice as bright."""
    store = create_store(tmp_path / "a.btf.zarr", views=VIEWS, lights=LIGHTS, texels=(6, 10), tile=4)
    values = np.broadcast_to(LIGHTS.vectors[:, 2, None, None, None] * 0.4 / np.pi, (81, 6, 10, 3)).copy()
    values[:, :, 5:] *= 2
    for view in range(len(VIEWS)):
        if view != 4:
            store.write_view(view, values, 1e-4 * values)
    return store


def test_a_plot_is_written_and_shows_the_albedo(tmp_path, store, capsys):
    out = tmp_path / "a.png"
    assert main(["info", str(store.path), "--plot", str(out), "--texel", "1,2"]) == 0
    assert "sampled-btf" in capsys.readouterr().out
    image = np.asarray(Image.open(out).convert("RGB"), np.int64)
    assert image.shape[0] > 1000
    # The two halves of the albedo map, sRGB of 0.4 and 0.8, each in an area of many pixels.
    for grey in (170, 231):
        assert (np.abs(image - grey).max(-1) <= 1).sum() > 5000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.btf.zarr", "a.png"]


def test_what_is_not_there_is_not_shown(store):
    assert np.isnan(_image(store, 4, 0)).all()
    assert np.isfinite(_image(store, 3, 0)).all()


def test_directions_of_the_sheet_are_different_and_spread():
    chosen = _spread(LIGHTS, 7)
    assert len(set(chosen)) == 7
    assert chosen[0] == 0
    assert np.degrees(LIGHTS.theta[chosen]).max() == pytest.approx(75)


def test_the_hemisphere_has_its_directions_where_they_are():
    """Azimuth 90° is up, the pole in the middle: x of the map is x of the direction."""
    image = hemisphere(LIGHTS, np.exp(2 * LIGHTS.vectors[:, 1]))
    row, column = np.unravel_index(np.nanargmax(image), image.shape)
    assert row > tolerance("report.hemisphere.min_row") * len(image)
    assert abs(column / len(image) - 0.5) < tolerance("report.hemisphere.column")
    assert np.isnan(image[0, 0])


def test_bad_plots_are_one_clear_line(tmp_path, store, capsys):
    with pytest.raises(InputError, match="no such texel"):
        plot_btf(store.path, tmp_path / "a.png", texel=(6, 0))
    empty = create_store(tmp_path / "b.btf.zarr", views=VIEWS, lights=LIGHTS, texels=(2, 2))
    with pytest.raises(InputError, match="nothing is there"):
        plot_btf(empty.path, tmp_path / "a.png")
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "c.png")
    assert main(["info", str(tmp_path / "c.png"), "--plot", str(tmp_path / "a.png")]) == 2
    assert main(["info", str(store.path), "--texel", "1,1"]) == 2
    assert "only sampled BTFs" in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()
