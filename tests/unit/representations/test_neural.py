"""The network: derivatives, known answers, what it never does, and what it refuses."""

import dataclasses

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.registry import method
from btfref.representations import load, save
from btfref.representations.neural import fit as fitting
from btfref.representations.neural import network
from btfref.representations.neural import samples as sampled
from btfref.sampling.blocks import StreamedBTF
from btfref.stress.lookups import hemisphere

HIDDEN = 4


@pytest.fixture(scope="module")
def net():
    """A random start in float64: numbers of five texels, the matrices, codes of seven pairs."""
    rng = np.random.default_rng(3)
    latent, layers = fitting.start(rng, (1, 5), HIDDEN)
    codes = network.code(hemisphere(rng, 7, float), hemisphere(rng, 7, float))
    return latent[0].astype(float), codes, {name: layer.astype(float) for name, layer in layers.items()}


@pytest.fixture(scope="module")
def quick():
    """A fit to a few texels, quick to make."""
    return method("neural").fit(oracle_btf((3, 2)), hidden=HIDDEN, passes=0.5)


def test_texels_times_pairs_are_the_definition(net):
    latent, codes, layers = net
    y, _ = network.forward(latent, codes, layers)
    for texel, row in zip(latent, y, strict=True):
        alone = network.exponents(np.broadcast_to(texel, (len(codes), len(texel))), codes, layers)
        np.testing.assert_allclose(row, alone, rtol=tolerance("neural.derivative.rtol"))


def test_derivatives_are_differences(net, rng):
    """Of every number of a texel and of every weight."""
    latent, codes, layers = net
    y, tape = network.forward(latent, codes, layers)
    slope = rng.normal(size=y.shape)
    by_texel, by_layer = network.backward(tape, slope, layers)
    step = 1e-6

    def loss(latent, layers):
        return (network.forward(latent, codes, layers)[0] * slope).sum()

    def difference(name, at):
        ends = []
        for sign in (1, -1):
            arrays = {"latent": latent.copy()} | {key: layer.copy() for key, layer in layers.items()}
            arrays[name][at] += sign * step
            ends.append(loss(arrays.pop("latent"), arrays))
        return (ends[0] - ends[1]) / (2 * step)

    for name, found in {"latent": by_texel, **by_layer}.items():
        expected = np.zeros_like(found)
        for at in np.ndindex(found.shape):
            expected[at] = difference(name, at)
        np.testing.assert_allclose(found, expected, atol=tolerance("neural.derivative.atol"))
        assert np.abs(expected).max() > tolerance("neural.derivative.subject")


@pytest.mark.parametrize("texels", [(5, 7), (1, 3), (20, 18)])
def test_a_window_gathers_what_it_spread(texels, rng):
    """Interpolation and its transpose: ⟨M z, s⟩ = ⟨z, Mᵀ s⟩, also where a window meets its own beginning."""
    window = sampled.a_window(rng, texels, True, sampled.Band(0, texels[0], whole=True))
    z = rng.normal(size=(*texels, 2)).astype(np.float32)
    moved = window.moved(z[np.ix_(window.rows, window.columns)])
    slopes = rng.normal(size=moved.shape).astype(np.float32)
    found, rows, columns = window.gathered(slopes, texels)
    assert len(set(rows)) == len(rows)
    assert len(set(columns)) == len(columns)
    one, two = (moved * slopes).sum(dtype=float), (z[np.ix_(rows, columns)] * found).sum(dtype=float)
    assert abs(one - two) <= tolerance("neural.window.max")


def test_a_diffuse_wall_is_found():
    """B = albedo cos θ / π is in the model: the light's cosine is a factor, and the exponents are constant."""
    btf = oracle_btf((2, 2), "10x5", "10x5")
    albedo = np.array([[[0.8, 0.5, 0.2], [0.1, 0.3, 0.6]], [[0.4, 0.4, 0.4], [0.05, 0.7, 0.1]]])
    values = btf.lights.vectors[:, 2, None, None, None] * (albedo / np.pi)
    values = np.broadcast_to(values, btf.values.shape).astype(np.float32)
    made = method("neural").fit(dataclasses.replace(btf, values=values), hidden=HIDDEN, passes=40)
    assert made.meta["fit"]["error"] <= tolerance("neural.wall.error")
    assert abs(made.meta["fit"]["mean_ratio"] - 1) <= tolerance("neural.wall.mean")


def test_it_is_never_negative_and_falls_to_the_horizon_as_the_cosine(quick, rng):
    n = 2000
    uv, light, view = rng.uniform(-2, 2, (n, 2)), hemisphere(rng, n, float), hemisphere(rng, n, float)
    assert quick.evaluate(uv, light, view).min() > 0
    # Below the outermost measured light nothing but the cosine changes.
    angles = np.arcsin(quick.meta["constants"]["light_edge"]) * np.array([0.9, 0.3, 1e-6])
    lights = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], -1)
    values = quick.evaluate([0.3, 0.4], lights, [0, 0, 1]) / lights[:, 2:]
    np.testing.assert_allclose(values, values[:1].repeat(3, 0), rtol=tolerance("neural.derivative.rtol"))


def test_another_seed_is_another_fit(quick):
    btf = oracle_btf((3, 2))
    again, other = (method("neural").fit(btf, hidden=HIDDEN, passes=0.5, seed=seed) for seed in (0, 1))
    for name, array in quick.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])
    assert (other.arrays()["latent"] != quick.arrays()["latent"]).any()


@pytest.mark.parametrize(
    ("parameters", "field"),
    [
        ({"hidden": 6}, "hidden"),
        ({"hidden": 0}, "hidden"),
        ({"passes": 0}, "passes"),
        ({"passes": float("nan")}, "passes"),
        ({"storage": "byte"}, "storage"),
    ],
    ids=str,
)
def test_parameters_out_of_range_are_refused(parameters, field):
    with pytest.raises(InputError) as refused:
        method("neural").fit(oracle_btf((1, 1), "10x5", "10x5"), **{"hidden": 4, "passes": 0.01} | parameters)
    assert refused.value.field == field


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda maps, meta: maps.update(layer_1=maps["layer_1"][:-1]), "layer_1"),
        (lambda maps, meta: maps.update(layer_3=maps["layer_3"][:, :2]), "layer_3"),
        (lambda maps, meta: maps.update(latent=maps["latent"][..., :-1]), "latent"),
        (lambda maps, meta: maps.update(layer_2=maps["layer_2"].astype(np.float32) + 1e5), "layer_2"),
        (lambda maps, meta: maps.pop("layer_2"), "layer_2"),
        (lambda maps, meta: maps.update(scale=-maps["colour_scale"]), "colour_scale"),
        (lambda maps, meta: meta["constants"].update(light_edge=0.5), "light_edge"),
    ],
)
def test_files_with_wrong_contents_are_refused(quick, tmp_path, change, field):
    maps, meta = dict(quick.maps), {**quick.meta, "constants": dict(quick.meta["constants"])}
    change(maps, meta)
    save(type(quick)(maps, meta), tmp_path / "x.exr")
    with pytest.raises(InputError, match=field):
        load(tmp_path / "x.exr")


@pytest.mark.long  # the largest map alone: test_gradients
def test_the_port_passes_derivatives_of_every_map(tmp_path, need):
    """Backward derivatives of a mean against differences of the definition's."""
    need("llvm")
    import drjit as dr

    import mitsuba_plugins

    made = method("neural").fit(
        oracle_btf((3, 2), "10x5", "10x5"), hidden=HIDDEN, passes=0.5, storage="float"
    )
    path, rng = tmp_path / "x.exr", np.random.default_rng(5)
    save(made, path)
    mi = mitsuba_plugins.ready()
    points = rng.random((64, 2)), hemisphere(rng, 64, float), hemisphere(rng, 64, float)
    bsdf = mitsuba_plugins.load(path)
    maps, port = bsdf.maps, bsdf.evaluator
    names = ("latent", *network.LAYERS, "colour_scale")
    for name in names:
        dr.enable_grad(maps.tensors[name])
    port.update(maps)
    uv, light, view = (
        kind(*(mi.Float(np.ascontiguousarray(p[:, k], np.float32)) for k in range(p.shape[1])))
        for kind, p in zip((mi.Point2f, mi.Vector3f, mi.Vector3f), points, strict=True)
    )
    value = port.evaluate(uv, light, view, mi.Bool(True))
    dr.backward(dr.mean(value.x + value.y + value.z))
    for name in names:
        found = np.array(dr.grad(maps.tensors[name]))[..., : made.maps[name].shape[-1]]
        # The largest derivatives say whether they arrive; they are asked of the definition one by one.
        for flat in np.argsort(-np.abs(found).ravel())[:4]:
            at, ends = np.unravel_index(flat, found.shape), []
            for sign in (1, -1):
                changed = made.maps[name].astype(float)
                changed[at] += sign * 1e-5
                moved = type(made)(made.maps | {name: changed}, made.meta)
                ends.append(moved.evaluate(*points).sum(-1).mean())
            expected = (ends[0] - ends[1]) / 2e-5
            assert abs(expected) > 0
            assert abs(found[at] / expected - 1) <= tolerance("neural.gradient.relative")


def digests(btf, **parameters):
    return {name: array.tobytes() for name, array in method("neural").fit(btf, **parameters).arrays().items()}


def test_bands_are_from_store_and_memory_alike(tmp_path, monkeypatch):
    """Three bands of rows, whatever of them may be kept; with one band the result is another one, as good."""
    btf, few = oracle_btf((26, 4), views="2x3", lights="2x3"), {"hidden": HIDDEN, "passes": 3}
    btf.save(tmp_path / "x.btf.zarr", tile=4)
    whole = method("neural").fit(btf, **few)
    monkeypatch.setattr(sampled, "TEXELS", 40)
    expected = digests(btf, **few)
    for spare in (0, 1 << 12, 1 << 20):
        assert digests(StreamedBTF(tmp_path / "x.btf.zarr", spare=spare), **few) == expected
    assert expected["latent"] != whole.maps["latent"].tobytes()
    banded = method("neural").fit(btf, **few)
    assert banded.meta["fit"]["steps"] == whole.meta["fit"]["steps"]
    assert banded.meta["fit"]["error"] < tolerance("neural.bands.error") * whole.meta["fit"]["error"]


@pytest.mark.parametrize(
    ("texels", "most"),
    [((26, 4), 40), ((9, 3), 12), ((40, 64), 8), ((41, 64), 8), ((3, 9), 8), ((5, 5), 100)],
)
def test_visits_see_all_rows_and_take_all_steps(texels, most, monkeypatch, rng):
    monkeypatch.setattr(sampled, "TEXELS", most)
    samples = sampled.Samples.of(oracle_btf(texels, views="2x3", lights="2x3"), True)
    seen, done = set(), 0
    for band, last in samples.visits(1000, 2.0):
        assert last >= done
        values = samples.read(band)
        assert values.shape[1:3] == (band.last - band.first, texels[1])
        for _ in range(done, last):
            window = sampled.a_window(rng, texels, True, band)
            assert (window.rows == (band.first + window.within) % texels[0]).all()
            at = window.rows[0], window.columns[0]
            np.testing.assert_array_equal(
                values[0, window.within[0], at[1]], samples.btf.values[0, 0, at[0], at[1]]
            )
            seen |= set(zip(window.rows[:-1].tolist(), window.rows[1:].tolist(), strict=True))
        done = last
    assert done == 1000
    # Every pair of neighbouring rows, over the edge too.
    assert seen == {(row, (row + 1) % texels[0]) for row in range(texels[0])}
