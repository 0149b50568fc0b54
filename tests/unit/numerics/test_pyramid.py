"""Pyramids, the footprint of a pixel, and the Phong model."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics import footprint, pyramid
from btfref.numerics.phong import fit_phong, phong
from btfref.numerics.sphere.directions import directions
from btfref.numerics.ycbcr import FROM_RGB, RGB_METRIC, TO_RGB

ROUNDING = tolerance("pyramid.rounding.max")
SHAPES = [(64, 64), (16, 12), (13, 7), (1, 5), (1, 1)]


@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
@pytest.mark.parametrize("kind", pyramid.REDUCTIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_perfect_reconstruction(shape, kind, filter_type, rng):
    """Every level of the Gaussian pyramid comes back, not only the finest."""
    image = rng.normal(size=(*shape, 2))
    n = len(pyramid.level_shapes(shape))
    levels = pyramid.laplacian_pyramid(image, n, kind, filter_type)
    assert levels[-1].shape[:2] == (1, 1)
    for k, expected in enumerate(pyramid.gaussian_pyramid(image, n, kind)):
        found = pyramid.reconstruct(levels, k, filter_type)
        assert np.abs(found - expected).max() <= tolerance("pyramid.reconstruction.max")


@pytest.mark.parametrize("shape", SHAPES)
def test_the_binomial_reduction_keeps_the_mean_and_the_box_does_not(shape, rng):
    image = rng.normal(size=shape)
    levels = pyramid.gaussian_pyramid(image, len(pyramid.level_shapes(shape)), "binomial")
    assert max(abs(level.mean() - image.mean()) for level in levels) <= tolerance(
        "pyramid.reconstruction.max"
    )
    if shape != (1, 1):
        assert abs(pyramid.reduce_image(image, "box").mean() - image.mean()) >= tolerance(
            "pyramid.box.min_mean"
        )


def test_levels_wrap_around_and_stay_in_place(rng):
    """A shift by two texels is a shift by one of the next level; the binomial kernel mirrors with the image."""
    image = rng.normal(size=(16, 24))
    for kind in pyramid.REDUCTIONS:
        reduced = pyramid.reduce_image(image, kind)
        moved = pyramid.reduce_image(np.roll(image, (2, -4), (0, 1)), kind)
        np.testing.assert_allclose(moved, np.roll(reduced, (1, -2), (0, 1)), atol=ROUNDING)
    mirrored = pyramid.reduce_image(image[::-1, ::-1], "binomial")
    np.testing.assert_allclose(mirrored, pyramid.reduce_image(image, "binomial")[::-1, ::-1], atol=ROUNDING)
    difference = pyramid.reduce_image(image[::-1], "box") - pyramid.reduce_image(image, "box")[::-1]
    assert np.abs(difference).max() >= tolerance("pyramid.box.min_mirrored")


def test_even_sizes_have_the_binomial_kernel():
    row = pyramid.reduction(8, 4, "binomial")[1]
    assert (8 * row).tolist() == [0, 1, 3, 3, 1, 0, 0, 0]


def test_level_weights_are_continuous():
    lod = np.array([-1, 0, 0.25, 1, 1.75, 3, 9, np.nan])
    expected = [
        [1, 1, 0.75, 0, 0, 0, 0, 1],
        [1, 1, 1, 1, 0.25, 0, 0, 1],
        [1, 1, 1, 1, 1, 0, 0, 1],
        [1, 1, 1, 1, 1, 1, 1, 1],
    ]
    np.testing.assert_allclose(pyramid.level_weights(lod, 4), expected)


def test_bad_pyramids():
    for n in (0, 6):
        with pytest.raises(InputError, match="1 to 5"):
            pyramid.level_shapes((16, 12), n)
    with pytest.raises(InputError, match="reduction"):
        pyramid.reduction(8, 4, "gauss")
    with pytest.raises(InputError, match="filter"):
        pyramid.expansion(8, 4, "cubic")


def test_colours_come_back(rng):
    rgb = rng.normal(size=(50, 3))
    ycc = rgb @ FROM_RGB.T
    np.testing.assert_allclose(ycc @ TO_RGB.T, rgb, atol=ROUNDING)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", ycc, RGB_METRIC, ycc), (rgb**2).sum(1))
    # BT.709-6, item 3.3: white has no colour, blue and red reach one half.
    np.testing.assert_allclose(FROM_RGB @ [1, 1, 1], [1, 0, 0], atol=np.finfo(float).eps)
    np.testing.assert_allclose([FROM_RGB[1] @ [0, 0, 1], FROM_RGB[2] @ [1, 0, 0]], 0.5)


def test_a_head_on_pixel_has_one_lookup_and_a_slanted_one_several():
    """A disk of 4 texels; seen at 60° it is 8 texels long, so two lookups' worth at the level of 4."""
    u, v, n = [16, 0, 0], [0, 16, 0], [0, 0, 1]
    lod, _, ratio = footprint.cone_footprint(u, v, n, n, 0.25)
    assert lod == pytest.approx(0.5 * np.log2(1 + 16 / 5))
    assert ratio == pytest.approx(1)
    slanted = [np.sin(np.pi / 3), 0, 0.5]
    lod, step, ratio = footprint.cone_footprint(u, v, slanted, n, 0.25)
    assert lod == pytest.approx(0.5 * np.log2(1 + 16 / 5))
    assert ratio == pytest.approx(2)
    np.testing.assert_allclose(np.abs(step), [4, 0], atol=ROUNDING)
    # Beyond the largest ratio the level gives way.
    grazing = [np.sqrt(1 - 1e-4), 0, 1e-2]
    lod, step, ratio = footprint.cone_footprint(u, v, grazing, n, 0.25)
    assert ratio == footprint.ANISOTROPY
    assert np.hypot(*step) == pytest.approx(400 / footprint.ANISOTROPY)
    assert lod == pytest.approx(0.5 * np.log2(1 + (400 / footprint.ANISOTROPY) ** 2 / 5))


def test_probe_weights_sum_to_one_and_keep_the_length():
    ratio = np.linspace(1, footprint.ANISOTROPY, 200)
    j = np.arange(-5, 6)[:, None]
    weight = footprint.probe_weight(j, ratio)
    np.testing.assert_allclose(weight.sum(0), 1)
    assert np.abs(np.diff(weight, axis=1)).max() <= tolerance("footprint.weight.step")
    assert (weight[[0, 1, -2, -1]] == 0).all()


def test_levels_blur_as_much_as_their_pixel(rng):
    """The variance that λ stands for, measured: an impulse, reduced and looked up at random places."""
    n, k = 256, 3
    width = np.sqrt(5 * (4.0**k - 1))
    moments = []
    for shift in range(2**k):
        image = np.zeros((1, n))
        image[0, n // 2 + shift] = 1
        level = image
        for _ in range(k):
            level = pyramid.reduce_image(np.repeat(level, 2, 0), "binomial")[:1]
        fine = pyramid.expansion(n * 8, level.shape[1], "bilinear") @ level[0]
        x = (np.arange(n * 8) + 0.5) / 8 - (n // 2 + shift + 0.5)
        moments.append((fine @ x**2, fine.sum()))
    variance = np.sum([m for m, _ in moments]) / np.sum([s for _, s in moments])
    assert variance == pytest.approx(1 / 6 + width**2 / 12, rel=tolerance("pyramid.variance.rtol"))


@pytest.mark.parametrize("truth", [(0.05, 0.2, 0.3, 12.0), (0.0, 0.31, 0.0, 1.0), (0.1, 0.1, 2.0, 90.0)])
def test_phong_comes_back(truth, need):
    need("llvm")
    views, lights = directions("ubo81").vectors, directions("ubo81").vectors
    w_view, w_light = np.broadcast_arrays(views[:, None], lights[None])
    table = phong(truth, w_light, w_view)
    found, rms = fit_phong(table, views, lights)
    assert rms <= tolerance("phong.misfit.max") * np.sqrt((table**2).mean())
    if truth[2]:
        np.testing.assert_allclose(
            found, truth, rtol=tolerance("phong.parameters.rtol"), atol=tolerance("phong.parameters.atol")
        )


def test_phong_fits_are_best_fits(need, rng):
    """No nearby parameters are better."""
    need("llvm")
    views = lights = directions("ubo81").vectors
    w_view, w_light = np.broadcast_arrays(views[:, None], lights[None])
    table = phong((0.05, 0.2, 0.3, 20.0), w_light, w_view) + 0.05 * rng.normal(size=(81, 81))
    found, rms = fit_phong(table, views, lights)
    for i in range(4):
        for factor in (0.97, 1.03):
            other = found.astype(float)
            other[i] *= factor
            worse = np.sqrt(((phong(other, w_light, w_view) - table) ** 2).mean())
            assert worse >= rms * (1 - tolerance("phong.optimum.rise"))
