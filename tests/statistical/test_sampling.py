"""Importance sampling of the plugin: density, weights, and what it gains over cosine sampling; for every method."""

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.gates.tolerances import tolerance
from btfref.numerics.device_arrays import to_device
from btfref.registry import methods
from btfref.representations import save
from btfref.stress.evaluators import surface
from btfref.stress.lookups import unit
from btfref.validate.sampling import chi_square

UVS = ((0.1, 0.2), (0.72, 0.35), (0.5, 0.5), (0.3, 0.8), (0.9, 0.93))
VIEWS = {
    name: unit(np.array(w))
    for name, w in {"normal": (0.0, 0, 1), "oblique": (0.6, 0.2, 0.7), "grazing": (0.9, -0.3, 0.02)}.items()
}

#: Of each χ² test by default, and in the long run.
SAMPLES, MANY_SAMPLES = 250_000, 1_000_000

#: Methods that propose directions by lobes or microfacets of their own: a test holds that these are all.
OWN = ("rf_lobes", "lafortune", "lafortune_lut", "gbrdf")

#: Method, directions, and what samples: each method's default, the shared tables alone, lobes alone, or a drawn table.
CASES = [
    *((key, "ubo81", "") for key in methods()),
    ("lpca", "capped", ""),
    *((key, "ubo81", "lobes") for key in OWN),
    ("lpca", "ubo81", "drawn"),
]

#: Drawn interpolation of methods with levels, with lobes of their own, with a geometry, and on other directions.
MORE = [
    *((key, "ubo81", "drawn") for key in ("laplacian", "rf_lobes", "gbrdf")),
    ("lpca", "scattered", "drawn"),
]


@pytest.fixture(params=[*CASES, *(pytest.param(c, marks=pytest.mark.long) for c in MORE)], ids="-".join)
def case(request, fits):
    key, kind, sampling = request.param
    name = "interpolation" if sampling == "drawn" else "sampling"
    return fits.path(key, kind), {name: sampling} if sampling else {}


def test_these_methods_have_lobes_of_their_own(llvm):
    from importlib import import_module

    from mitsuba_plugins.protocol import Proposes

    having = {
        key for key, row in methods().items() if isinstance(import_module(row.plugin).Evaluator, Proposes)
    }
    assert having == set(OWN)


def assert_samples_follow_the_density(mi, bsdf, view, uvs, samples=SAMPLES):
    """χ² at each place; significance Šidák-corrected over all that may be made."""
    n_tests = len(VIEWS) * len(UVS) * len([*CASES, *MORE])
    for uv in uvs:
        right, message = chi_square(mi, bsdf, uv, VIEWS[view], samples=samples, tests=n_tests)
        assert right, message


@pytest.mark.parametrize("view", VIEWS)
def test_samples_follow_the_density(case, view, llvm, load_plugin):
    """At one place a view: each view of a method, and each method of a view, has another. All pairs: the long run."""
    turn = [c[0] for c in CASES].index(case[0].name.split(".")[1]) + list(VIEWS).index(view)
    assert_samples_follow_the_density(llvm, load_plugin(case[0], **case[1]), view, [UVS[turn % len(UVS)]])


@pytest.mark.long
@pytest.mark.parametrize("view", VIEWS)
def test_samples_follow_the_density_everywhere(case, view, llvm, load_plugin):
    assert_samples_follow_the_density(llvm, load_plugin(case[0], **case[1]), view, UVS, MANY_SAMPLES)


def grid(n_theta=192, n_phi=384):
    """Directions and solid angles: Gauss's rule in z between the guide's rings of cells, midpoints in φ between cells.

    Densities of lobes do not vanish at the horizon, so that no rule in sin² θ will do.
    """
    from mitsuba_plugins.lib.guide import N_RADIAL

    border = np.sqrt(1 - np.arange(N_RADIAL + 1) / N_RADIAL)
    nodes, weights = np.polynomial.legendre.leggauss(n_theta // N_RADIAL)
    half = 0.5 * (border[:-1] - border[1:])[:, None]
    z = (border[1:, None] + half * (1 + nodes)).ravel()
    phi = (np.arange(n_phi) + 0.5) / n_phi * 2 * np.pi
    z, phi = np.repeat(z, n_phi), np.tile(phi, n_theta)
    radius = np.sqrt(1 - z * z)
    w = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1)
    return w, np.repeat((half * weights).ravel(), n_phi) * (2 * np.pi / n_phi)


@pytest.mark.parametrize("view", VIEWS)
def test_density_integrates_to_one(case, view, llvm, load_plugin):
    mi = llvm
    bsdf = load_plugin(case[0], **case[1])
    w, solid_angle = grid()
    si = surface(mi, len(UVS) * len(w), np.repeat(UVS, len(w), 0).T, VIEWS[view])
    pdf = np.array(bsdf.pdf(mi.BSDFContext(), si, to_device(mi.Vector3f, np.tile(w, (len(UVS), 1)).T)))
    integral = pdf.reshape(len(UVS), -1) @ solid_angle
    assert np.abs(integral - 1).max() <= tolerance("pdf.integral.max")


@pytest.mark.parametrize("view", VIEWS)
def test_weight_is_value_over_density(case, view, llvm, load_plugin, rng):
    """sample() returns eval/pdf and its own pdf(); eval_pdf() is the pair of both."""
    import drjit as dr

    mi = llvm
    bsdf, context, n = load_plugin(case[0], **case[1]), mi.BSDFContext(), len(UVS) << 15
    si = surface(mi, n, np.repeat(UVS, 1 << 15, 0).T, VIEWS[view])
    bs, weight = bsdf.sample(
        context, si, to_device(mi.Float, rng.random(n)), to_device(mi.Point2f, rng.random((2, n)))
    )
    dr.eval(bs, weight)  # one kernel for what is sampled, one for all that is asked about it
    value, pdf, both = (
        bsdf.eval(context, si, bs.wo),
        bsdf.pdf(context, si, bs.wo),
        bsdf.eval_pdf(context, si, bs.wo),
    )
    dr.eval(value, pdf, both)
    pdf = np.array(pdf)
    value, weight = np.array(value), np.array(weight)
    scale = np.abs(value).reshape(3, len(UVS), -1).max((0, 2)).repeat(1 << 15)
    assert (pdf > 0).all()
    assert (np.abs(np.array(bs.pdf) - pdf) <= tolerance("sample.pdf.max") * pdf).all()
    error = np.abs(weight * pdf - value)
    size = np.maximum(np.abs(value), tolerance("sample.floor") * scale)
    assert (error <= tolerance("sample.weight.max") * size).all()
    np.testing.assert_array_equal(np.array(both[0]), value)
    np.testing.assert_array_equal(np.array(both[1]), pdf)
    assert (np.array(bs.wo)[2] > 0).all()


N_VARIANCE_TEXELS = 96


@pytest.mark.parametrize("case", [c for c in CASES if not c[2]], indirect=True, ids="-".join)
@pytest.mark.parametrize("view", VIEWS)
def test_variance_is_at_most_that_of_cosine_sampling(case, view, llvm, load_plugin):
    """Exact by quadrature, summed over texels: constant environment, bright spots where the material reflects most.

    Lobes alone, which are no method's default, are not held to it: Lafortune's are not.
    """
    mi = llvm
    context = mi.BSDFContext()
    guided, cosine = load_plugin(case[0]), load_plugin(case[0], sampling="cosine")
    w, solid_angle = grid(48, 128)
    uv = np.random.default_rng(11).random((N_VARIANCE_TEXELS, 2))
    si = surface(mi, len(uv) * len(w), np.repeat(uv, len(w), 0).T, VIEWS[view])
    w_light = to_device(mi.Vector3f, np.tile(w, (len(uv), 1)).T)

    def table(values):
        return np.array(values, float).reshape(-1, len(uv), len(w)).mean(0)

    value = table(guided.eval(context, si, w_light))
    density = [table(b.pdf(context, si, w_light)) for b in (guided, cosine)]
    np.testing.assert_allclose(
        density[1], np.broadcast_to(w[:, 2] / np.pi, value.shape), rtol=tolerance("sample.cosine")
    )
    lobe = w[np.argmax(density[0] / density[1], axis=1)]
    lights = {"constant": np.ones_like(value), "spot": 0.1 + 100 * np.exp(100 * (lobe @ w.T - 1))}
    for name, radiance in lights.items():
        first = (value * radiance) @ solid_angle
        variance = [((value * radiance) ** 2 / d) @ solid_angle - first**2 for d in density]
        assert variance[0].sum() / variance[1].sum() <= tolerance("sample.variance_ratio.max"), name


def test_lambertian_is_sampled_as_by_cosine(llvm, load_plugin, tmp_path):
    """A constant B / cos θ leaves the cells equal: the densities are the same but for interpolation of the cosine."""
    from dataclasses import replace

    mi = llvm
    btf = oracle_btf((4, 4))
    values = np.broadcast_to(btf.lights.vectors[None, :, None, None, 2:] / np.pi, btf.values.shape)
    save(methods()["raw"].fit(replace(btf, values=values.astype(np.float16))), tmp_path / "flat.raw.exr")
    bsdf = load_plugin(tmp_path / "flat.raw.exr")
    w, _ = grid(32, 64)
    pdf = np.array(
        bsdf.pdf(
            mi.BSDFContext(),
            surface(mi, len(w), (0.4, 0.4), unit(np.array([0.3, 0.1, 0.9]))),
            mi.Vector3f(w.T),
        )
    )
    np.testing.assert_allclose(pdf, w[:, 2] / np.pi, rtol=tolerance("sample.lambert.max"))


def test_a_wrong_density_is_caught(fits, llvm, load_plugin):
    """The χ² test rejects samples of one view against the density of another."""
    bsdf = load_plugin(fits.path("lpca"))
    right, _ = chi_square(
        llvm, bsdf, UVS[0], (0, 0, 1), samples=SAMPLES, pdf_view=unit(np.array([0.3, 0, 1]))
    )
    assert not right


@pytest.mark.parametrize("lod", [0.5, 1.0, 2.3, 3.0, 4.0])
def test_sampling_at_every_level_of_detail(fits, lod, llvm, load_plugin):
    """χ² with the density, weights that are value over density, and no more variance than cosine sampling."""
    import drjit as dr

    mi, path = llvm, fits.path("laplacian")
    bsdf, context = load_plugin(path, lod="none", lod_bias=lod), mi.BSDFContext()
    w_view = VIEWS["oblique"]

    def weighed(si, bs, weight):
        value = bsdf.eval(context, si, bs.wo)
        allowed = tolerance("sample.weight.max") * dr.maximum(dr.abs(value), 1e-4)
        return dr.all(dr.abs(weight * bs.pdf - value) <= allowed)

    right, message = chi_square(mi, bsdf, UVS[1], w_view, samples=SAMPLES, tests=5, counts=weighed)
    assert right, message
    w, solid_angle = grid(48, 128)
    uv = np.random.default_rng(11).random((32, 2))
    si = surface(mi, len(uv) * len(w), np.repeat(uv, len(w), 0).T, w_view)
    w_light = to_device(mi.Vector3f, np.tile(w, (len(uv), 1)).T)
    value = np.array(bsdf.eval(context, si, w_light), float).reshape(3, len(uv), len(w)).mean(0)
    density = np.array(bsdf.pdf(context, si, w_light), float).reshape(len(uv), len(w))
    first = value @ solid_angle
    guided, cosine = ((value**2 / d) @ solid_angle - first**2 for d in (density, w[:, 2] / np.pi))
    assert guided.sum() / cosine.sum() <= tolerance("sample.variance_ratio.max")
