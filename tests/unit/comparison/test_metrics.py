"""Metrics against closed forms and against their libraries."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from btfref.comparison import colour, compare, metrics
from btfref.comparison.comparison import agreement
from btfref.comparison.flip import aces, exposure_range, flip_map, ldr_flip_map
from btfref.conventions import LUMINANCE
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.images import display as display_of
from btfref.numerics import colour as colours


def exact(expected):
    return pytest.approx(
        expected, rel=tolerance("metric.closed_form.rtol"), abs=tolerance("metric.closed_form.atol")
    )


def close(expected):
    return pytest.approx(expected, rel=tolerance("metric.library.rtol"), abs=tolerance("metric.library.atol"))


@pytest.fixture
def pictures(rng):
    """A test and a reference with structure, in [0, 1]."""
    y, x = np.mgrid[0:40, 0:48] / 7.0
    reference = np.clip(0.5 + 0.4 * np.sin(x)[..., None] * np.cos(y[..., None] * [1.0, 1.3, 0.7]), 0, 1)
    return np.clip(reference + 0.05 * rng.standard_normal(reference.shape), 0, 1), reference


def test_errors_of_a_constant_offset():
    r = np.full((4, 5, 3), 0.25)
    t = r + 0.5
    assert metrics.bias(t, r) == exact(0.5)
    assert metrics.mae(t, r) == exact(0.5)
    assert metrics.rmse(t, r) == exact(0.5)
    assert metrics.nrmse(t, r) == exact(2.0)
    assert metrics.relative_l2(t, r) == exact(2.0)
    assert metrics.bias_fraction(r, t) == exact(2 / 3)
    assert metrics.relmse(t, r, epsilon=0.01) == exact(0.25 / 0.0725)
    assert metrics.smape(t, r, epsilon=0.0) == exact(1.0)
    assert metrics.psnr(t, r, peak=5.0) == exact(20.0)


def test_errors_of_two_values():
    t, r = np.array([1.0, 3.0]), np.array([2.0, 0.0])
    assert metrics.bias(t, r) == exact(1.0)
    assert metrics.mae(t, r) == exact(2.0)
    assert metrics.rmse(t, r) == exact(np.sqrt(5.0))
    assert metrics.relative_l2(t, r) == exact(np.sqrt(2.5))
    assert metrics.relmse(t, r, epsilon=1.0) == exact((1 / 5 + 9 / 1) / 2)
    assert metrics.smape(t, r, epsilon=1.0) == exact((2 / 4 + 6 / 4) / 2)


def test_equal_pictures():
    r = np.zeros((3, 3, 3))
    assert metrics.psnr(r, r, peak=1.0) == np.inf
    assert metrics.nrmse(r, r) == metrics.relative_l2(r, r) == 0
    assert metrics.nrmse(r + 1, r) == metrics.relative_l2(r + 1, r) == np.inf


def test_errors_accumulate_in_float64(rng):
    r = np.full(2_000_000, 1e4, np.float32)
    assert metrics.bias(r + np.float32(0.5), r) == exact(0.5)


def test_metrics_equal_scikit_image(pictures):
    from skimage import metrics as library

    t, r = pictures
    assert metrics.rmse(t, r) ** 2 == close(library.mean_squared_error(r, t))
    assert metrics.psnr(t, r, peak=0.8) == close(library.peak_signal_noise_ratio(r, t, data_range=0.8))
    _, expected = library.structural_similarity(
        r,
        t,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    np.testing.assert_allclose(
        metrics.ssim_map(t, r),
        expected,
        rtol=tolerance("metric.library.rtol"),
        atol=tolerance("metric.library.atol"),
    )


def test_ssim_of_constants():
    t, r, c1 = 0.6, 0.2, 1e-4
    expected = (2 * t * r + c1) / (t * t + r * r + c1)
    found = metrics.ssim_map(np.full((16, 16, 1), t), np.full((16, 16, 1), r))
    np.testing.assert_allclose(found, expected, rtol=tolerance("metric.library.rtol"))


def test_ssim_of_a_picture_smaller_than_the_window():
    assert metrics.ssim_map(np.full((2, 3, 3), 0.5), np.full((2, 3, 3), 0.5)).min() == exact(1.0)


def test_relative_error_has_a_floor():
    t, r = (np.array(x)[:, None] for x in ([1.1, 0.01, 0.0, 5e-4], [1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(
        metrics.relative_error(t, r, floor=1e-2),
        [0.1, 1.0, 0.0, 0.05],
        rtol=tolerance("metric.closed_form.rtol"),
    )
    assert metrics.relative_error(np.ones(1), np.zeros(1)) == np.inf
    assert metrics.relative_error(np.zeros(1), np.zeros(1)) == 0


def test_relative_error_is_of_the_colour():
    """A channel that passes through zero beside a highlight counts as a share of the colour, in every gate alike."""
    reference = np.array([[2.0, 1.0, 0.0], [0.0, 0.0, 0.5], [1.0, 1.0, 1.0]])
    test = reference + np.array([[0, 0, 1e-4], [0, -5e-5, 0], [0, 0, 1e-4]])
    expected = np.array([5e-5, 1e-4, 1e-4])
    rtol = tolerance("metric.library.rtol")
    np.testing.assert_allclose(metrics.relative_error(test, reference), expected, rtol=rtol)
    largest = expected.max()
    assert agreement(test, reference).metrics["all"]["max"] == pytest.approx(largest, rel=rtol)
    picture = [image.reshape(1, 3, 3) for image in (test, reference)]
    found = compare(*picture, flip=False)
    assert found.metrics["all"]["rel_max"] == pytest.approx(largest, rel=rtol)


def test_percentiles_are_entries():
    found = metrics.percentiles(np.arange(1, 1001)[::-1])
    assert found == {"p50": 500.0, "p99": 990.0, "p999": 999.0, "max": 1000.0}
    assert metrics.percentiles([3.0]) == {"p50": 3.0, "p99": 3.0, "p999": 3.0, "max": 3.0}


@given(hnp.arrays(np.float64, st.integers(1, 300), elements=st.floats(0, 1e6)))
@settings(deadline=None, derandomize=True, max_examples=50)
def test_percentiles_are_ordered_and_bound_their_share(error):
    found = metrics.percentiles(error)
    assert found["p50"] <= found["p99"] <= found["p999"] <= found["max"] == error.max()
    for name, share in metrics.PERCENTILES.items():
        assert np.count_nonzero(error <= found[name]) >= error.size * Fraction(str(share)) / 100


@pytest.mark.parametrize("shape", [(3, 3, 3), (4, 3), (0,)])
def test_shapes_must_agree_and_hold_something(shape):
    other = (4, 3, 3) if shape != (0,) else shape
    with pytest.raises(InputError, match="shape"):
        metrics.rmse(np.zeros(shape), np.zeros(other))


def test_psnr_wants_a_peak():
    with pytest.raises(InputError, match="peak"):
        metrics.psnr(np.ones(3), np.ones(3), peak=0.0)


# --- colour ----------------------------------------------------------------------------------------------


def test_ciede2000_equals_the_published_pairs(reference_file):
    pairs = np.loadtxt(reference_file("ciede2000_sharma2005.csv"), delimiter=",")
    assert pairs.shape == (34, 7)
    limit = tolerance("metric.sharma.max")
    assert np.abs(colour.ciede2000(pairs[:, :3], pairs[:, 3:6]) - pairs[:, 6]).max() <= limit
    assert np.abs(colour.ciede2000(pairs[:, 3:6], pairs[:, :3]) - pairs[:, 6]).max() <= limit


def test_ciede2000_equals_scikit_image(rng):
    from skimage.color import deltaE_ciede2000

    a, b = (rng.uniform([0, -100, -100], [100, 100, 100], (20000, 3)) for _ in range(2))
    a[:50, 1:] = 0  # greys: no hue
    np.testing.assert_allclose(
        colour.ciede2000(a, b),
        deltaE_ciede2000(a, b),
        rtol=tolerance("metric.library.rtol"),
        atol=tolerance("metric.library.atol"),
    )


def test_lab_equals_scikit_image_and_knows_white(rng):
    from skimage.color import xyz2lab
    from skimage.color.colorconv import xyz_from_rgb

    rgb = rng.random((5000, 3))
    expected = xyz2lab(rgb @ xyz_from_rgb.T, illuminant="D65", observer="2")
    assert np.abs(colour.lab(rgb) - expected).max() <= tolerance("metric.lab.max")
    np.testing.assert_allclose(colour.lab(np.ones(3)), [100, 0, 0], atol=tolerance("metric.library.atol"))
    np.testing.assert_allclose(colour.lab(np.zeros(3)), [0, 0, 0], atol=tolerance("metric.closed_form.atol"))


def test_luminance_is_the_middle_row_of_the_primaries():
    np.testing.assert_allclose(colours.RGB_TO_XYZ[1], LUMINANCE, atol=tolerance("metric.luminance.atol"))


@given(st.floats(0, 1))
@settings(deadline=None, derandomize=True)
def test_srgb_round_trip(x):
    assert colours.decode_srgb(colours.encode_srgb(x)) == close(x)


def test_srgb_known_values():
    assert float(colours.encode_srgb(0.214041140482)) == close(0.5)
    assert float(colours.encode_srgb(1.0)) == exact(1.0)


def test_display_is_chosen_from_lit_pixels_of_the_reference():
    picture = np.zeros((100, 100, 3))
    picture[:10] = 0.225
    display = display_of.fit_display(picture)
    assert display.stops == 2.0
    np.testing.assert_allclose(display.linear(picture).max(), 0.9, rtol=tolerance("metric.closed_form.rtol"))
    assert display_of.fit_display(np.zeros((2, 2, 3))).stops == 0.0
    assert np.isfinite(display.encoded(np.array([np.nan, np.inf, -1.0]))).all()


def test_delta_e_of_equal_pictures_is_zero_and_grows_with_the_error(pictures):
    t, r = pictures
    display = display_of.Display()
    assert colour.delta_e00(r, r, display).max() == 0
    near = colour.delta_e00(0.5 * (t + r), r, display).mean()
    assert 0 < near < colour.delta_e00(t, r, display).mean()


# --- FLIP ------------------------------------------------------------------------------------------------


def test_hdr_flip_is_the_largest_ldr_flip_over_the_exposures(rng):
    r = 3 * rng.random((48, 56, 3))
    t = r * rng.uniform(0.7, 1.3, r.shape)
    found, used = flip_map(t, r, start=-3.0, stop=1.0, exposures=5)
    expected = np.max(
        [ldr_flip_map(aces(t * 2.0**c), aces(r * 2.0**c)) for c in np.linspace(-3.0, 1.0, 5)], axis=0
    )
    np.testing.assert_allclose(found, expected, atol=tolerance("metric.flip.atol"))
    assert used["startExposure"] == -3.0
    assert used["numExposures"] == 5
    assert used["tonemapper"] == "aces"


def test_exposures_are_those_of_the_library_for_a_picture_without_background(rng):
    from flip_evaluator import evaluate

    r = (0.1 + rng.random((64, 64, 3)) * 4).astype(np.float32)
    _, _, used = evaluate(r, r, "HDR", applyMagma=False, computeMeanError=False, parameters={})
    start, stop, exposures = exposure_range(r)
    step = tolerance("metric.flip_exposure.stops")
    assert abs(start - used["startExposure"]) <= step
    assert abs(stop - used["stopExposure"]) <= step
    assert exposures == used["numExposures"]
    framed = np.zeros((256, 256, 3))
    framed[96:160, 96:160] = r
    assert exposure_range(framed) == (start, stop, exposures)


def test_flip_of_equal_pictures_is_zero_and_of_opposites_large():
    white = np.ones((32, 32, 3))
    assert ldr_flip_map(white, white).max() == 0
    assert ldr_flip_map(0 * white, white).mean() > tolerance("metric.flip_opposites.min_mean")
    assert flip_map(white, white)[0].max() == 0


@pytest.mark.parametrize(
    "change",
    [
        {"tonemapper": "filmic"},
        {"pixels_per_degree": 0.0},
        {"pixels_per_degree": np.nan},
        {"start": 2.0, "stop": 1.0},
        {"exposures": 1},
        {"start": np.inf},
    ],
)
def test_flip_refuses_what_would_end_the_process(change):
    with pytest.raises(InputError):
        flip_map(np.ones((4, 4, 3)), np.ones((4, 4, 3)), **change)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_flip_refuses_values_that_are_not_finite(value):
    picture = np.ones((4, 4, 3))
    picture[1, 2, 0] = value
    with pytest.raises(InputError, match="finite"):
        flip_map(picture, np.ones((4, 4, 3)))
    with pytest.raises(InputError):
        ldr_flip_map(picture, np.ones((4, 4, 3)))
