"""Factored BTFs: parabolic maps, half and difference vectors, the factorizations, storage, and bad data."""

import dataclasses

import numpy as np
import pytest
from factored_fits import KEYS, fit
from oracle import oracle_btf

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.solvers import factoring
from btfref.numerics.sphere import halfway, parabolic
from btfref.numerics.sphere.directions import directions
from btfref.registry import methods
from btfref.representations.factored import cmf, hf
from btfref.representations.factored import fit as factored_fit
from btfref.sampling import SampledBTF


def upper(rng, n):
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2]) + 1e-3
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def product_btf(shape=(3, 4), difference=False):
    """Texels whose tables are smooth products of factors, different per texel and channel."""
    views = lights = directions("ubo81")
    rows, columns = shape
    h, d = halfway.half_difference(lights.vectors[None], views.vectors[:, None])
    x = np.linspace(0, 1, rows * columns * 3).reshape(rows, columns, 3)
    p = lights.vectors[:, 2, None, None, None] * (1 + 0.5 * x * lights.vectors[:, 0, None, None, None])
    r = 1 - 0.4 * x * views.vectors[:, 1, None, None, None]
    q = 0.2 + np.exp(-2 * (1 - h[..., 2]))[..., None, None, None] * (1 + x)
    values = r[:, None] * p[None] * q
    if difference:
        values = values * (0.3 + d[..., 2, None, None, None] ** 2)
    return SampledBTF(values.astype(np.float32), views, lights)


# --- parabolic maps and half vectors -------------------------------------------------------------------------------


def test_parabolic_lookup_is_exact_at_texels(rng):
    n = 16
    table = rng.random((n, n))
    inside = np.linalg.norm(parabolic.texel_centres(n), axis=-1) <= 1
    index, weight = parabolic.bilinear_stencil(parabolic.texel_directions(n)[inside], n)
    value = (table.reshape(-1)[index] * weight).sum(-1)
    np.testing.assert_allclose(value, table[inside], atol=tolerance("metric.closed_form.atol"))


def test_parabolic_lookup_is_linear_in_the_square_and_ignores_length(rng):
    n, w = 16, upper(rng, 1000)
    st = parabolic.hemisphere_to_square(w)
    centres = parabolic.texel_centres(n).reshape(-1, 2)
    index, weight = parabolic.bilinear_stencil(w * rng.uniform(0.1, 9, (1000, 1)), n)
    within = np.abs(st).max(1) < 1 - 1 / n
    found = np.einsum("ij,ijk->ik", weight, centres[index])
    np.testing.assert_allclose(found[within], st[within], atol=tolerance("metric.closed_form.atol"))
    np.testing.assert_allclose(weight.sum(1), 1)
    assert (weight >= 0).all()


def test_texel_solid_angles_cover_the_hemisphere():
    angles = parabolic.texel_solid_angles(32)
    np.testing.assert_allclose(angles.sum(), 2 * np.pi)
    cosine = (angles * parabolic.texel_directions(32)[..., 2]).sum()
    assert abs(cosine - np.pi) <= tolerance("factored.solid_angle.relative") * np.pi


def test_half_and_difference_vectors_are_inverted(rng):
    w_light, w_view = upper(rng, 2000), upper(rng, 2000)
    h, d = halfway.half_difference(w_light, w_view)
    assert (h[:, 2] > 0).all()
    assert (d[:, 2] >= 0).all()
    back = halfway.in_out(h, d)
    np.testing.assert_allclose(back[0], w_light, atol=tolerance("metric.library.atol"))
    np.testing.assert_allclose(back[1], w_view, atol=tolerance("metric.library.atol"))


def test_half_frame_is_orthonormal_everywhere(rng):
    h = np.concatenate([upper(rng, 500), [[1, 0, 0], [0, 1, 0], [0, 0, 1.0]]])
    frame = np.stack([*halfway.half_frame(h), h], 1)
    np.testing.assert_allclose(
        frame @ np.swapaxes(frame, 1, 2),
        np.broadcast_to(np.eye(3), frame.shape),
        atol=tolerance("metric.library.atol"),
    )


# --- factorizations ----------------------------------------------------------------------------------------------


def test_one_term_is_the_first_singular_pair(rng):
    data = rng.random((20, 15, 4))
    left, right = factoring.rank_terms(data, None, 1)
    for i in range(4):
        u, s, v = np.linalg.svd(data[..., i])
        best = s[0] * np.outer(u[:, 0], v[0])
        np.testing.assert_allclose(
            np.outer(left[0, :, i], right[0, :, i]), best, rtol=tolerance("factored.svd.rtol")
        )


def test_more_terms_fit_better_and_stay_positive(rng):
    data = np.einsum("kam,kbm->abm", rng.random((3, 20, 5)), rng.random((3, 15, 5)))
    errors = []
    for terms in (1, 2, 3):
        left, right = factoring.rank_terms(data, None, terms)
        assert min(left.min(), right.min()) >= 0
        errors.append(((np.einsum("kam,kbm->abm", left, right) - data) ** 2).sum())
    assert errors[0] > errors[1] > errors[2]


def test_unknown_samples_do_not_matter(rng):
    data = np.einsum("am,bm->abm", 1 + rng.random((20, 5)), 1 + rng.random((15, 5)))
    known = (rng.random((20, 15)) < 0.7).astype(float)
    left, right = factoring.rank_terms(data * known[..., None], known, 1)
    np.testing.assert_allclose(left[0][:, None] * right[0][None], data, rtol=tolerance("factored.svd.rtol"))


def test_sweeps_never_raise_the_error():
    btf = oracle_btf((2, 3))
    resampling = cmf.Resampling(btf.views, btf.lights, 10.0, 16, True)
    data, _ = factored_fit.unit_tables(btf, np.arange(6))
    factors = cmf.chain(data, resampling, 2, 1e-3)
    errors = []
    for _ in range(5):
        errors.append(((resampling.through_maps.product(factors) - data) ** 2).sum(dtype=float))
        factors = factoring.refine([factoring.Samples(data, resampling.through_maps)], factors, 1)
        assert min(f.min() for f in factors.values()) >= 0
    assert (np.diff(errors) < 0).all()


def test_listed_pairs_are_read_as_the_grid_is(rng):
    """All pairs of a grid, as a list: the same products, and the same updates."""
    views, lights = upper(rng, 5), upper(rng, 4)
    grid = factoring.map_operators(views, lights, 8, True)
    listed = factoring.pair_map_operators(np.repeat(views, 4, 0), np.tile(lights, (5, 1)), 8, True)
    factors = {name: rng.random((2, 64, 3)).astype(np.float32) for name in "pqrd"}
    data = rng.random((5, 4, 3)).astype(np.float32)
    expected = factoring.refine([factoring.Samples(data, grid)], factors, 2, 0.75)
    found = factoring.refine([factoring.Samples(data.reshape(20, 3), listed)], factors, 2, 0.75)
    for name in factors:
        np.testing.assert_allclose(found[name], expected[name], rtol=tolerance("factored.svd.rtol"))


@pytest.mark.parametrize("four", [False, True])
def test_more_sweeps_raise_nothing_between_the_samples(rng, four):
    """Five azimuths see no view's mirror image; rough tables, which no product follows, try what no sample holds."""
    btf = oracle_btf((2, 2), "10x5", "10x5")
    btf = dataclasses.replace(btf, values=np.exp(2 * rng.normal(size=btf.values.shape)).astype(np.float32))
    w_light, w_view, uv = upper(rng, 4000), upper(rng, 4000), rng.random((4000, 2))
    limit = tolerance("factored.between.max_peak")
    # Four factors take more sweeps to get rid of what the chain leaves.
    for sweeps, between in ((60 if four else 8, 0.3), (120, 0.3), (60, 0.0)):
        fitted = cmf.fit(btf, sweeps=sweeps, between=between, difference=four, clusters=None)
        held = fitted.evaluate(uv, w_light, w_view).max() <= limit * btf.values.max()
        assert held == (between > 0)


@pytest.mark.parametrize("half_step", [2.0, 5.0, 30.0, 90.0])
def test_every_half_vector_has_pairs_of_its_own(half_step):
    """Half vectors on the horizon have none: samples there grew to 746 times a table's mean (rings at ubo81)."""
    btf = oracle_btf((1, 1))
    resampling = cmf.Resampling(btf.views, btf.lights, half_step, 8, False)
    pairs_of = np.bincount(
        resampling._between()[0] // len(resampling.difference_set), minlength=len(resampling.half_set)
    )
    assert len(pairs_of) == len(resampling.half_set)
    assert (pairs_of > 0).all()
    assert np.isfinite(cmf.fit(btf, half_step=half_step, map_size=8).meta["fit"]["error"])


@pytest.mark.parametrize("key", KEYS)
def test_products_are_recovered(key):
    """Data that are a product of three smooth factors leave the error of maps and half floats alone."""
    fitted = methods()[key].fit(product_btf(), **({"smoothness": 0.03} if key == "hf" else {"sweeps": 20}))
    assert fitted.meta["fit"]["error"] <= tolerance(f"factored.product.{key}")


def test_chain_alone_recovers_a_product():
    """Without refinement; the mean over difference directions sees P and R too, so the error is larger."""
    fitted = cmf.fit(product_btf(), sweeps=0)
    assert fitted.meta["fit"]["error"] <= tolerance("factored.product.chain")


def test_four_factors_and_more_terms_pay():
    """At the samples; between them the interpolated data, which are no product, allow all of them the same."""
    btf = product_btf(difference=True)
    errors = {
        name: fit("cmf", btf, between=0, **kw).meta["fit"]["error"]
        for name, kw in {
            "three": {},
            "four": {"difference": True},
            "both": {"difference": True, "terms": 2},
        }.items()
    }
    assert errors["four"] < errors["three"]
    assert errors["both"] < errors["three"]


def test_division_is_floored():
    """Where the half-vector approximation vanishes, the residue is at most the data over the floor."""
    btf = product_btf()
    data, _ = factored_fit.unit_tables(btf, np.arange(12))
    resampling = cmf.Resampling(btf.views, btf.lights, 10.0, 16, False)
    # A single bright pair that no half/difference sample hits leaves Q at zero there.
    spike = np.zeros_like(data)
    spike[80, 1] = 1000
    for floor in (1e-3, 1e-1):
        for table in (spike, np.where(data > 1, data, 0)):
            factors = cmf.chain(table, resampling, 1, floor)
            product = resampling.measured.product(factors)
            assert np.isfinite(product).all()
            half = resampling.measured.half(factors)
            bound = table.max((0, 1)) / np.maximum(floor * half.mean((0, 1)), factoring.TINY)
            largest = (factors["p"][0].max(0) * factors["r"][0].max(0)) / np.sqrt(
                data.shape[0] * data.shape[1]
            )
            assert (largest <= bound * (1 + tolerance("factored.svd.rtol"))).all()


def test_resampling_errors_are_measured():
    error = fit("cmf", oracle_btf((4, 4))).meta["fit"]["resampling"]
    assert set(error) == {"half_difference", "parabolic_p", "parabolic_q", "parabolic_r"}
    finer = cmf.fit(oracle_btf((4, 4)), map_size=64, half_step=5.0).meta["fit"]["resampling"]
    assert finer["parabolic_r"] < error["parabolic_r"]
    assert finer["half_difference"] < error["half_difference"]


def test_hf_factors_its_matrix_once_and_chooses_the_best_smoothness(monkeypatch):
    calls = []
    factorize = hf.LogSystem.factorize
    monkeypatch.setattr(hf.LogSystem, "factorize", lambda self, *a: calls.append(a) or factorize(self, *a))
    btf = oracle_btf((10, 8))
    hf.fit(btf, map_size=12, smoothness=1.0)
    assert len(calls) == 1
    found = hf.fit(btf, map_size=12).meta["fit"]
    assert len(calls) == 1 + len(hf.SMOOTHNESS) + 1
    assert found["held_out"][str(found["smoothness"])] == min(found["held_out"].values())


def test_hf_bounds_what_no_sample_reaches():
    """Elsewhere the maps are the same; beyond the samples the smoothing extrapolates to more."""
    btf = oracle_btf((5, 4))
    free, bounded = (hf.factorize(btf, smoothness=0.3, bounded=b).maps["q"][:, 0] for b in (False, True))
    operators = factoring.map_operators(btf.views.vectors, btf.lights.vectors, 32, False)
    reached = (operators.q.max(0).toarray().ravel() > hf.REACHED).reshape(32, 32)
    np.testing.assert_array_equal(free[:, reached], bounded[:, reached])
    assert (bounded.max((1, 2)) == free[:, reached].max(1)).all()
    assert (free.max((1, 2)) > bounded.max((1, 2))).any()


def test_eight_bits_hardly_touch_cmf():
    btf = oracle_btf((12, 10))
    for parameters in ({}, {"sweeps": 0, "rescale": False}):
        error = {
            s: fit("cmf", btf, storage=s, **parameters).meta["fit"]["error"] ** 0.5 for s in ("float", "byte")
        }
        assert error["byte"] <= tolerance("factored.eight_bits.ratio") * error["float"]


# --- bad data ----------------------------------------------------------------------------------------------------


def spoiled(kind, rng):
    btf = oracle_btf((4, 5), dtype="float32")
    values = btf.values.copy()
    if kind == "zeros":
        values[:] = 0
    elif kind == "black texels":
        values[:, :, 1:3] = 0
    elif kind == "black channel":
        values[..., 2] = 0
    elif kind == "constant":
        values[:] = 0.25
    elif kind == "negative noise":
        values -= 0.05 * rng.random(values.shape).astype(np.float32)
    elif kind == "mostly zero":
        values[rng.random(values.shape) < 0.9] = 0
    elif kind == "tiny":
        values *= 1e-30
    elif kind == "huge":
        values *= 1e30
    return dataclasses.replace(btf, values=values)


BAD = ("zeros", "black texels", "black channel", "constant", "negative noise", "mostly zero", "tiny", "huge")


@pytest.mark.parametrize("storage", ["float", "byte"])
@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("key", KEYS)
def test_bad_data_give_finite_values(key, kind, storage, rng):
    btf = spoiled(kind, rng)
    fitted = fit(key, btf, storage=storage, clusters=6)
    for array in fitted.arrays().values():
        assert np.isfinite(array).all()
    value = fitted.evaluate(rng.random((500, 2)), upper(rng, 500), upper(rng, 500))
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    group, mean = fitted.sampling_tables()
    assert np.isfinite(mean).all()
    assert group.shape == btf.texels
    nearest = dataclasses.replace(fitted, meta=fitted.meta | {"filter_type": "nearest"})
    if kind == "zeros":
        assert (value == 0).all()
    if kind == "black texels":
        assert (nearest.evaluate([[0.5, 0.5]], btf.lights.vectors, btf.views.vectors) == 0).all()
    if kind == "black channel":
        assert (value[:, 2] == 0).all()
    if kind == "constant" and storage == "float":
        measured = fitted.evaluate([[0.5, 0.5]], btf.lights.vectors, btf.views.vectors)
        np.testing.assert_allclose(measured, 0.25, rtol=tolerance("factored.constant.rtol"))


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("views", ["pole", "four", "scattered", "10x5"])
def test_sparse_direction_sets(key, views, rng):
    spec = {
        "pole": np.array([[0, 0, 1.0]]),
        "four": directions("ubo81").vectors[[0, 1, 3, 5]],
        "scattered": upper(rng, 12),
        "10x5": "10x5",
    }[views]
    btf = oracle_btf((3, 3), spec, "ubo81" if views == "pole" else spec)
    fitted = fit(key, btf)
    value = fitted.evaluate(rng.random((500, 2)), upper(rng, 500), upper(rng, 500))
    assert np.isfinite(value).all()
    assert value.max() <= tolerance("factored.sparse.overshoot") * float(btf.values.max())


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(key, value):
    btf = oracle_btf((2, 2))
    values = btf.values.copy()
    values[3, 4, 1, 1, 0] = value
    with pytest.raises(InputError, match="not finite"):
        fit(key, dataclasses.replace(btf, values=values))


@pytest.mark.parametrize(
    ("key", "name", "value"),
    [
        ("cmf", "clusters", 0),
        ("cmf", "storage", "double"),
        ("cmf", "terms", 0),
        ("cmf", "sweeps", -1),
        ("cmf", "floor", 2.0),
        ("cmf", "half_step", 0.0),
        ("cmf", "map_size", 1),
        ("hf", "smoothness", 0.0),
        ("hf", "floor", 0.0),
        ("hf", "map_size", 1),
        ("hf", "clusters", 1.5),
    ],
)
def test_parameters_out_of_range_are_refused(key, name, value):
    with pytest.raises(InputError, match=name):
        fit(key, oracle_btf((2, 2)), **{name: value})
