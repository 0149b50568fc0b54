"""The shared estimator against plain Mitsuba renders and against the path estimator; partial synthesis."""

import numpy as np
import pytest
from honest import assert_variances_are_honest
from plain_renders import PlainRenders

from btfref.comparison.significance import welch_test
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.numerics.sphere.directions import directions
from btfref.sampling import SampledBTF, open_store
from btfref.sampling.store.selection import Selection
from btfref.sampling.synthesis import synthesize, synthesize_store

pytestmark = pytest.mark.usefixtures("llvm")

#: Indices into ubo81: polar angles 0, 30, 60, 75 degrees.
CHOSEN = [0, 12, 40, 62]
SMALL = {"texels": 8, "views": "2x3", "lights": "2x4", "spp": 8, "estimator": "surface"}


@pytest.mark.parametrize("name", ["checker", "tissue"])
def test_image_means_equal_plain_renders(llvm, name):
    """Two materials: one whose diffuse lobe separates, one that keeps it to itself."""
    settings = {"resolution": 32, "raised_roughness": 0.3} if name == "checker" else {}
    tile = build(name, **settings)
    vectors = directions("ubo81").vectors[CHOSEN]
    runs = np.stack(
        [
            synthesize(
                tile, texels=16, views=vectors, lights=vectors, spp=64, seed=seed, dtype="float32",
                max_depth=4, estimator="surface",
            ).values.mean((2, 3, 4))
            for seed in range(6)
        ]
    )  # fmt: skip
    mean, error = runs.mean(0), runs.std(0, ddof=1) / np.sqrt(len(runs))
    plain = PlainRenders(llvm, tile, texels=16, reach=3, max_depth=4)
    pairs = [(0, 1), (1, 3), (2, 2), (3, 0), (3, 3), (2, 1)]
    bias, noise = [], []
    for v, k in pairs:
        image, variance = plain.pair(vectors[v], vectors[k], spp=128, rounds=8, seed=7 * v + k)
        # Channels of a path go together; texels do not.
        spread = np.sqrt(3 * variance.sum()) / image.size
        bias.append(mean[v, k] / image.mean() - 1)
        noise.append(np.hypot(error[v, k], spread) / image.mean())
    assert np.max(np.abs(bias) - 3 * np.array(noise)) <= tolerance("synthesis.surface.bias")
    # The noise does not hide what is asked for.
    assert np.mean(noise) <= tolerance("synthesis.surface.bias")


@pytest.mark.parametrize("depth", [2, 4])
def test_texels_equal_those_of_the_path_estimator(depth):
    settings = {"texels": 8, "views": "2x3", "lights": "2x4", "dtype": "float32", "max_depth": depth}
    tile = build("checker", resolution=32, raised_roughness=0.3)
    path = synthesize(tile, spp=1024, seed=1, estimator="path", **settings)
    surface = synthesize(tile, spp=64, seed=2, estimator="surface", **settings)
    z = (surface.values - path.values) / np.sqrt(surface.variance + path.variance + 1e-12)
    p = welch_test(surface.values, surface.variance, path.values, path.variance)[1]
    assert np.median(np.abs(z)) <= tolerance("synthesis.surface.median_z")
    level = 0.01
    assert np.mean(p < level) <= tolerance("synthesis.surface.share_below_1_percent")
    # It can fail: one light on.
    p = welch_test(np.roll(surface.values, 1, 1), surface.variance, path.values, path.variance)[1]
    assert np.mean(p < level) > 5 * tolerance("synthesis.surface.share_below_1_percent")


def test_variance_is_honest():
    tile = build("checker", resolution=32, raised_roughness=0.3)
    settings = {"texels": 16, "views": "2x4", "lights": "2x4", "spp": 16, "dtype": "float32"}
    first, second = (synthesize(tile, seed=seed, estimator="surface", **settings) for seed in (1, 2))
    assert_variances_are_honest(first, second)


@pytest.mark.parametrize("bsdf", [None, {"type": "roughconductor", "alpha": 0.3, "material": "Au"}])
def test_flat_tiles_equal_their_eval(bsdf):
    settings = {"texels": 2, "views": "3x4", "lights": "3x5", "dtype": "float32", "bsdf": bsdf}
    path = synthesize("flat", spp=2, estimator="path", **settings)
    surface = synthesize("flat", spp=16, estimator="surface", **settings)
    error = np.abs(surface.values - path.values).max() / path.values.max()
    assert error <= tolerance("synthesis.flat_eval")


def test_holes_are_black():
    """Seen through the holes of a cloth without a backing: nothing; the covered share must come out."""
    settings = {
        "texels": 16, "views": "2x3", "lights": "2x3", "max_depth": 2, "dtype": "float32",
        "backing_colour": None,
    }  # fmt: skip
    path = synthesize("tissue", spp=256, estimator="path", **settings)
    surface = synthesize("tissue", spp=64, estimator="surface", **settings)
    assert abs(surface.values.mean() / path.values.mean() - 1) <= tolerance("synthesis.surface.holes")


def test_same_seed_same_bytes_and_parts_of_the_whole():
    whole = synthesize("checker", seed=9, resolution=16, **SMALL)
    again = synthesize("checker", seed=9, resolution=16, **SMALL)
    assert np.array_equal(again.values, whole.values)
    assert np.array_equal(again.variance, whole.variance)
    assert not np.array_equal(synthesize("checker", seed=10, resolution=16, **SMALL).values, whole.values)


@pytest.mark.parametrize("estimator", ["path", "surface"])
def test_parts_add_up_to_the_same_store(tmp_path, estimator):
    settings = SMALL | {"estimator": estimator, "seed": 3, "resolution": 16}
    whole = synthesize("checker", out=tmp_path / "whole.btf.zarr", **settings)
    out = tmp_path / "parts.btf.zarr"
    store = synthesize_store(out, "checker", only=Selection(views=(1, 4)), **settings)
    assert store.coverage.any(axis=(1, 2, 3)).tolist() == [False, True, False, False, True, False]
    assert store.info()["coverage_of"] == {"views": 2, "lights": 8, "pairs": "16 of 48", "tiles": "1 of 1"}
    store = synthesize_store(out, "checker", only=Selection(lights=(0, 5)), **settings)
    assert store.coverage.mean() == pytest.approx((2 * 8 + 4 * 2) / 48)
    with pytest.raises(InputError, match="incomplete"):
        SampledBTF.load(out)
    part = SampledBTF.load(out, views=[0], lights=[5], partial=True)
    assert np.array_equal(part.values[0, 0], whole.values[0, 5])
    store = synthesize_store(out, "checker", **settings)
    assert store.complete
    filled = SampledBTF.load(out)
    assert np.array_equal(filled.values, whole.values)
    assert np.array_equal(filled.variance, whole.variance)
    with pytest.raises(InputError, match="part of a BTF"):
        synthesize_store(out, "checker", only=Selection(lights=(8,)), **settings)


@pytest.mark.parametrize("estimator", ["path", "surface"])
def test_tiles_are_filled_alone(tmp_path, estimator):
    settings = {"texels": 80, "views": "1x3", "lights": "1x3", "spp": 2, "max_depth": 3, "seed": 5}
    settings |= {"estimator": estimator, "resolution": 16}
    whole = synthesize("checker", **settings)
    out = tmp_path / "tiles.btf.zarr"
    store = synthesize_store(out, "checker", only=Selection(tiles=(1, 2)), **settings)
    assert store.coverage[0, 0].tolist() == [[False, True], [True, False]]
    part = SampledBTF.load(out, rows=range(40), columns=range(40, 80), partial=True)
    assert np.array_equal(part.values, whole.values[:, :, :40, 40:])
    assert np.array_equal(part.variance, whole.variance[:, :, :40, 40:])
    assert open_store(out).coverage.mean() == 0.5


@pytest.mark.parametrize(
    ("bsdf", "word"),
    [
        ({"type": "dielectric"}, "transmission"),
        ({"type": "roughdielectric", "alpha": 0.3}, "transmission"),
        ({"type": "conductor"}, "mirror"),
        ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}, "mask"),
    ],
)
def test_paths_take_over_where_points_cannot(bsdf, word):
    settings = SMALL | {"texels": 2, "bsdf": bsdf}
    made = synthesize("flat", **settings)
    assert made.attributes["estimator"] == "path"
    assert synthesize("flat", **settings | {"estimator": "auto"}).attributes == made.attributes
    assert (
        synthesize("flat", **SMALL | {"texels": 2, "estimator": "auto"}).attributes["estimator"] == "surface"
    )
    assert word in made.attributes["fallback"]
    assert np.array_equal(made.values, synthesize("flat", **settings | {"estimator": "path"}).values)
    assert "fallback" not in synthesize("flat", **SMALL | {"texels": 2}).attributes


@pytest.mark.parametrize("estimator", ["path", "surface"])
def test_variances_may_be_left_out(tmp_path, estimator):
    settings = SMALL | {"estimator": estimator, "seed": 4, "resolution": 16, "dtype": "float32"}
    both = synthesize("checker", **settings)
    alone = synthesize("checker", variance=False, **settings)
    assert alone.variance is None
    # Another kernel may round the same sums differently.
    assert np.abs(alone.values - both.values).max() <= tolerance("synthesis.rounding") * both.values.max()
    stored = synthesize("checker", variance=False, out=tmp_path / "values.btf.zarr", **settings)
    assert stored.variance is None
    assert np.array_equal(stored.values, alone.values)
    with pytest.raises(InputError, match="variances"):
        synthesize("checker", variance=False, target_error=0.1, **settings | {"spp": 16})
