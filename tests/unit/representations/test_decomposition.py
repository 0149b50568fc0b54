"""Decomposition into a g-BRDF, stage by stage, against planted answers."""

import numpy as np
import pytest

from btfref.conventions import luminance
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.heightfield import HeightField
from btfref.numerics.microfacets import isotropic_ndf
from btfref.numerics.sphere.directions import directions
from btfref.numerics.sphere.parabolic import texel_directions
from btfref.representations.gbrdf.build import from_maps
from btfref.representations.gbrdf.decomposition import heights, materials, normals, reflectance, samples
from btfref.representations.gbrdf.decomposition.pairs import (
    ReciprocalPairs,
    shifted,
    surface_stencil,
    tangent,
)
from btfref.representations.gbrdf.decomposition.pipeline import fit
from btfref.sampling import SampledBTF

EXACT = tolerance("interpolation.exact.max")
PRODUCTS = tolerance("decomposition.products.rtol")
N = 12


def sampled(rep, spec="ubo81"):
    """The BTF of a g-BRDF at texel centres: what its decomposition should find again."""
    sets = directions(spec)
    rows, columns = rep.meta["texels"]
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    values = np.stack(
        [rep.evaluate(np.stack([u, v], -1)[None], sets.vectors[:, None, None], view) for view in sets.vectors]
    )
    return SampledBTF(values.astype(np.float32), sets, sets)


@pytest.fixture(scope="module")
def planted():
    """An egg box of two materials with texture, and its BTF."""
    v, u = np.meshgrid(*[(np.arange(N) + 0.5) / N] * 2, indexing="ij")
    wave = 0.5 + 0.25 * (np.sin(2 * np.pi * u) + np.sin(2 * np.pi * v))
    left = u < 0.5
    rng = np.random.default_rng(2)
    colour = np.where(left[..., None], [0.5, 0.2, 0.1], [0.1, 0.2, 0.5]) * rng.uniform(0.5, 1, (N, N, 1))
    rep = from_maps(
        wave,
        height_min=-0.12,
        diffuse=colour,
        fresnel=0.2,
        material=left.astype(int),
        ndf=np.stack([isotropic_ndf(0.25), isotropic_ndf(0.7)]),
        specular=0.8,
    )
    return rep, sampled(rep)


@pytest.fixture(scope="module")
def made(planted):
    """Its decomposition, and the maps of the stages."""
    stages = {}
    settings = {"pairs": 64, "depth": 0.2, "materials": 2, "iterations": 3}
    return fit(planted[1], **settings, intermediates=stages), stages


def test_shift_is_a_lookup(rng):
    image = rng.random((6, 8)).astype(np.float32)
    np.testing.assert_array_equal(shifted(image, (2 / 8, -1 / 6)), np.roll(image, (1, -2), (0, 1)))
    index, weight = surface_stencil(np.full((6, 8), -0.3), np.array([0.7, -0.2]))
    expected = (image.reshape(-1)[index] * weight).sum(-1).reshape(6, 8)
    np.testing.assert_allclose(shifted(image, 0.3 * np.array([0.7, -0.2])), expected, rtol=PRODUCTS)


def test_pairs_are_reciprocal(planted):
    pairs = ReciprocalPairs(planted[1], 20)
    assert len(pairs) == 20
    sets, values = planted[1].views, planted[1].values
    for k in (0, 7, 19):
        a, b = (int(np.argmax(sets.vectors @ w)) for w in (pairs.first[k], pairs.second[k]))
        first, second = pairs.images(k)
        np.testing.assert_allclose(first, luminance(values[a, b]), rtol=PRODUCTS)
        np.testing.assert_allclose(second, luminance(values[b, a]), rtol=PRODUCTS)


def test_lights_of_another_set_are_interpolated(planted):
    lights = directions("ubo151")
    btf = planted[1]
    index, weight = btf.lights.stencil(lights.vectors, hold=False)
    values = np.einsum("vlkrct,lk->vlrct", btf.values[:, index], weight).astype(np.float32)
    other = SampledBTF(values, btf.views, lights)
    first = ReciprocalPairs(btf, 5).images(2)[0]
    again = ReciprocalPairs(other, 5).images(2)[0]
    assert np.abs(first - again).mean() <= tolerance("decomposition.resampled.mean") * first.mean()


def test_minimum_cut_is_the_optimum(rng):
    """A planted surface in noise; with no smoothness each column takes its own best layer."""
    layers = np.linspace(-0.2, 0, 9)
    volume = rng.uniform(-1, 1, (9, 5, 6)).astype(np.float32)
    found = heights.minimum_cut(volume, layers, smoothness=0.0)
    assert (
        np.abs(found - heights.correlation_heights(volume, layers)).max()
        <= (layers[1] - layers[0]) / 2 + EXACT
    )
    # The optimum for any smoothness costs no more than either extreme.
    label = np.rint((heights.minimum_cut(volume, layers, 0.02) - layers[0]) / 0.025).astype(int)

    def cost(label, smoothness):
        data = np.take_along_axis((1 - volume) / 2, label[None], 0).sum()
        scale = float(np.mean(np.ptp((1 - volume.astype(float)) / 2, axis=0))) * 32 / 9
        steps = sum(
            w * np.abs(label - np.roll(label, (-y, -x), (0, 1))).sum()
            for y, x, w in ((0, 1, 1), (1, 0, 1), (1, 1, 2**-0.5), (1, -1, 2**-0.5))
        )
        return data + smoothness * scale * steps

    free, flat = volume.argmax(0), np.full((5, 6), volume.mean((1, 2)).argmax())
    for other in (free, flat, np.clip(label + rng.integers(-1, 2, label.shape), 0, 8)):
        assert cost(label, 0.02) <= cost(other, 0.02) + tolerance("decomposition.cut.cost")
    planted = np.zeros((9, 5, 6), np.float32)
    planted[4] = 1
    np.testing.assert_allclose(heights.minimum_cut(planted, layers, 0.1), layers[4], atol=EXACT)


def test_fusion_reproduces_what_agrees(rng):
    h = rng.random((9, 14))
    flat = normals.fuse(h, np.zeros((9, 14, 2)), 1.0)
    np.testing.assert_allclose(flat, h, atol=EXACT)
    v, u = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(32) + 0.5) / 32, indexing="ij")
    truth = 0.1 * np.sin(2 * np.pi * u) * np.cos(2 * np.pi * v)
    slopes = (
        0.2
        * np.pi
        * np.stack(
            [np.cos(2 * np.pi * u) * np.cos(2 * np.pi * v), -np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v)],
            -1,
        )
    )
    noisy = truth + 0.02 * rng.normal(size=truth.shape)
    fused = normals.fuse(noisy, slopes, 0.05)
    assert np.abs(fused - truth).std() < tolerance("decomposition.fused.noise") * np.abs(noisy - truth).std()


def test_reciprocity_knows_the_normals(planted):
    """At the true heights: the slopes of the field, and the optimizer's convergence."""
    rep, btf = planted
    truth = rep.field.heights.astype(float)
    slopes, summary = normals.helmholtz_normals(ReciprocalPairs(btf, 128), truth)
    assert summary["not_converged"] == 0
    error = np.abs(slopes - rep.field.slopes)
    assert np.median(error) <= tolerance("decomposition.slopes.median")


def test_heights_normals_and_materials_are_found(planted, made):
    rep, _ = planted
    truth = rep.field.heights.astype(float)
    error = made[1]["fused"] - truth
    assert np.sqrt((error**2).mean()) <= tolerance("decomposition.heights.rms")
    labels = made[1]["labels"]
    share = (labels == rep.maps["material"][..., 0]).mean()
    assert max(share, 1 - share) >= tolerance("decomposition.labels.min_share")


def test_the_decomposition_shows_the_btf(planted, made):
    btf = planted[1]
    model = sampled(made[0]).values
    error = np.sqrt(((model - btf.values) ** 2).sum() / (btf.values**2).sum())
    assert error <= tolerance("decomposition.nrmse.max")


def test_push_pull_keeps_and_fills(rng):
    values = rng.random((2, 16, 16))
    weight = (rng.random((2, 16, 16)) < 0.3).astype(float)
    filled = reflectance.push_pull(np.where(weight > 0, values, 0), weight)
    np.testing.assert_allclose(filled[weight > 0], values[weight > 0], rtol=EXACT)
    assert filled.min() >= values[weight > 0].min()
    assert filled.max() <= values[weight > 0].max()
    constant = reflectance.push_pull(np.where(weight > 0, 0.7, 0.0), weight)
    np.testing.assert_allclose(constant, 0.7, rtol=EXACT)


def test_distributions_are_limited(rng):
    p = reflectance.limited_distribution(1e6 * rng.random((3, 16, 16)))
    total = (p * reflectance.texel_solid_angles(16)).sum((-2, -1))
    assert (total <= 1 + EXACT).all()


def test_texels_alone_explain_their_samples(planted):
    """With the true heights: parameters of each texel reproduce its weighted samples (relative errors)."""
    rep, btf = planted
    surface = samples.SurfaceSamples(btf, rep.field)
    found = reflectance.texel_reflectance(btf, surface)
    errors = []
    (group,) = surface.groups(surface.n_texels)
    for part, seen in surface.each(btf, group, reflectance.TEXEL_NDF, colour=False):
        p = found["ndf"][part].ravel()[seen.place]
        shape = found["specular"][part] * p * seen.fresnel(found["fresnel"][part]) * seen.factor
        model = found["diffuse"][part] * seen.light + shape
        errors.append((seen.values[0] - model)[seen.light > 0])
    error = np.abs(np.concatenate(errors))
    assert np.median(error) <= tolerance("decomposition.samples.median")
    assert (found["diffuse"] <= 1).all()
    assert (found["diffuse"] + found["specular"] <= 1 + tolerance("decomposition.energy.excess")).all()


def turned_lobe(turn):
    """A distribution with two ridges, turned about the normal."""
    w = texel_directions(16)
    phi = np.arctan2(w[..., 1], w[..., 0]) - 2 * np.pi * turn
    return np.exp(-3 * (1 - w[..., 2])) * (1.2 + np.cos(2 * phi) + 0.3 * np.cos(phi))


def test_materials_are_clustered_with_their_rotation(rng):
    turns = rng.integers(0, 32, 150) / 32
    sharp = np.exp(-40 * (1 - texel_directions(16)[..., 2]))
    kinds = np.repeat([0, 1], [75, 75])
    tables = np.stack([turned_lobe(t) if k == 0 else sharp for t, k in zip(turns, kinds, strict=True)])
    tables *= 1 + 0.02 * rng.random(tables.shape)
    found, indices = materials.cluster_materials(tables, (15, 10))
    assert len(found.centres) == 2
    assert indices[2] == min(indices.values())
    first = found.labels[:75]
    assert (first == first[0]).all()
    assert (found.labels[75:] != first[0]).all()
    # Turns are known up to that of the centre; isotropic texels keep theirs.
    relative = np.mod(found.rotation[:75] - turns[:75], 1)
    apart = np.abs(np.mod(relative - relative[0] + 0.5, 1) - 0.5)
    assert apart.max() <= tolerance("decomposition.rotation.cells") / materials.N_PHI
    np.testing.assert_array_equal(found.rotation[75:], 0)


def test_one_material_is_one(rng):
    tables = isotropic_ndf(0.3, 16)[None] * (1 + 0.3 * rng.random((60, 16, 16)))
    found, _ = materials.cluster_materials(tables, (6, 10))
    assert len(found.centres) == 1


def test_relaxation_removes_specks(rng):
    tables = np.stack([isotropic_ndf(0.2, 16), isotropic_ndf(0.8, 16)])
    truth = np.repeat([0, 1], 50)
    kinds = truth.copy()
    kinds[[23, 71]] ^= 1
    mixed = np.stack(
        [0.55 * tables[k] + 0.45 * tables[1 - k] if i in (23, 71) else tables[k] for i, k in enumerate(kinds)]
    )
    features = materials.spherical_features(mixed)
    centres = materials.spherical_features(tables)
    np.testing.assert_array_equal(materials.relaxed_labels(features, centres, (10, 10)), truth)


def test_baselines_and_stages(planted, made, tmp_path):
    """The paper's two baselines run; ours are nearer to the truth than either; stages are saved on request."""
    rep, btf = planted
    truth = rep.field.heights.astype(float)
    pairs = ReciprocalPairs(btf, 64)
    layers = heights.height_layers(0.2, 24)
    volume = heights.similarity(pairs, layers)
    assert np.abs(volume).max() <= 1 + tolerance("decomposition.similarity.excess")
    correlation = heights.correlation_heights(volume, layers)
    helmholtz, slopes = heights.helmholtz_stereopsis(pairs, layers)
    path = tmp_path / "stages.npz"
    fit(btf, pairs=64, depth=0.2, layers=24, iterations=1, materials=2, intermediates=path)

    def rms(h):
        return np.sqrt(((h - truth) ** 2).mean())

    assert slopes.shape == (N, N, 2)
    with np.load(path) as stored:
        assert rms(stored["fused"]) < min(rms(correlation), rms(helmholtz))
        assert set(stored) == set(made[1])
    assert [p.name for p in tmp_path.iterdir()] == ["stages.npz"]


@pytest.mark.parametrize(
    "parameters",
    [
        {"depth": 0.0},
        {"depth": np.nan},
        {"layers": 0},
        {"pairs": 1.5},
        {"depth_weight": 0.0},
        {"smoothness": -1.0},
        {"ndf_size": 24},
        {"materials": 0},
        {"similarity": "luck"},
    ],
)
def test_bad_parameters(planted, parameters):
    with pytest.raises(InputError, match=next(iter(parameters))):
        fit(planted[1], **parameters)


def test_geometry_becomes_a_g_brdf(need):
    """Without fitting: heights, normals and materials of the checker."""
    need("llvm")
    from btfref.mesostructure.checker import checker_height
    from btfref.representations.gbrdf.geometry import from_mesostructure

    rep = from_mesostructure("checker", texels=16)
    x = (np.arange(16) + 0.5) / 16
    truth, _, _ = checker_height(*np.meshgrid(x, x), cells=2, amplitude=0.15, smoothness=0.35)
    assert np.abs(rep.field.heights - truth).max() <= tolerance("gbrdf.geometry.height")
    squares = (np.add.outer(np.arange(16) // 8, np.arange(16) // 8) % 2).astype(int)
    np.testing.assert_array_equal(rep.maps["material"][..., 0], squares)
    assert HeightField(truth.astype(np.float32)).slopes.shape == (16, 16, 2)
    # Pink squares are redder than blue, blue ones the other way round.
    colour = rep.maps["diffuse"].astype(float)
    assert (colour[squares == 0][:, 0] > colour[squares == 0][:, 2]).all()
    assert (colour[squares == 1][:, 0] < colour[squares == 1][:, 2]).all()


def test_tangent():
    np.testing.assert_allclose(tangent([0.6, 0, 0.8]), [0.75, 0])
