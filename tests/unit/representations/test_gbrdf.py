"""g-BRDFs: closed forms, energy, numerics, maps for editing, pictures and geometry."""

import numpy as np
import pytest
from probes import hemisphere, probe_points

from btfref.conventions import luminance
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.microfacets import geometry_factor, isotropic_ndf, schlick
from btfref.numerics.sphere.parabolic import texel_directions, texel_solid_angles
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.representations import load, save
from btfref.representations.gbrdf.build import HUE_STEPS, from_maps, from_photograph
from btfref.representations.gbrdf.maps import export_maps, hue_of_turns, import_maps, turns_of_hue
from btfref.stress.evaluators import PORTS
from btfref.stress.judging import port_agreement

EXACT = tolerance("interpolation.exact.max")


def edited(rng, shape=(8, 6), **changes):
    """Maps as wild as an editor can make them."""
    ndf = np.stack([isotropic_ndf(0.1), isotropic_ndf(0.4) * (1 + texel_directions(32)[..., 0])])
    settings = {
        "diffuse": rng.random((*shape, 3)),
        "rotation": rng.random(shape),
        "fresnel": rng.random(shape),
        "material": rng.integers(0, 2, shape),
        "ndf": np.maximum(ndf, 0),
        "specular": [1.0, 0.7],
        "height_min": -0.2,
        "height_max": 0.05,
    }
    return from_maps(rng.random(shape), **settings | changes)


def test_flat_lambert_is_diffuse_exactly(rng):
    colour = np.array([0.5, 0.25, 0.75])
    flat = from_maps(np.ones((5, 3)), diffuse=colour)
    uv, w_light, w_view = probe_points(rng, 2000, flat)
    expected = colour / np.pi * w_light[:, 2:].astype(float)
    np.testing.assert_allclose(flat.evaluate(uv, w_light, w_view), expected, rtol=EXACT)


def test_flat_lambert_is_mitsubas_diffuse(llvm, load_plugin, rng, tmp_path):
    import drjit as dr

    mi = llvm
    colour = [0.5, 0.25, 0.75]
    save(from_maps(np.ones((4, 4)), diffuse=colour), tmp_path / "flat.gbrdf.exr")
    ours = load_plugin(tmp_path / "flat.gbrdf.exr")
    theirs = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}})
    w_light, w_view = hemisphere(rng, 1000), hemisphere(rng, 1000)
    si = dr.zeros(mi.SurfaceInteraction3f, 1000)
    si.uv, si.wi = mi.Point2f(rng.random((2, 1000))), mi.Vector3f(w_view.T)
    a, b = (np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(w_light.T))) for bsdf in (ours, theirs))
    np.testing.assert_allclose(a, b, rtol=tolerance("gbrdf.closed_form.float32"))


@pytest.mark.parametrize("turn", [0.0, 0.25, 0.6])
def test_flat_with_one_distribution_is_its_closed_form(rng, turn):
    """At half vectors in the texels' directions, where the table is exact, turned with the tangent."""
    table = rng.random((32, 32)) * 0.1
    turn = round(turn * HUE_STEPS) / HUE_STEPS
    flat = from_maps(
        np.ones((1, 1)),
        diffuse=[0.1, 0.2, 0.3],
        rotation=turn,
        fresnel=0.25,
        ndf=table[None],
        specular=0.5,
        storage="float",
    )
    s = flat.specular_scale[0, 0]
    assert s == np.float32(0.5 * (1 - 2**-23))
    inside = np.linalg.norm(texel_directions(32)[..., :2], axis=-1) < 0.95
    local = texel_directions(32)[inside]
    c, d = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    h = np.stack([c * local[:, 0] - d * local[:, 1], d * local[:, 0] + c * local[:, 1], local[:, 2]], -1)
    w_view = hemisphere(rng, len(h)).astype(float)
    w_view /= np.linalg.norm(w_view, axis=1, keepdims=True)
    cosine = (h * w_view).sum(-1, keepdims=True)
    w_light = 2 * cosine * h - w_view
    above = (w_light[:, 2] > 0.01) & (cosine[:, 0] > 0)
    w_light, w_view, cosine = w_light[above], w_view[above], cosine[above, 0]
    p = table.astype(np.float32)[inside][above].astype(float)
    g = geometry_factor(w_light[:, 2], w_view[:, 2])
    f = schlick(cosine, 0.25)
    expected = np.float32([0.1, 0.2, 0.3]) / np.pi * w_light[:, 2:] + (s * p * f * g)[:, None]
    value = flat.evaluate([0.3, 0.3], w_light, w_view)
    np.testing.assert_allclose(value, expected, rtol=tolerance("gbrdf.closed_form.table"))


def spike(row, column, n=32):
    table = np.zeros((n, n))
    table[row, column] = 1 / texel_solid_angles(n)[row, column]
    return table


@pytest.mark.parametrize("r0", [0.0, 0.04, 0.5, 1.0])
@pytest.mark.parametrize("kind", ["smooth", "sharp", "spike", "oblique spike", "huge"])
def test_no_map_reflects_more_than_it_receives(kind, r0):
    """Albedo by quadrature over lights, for views down to the horizon, at the largest c_s that an editor can set."""
    table = {
        "smooth": isotropic_ndf(0.8),
        "sharp": isotropic_ndf(0.15),
        "spike": spike(16, 16),
        "oblique spike": spike(16, 26),
        "huge": np.full((32, 32), 1e4),
    }[kind]
    flat = from_maps(
        np.ones((1, 1)), diffuse=[0.3, 0.6, 0.1], fresnel=r0, ndf=table[None], specular=1.0, storage="float"
    )
    w, solid_angle = gauss_hemisphere(64, 128)
    for angle, azimuth in ((0, 0), (30, 180), (50, 0), (65, 180), (80, 0), (80, 100), (88, 180)):
        theta, phi = np.radians([angle, azimuth])
        view = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
        albedo = solid_angle @ flat.evaluate([0.5, 0.5], w, view)
        assert albedo.max() <= 1 + tolerance("gbrdf.energy.excess")
    # The limit is no tighter than it must be: some energy is reflected beside the diffuse part.
    assert flat.specular_scale[0, 0] > 0


def test_rough_maps_conserve_energy(rng):
    """On a height field, with slopes, rotations and materials: every point, seen from everywhere."""
    rep = edited(rng, diffuse=0.9 * rng.random((8, 6, 3)))
    w, solid_angle = gauss_hemisphere(32, 64)
    uv, views = rng.random((40, 1, 2)), hemisphere(rng, 40).astype(float)[:, None]
    albedo = np.einsum("nlc,l->nc", rep.evaluate(uv, w, views), solid_angle)
    assert albedo.max() <= 1 + tolerance("gbrdf.energy.excess")


EXTREMES = {
    "no height": {"height_min": 0.0, "height_max": 0.0},
    "extreme height": {"height_min": -4.0, "height_max": 4.0},
    "r0 0": {"fresnel": 0.0},
    "r0 1": {"fresnel": 1.0},
    "spikes": {"ndf": np.stack([spike(16, 16), spike(3, 16)])},
    "largest half": {"ndf": np.full((2, 16, 16), 65504.0)},
    "black": {"diffuse": [0.0, 0, 0], "ndf": np.zeros((2, 8, 8))},
    "white": {"diffuse": [1.0, 1, 1]},
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_are_finite(name, rng):
    rep = edited(rng, **EXTREMES[name])
    value = rep.evaluate(*probe_points(rng, 4000, rep))
    assert np.isfinite(value).all()
    assert (value >= 0).all()


@pytest.mark.parametrize("name", ["extreme height", "spikes", "largest half"])
def test_extremes_agree(name, rng, evaluator, tmp_path):
    """Grazing lights and views among them, in all ports."""
    rep = edited(rng, **EXTREMES[name])
    points = probe_points(rng, 4000, rep)
    reference = rep.evaluate(*points)
    save(rep, tmp_path / "x.gbrdf.exr")
    for port in PORTS:
        value = evaluator(port, rep, tmp_path / "x.gbrdf.exr").evaluate(*points)
        for gate in port_agreement(value, rep, points, reference=reference).gates:
            assert gate.passed, gate.line


def test_few_lookups_are_at_an_edge(fits):
    """What the agreement gates let through because a hit may move is rare: they still judge nearly everything."""
    rep = fits("gbrdf")
    points = probe_points(np.random.default_rng(7), 4000, rep)
    value = rep.evaluate(*points)
    share = (rep.spread(*points).max(-1) > tolerance("probe.agreement.max") * np.abs(value).max()).mean()
    assert share <= tolerance("gbrdf.edges.share")


def test_a_march_that_stops_early_is_caught(rng):
    """The allowance does not hide a wrong hit: heights 1 % deeper fail the gate."""
    rep = edited(rng)
    wrong = type(rep).from_arrays(
        rep.maps, rep.meta | {"constants": rep.meta["constants"] | {"height_min": -0.2025}}
    )
    points = probe_points(rng, 4000, rep)
    assert not port_agreement(wrong.evaluate(*points), rep, points).passed


def test_hues_hold_every_turn():
    code = np.arange(HUE_STEPS)
    colours = hue_of_turns(code / HUE_STEPS)
    np.testing.assert_array_equal(np.rint(turns_of_hue(colours) * HUE_STEPS), code)
    np.testing.assert_array_equal(colours[[0, 510, 1020]], [[255, 0, 0], [0, 255, 0], [0, 0, 255]])
    assert turns_of_hue(np.array([128, 128, 128])) == 0


@pytest.mark.parametrize("storage", ["half", "float"])
def test_maps_come_back_without_loss(rng, tmp_path, storage):
    rep = edited(rng, storage=storage, views="10x5")
    facts = export_maps(rep, tmp_path / "maps")
    assert facts["images"] == len(list((tmp_path / "maps").iterdir())) - 1
    again = import_maps(tmp_path / "maps")
    for name, array in rep.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
        assert again.arrays()[name].dtype == array.dtype
    assert again.meta == rep.meta
    save(again, tmp_path / "again.gbrdf.exr")
    np.testing.assert_array_equal(load(tmp_path / "again.gbrdf.exr").maps["ndf"], rep.maps["ndf"])


def test_an_edited_png_takes_the_place_of_a_map(rng, tmp_path):
    from PIL import Image

    export_maps(edited(rng), tmp_path / "maps")
    folder = tmp_path / "maps"
    Image.fromarray(np.full((8, 6), 128, np.uint8)).save(folder / "height.png")
    with pytest.raises(InputError, match="one picture"):
        import_maps(folder)
    (folder / "height.exr").unlink()
    again = import_maps(folder)
    np.testing.assert_allclose(again.maps["height"], 128 / 255, rtol=tolerance("gbrdf.closed_form.float32"))
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(folder / "diffuse.png")
    (folder / "diffuse.exr").unlink()
    with pytest.raises(InputError, match="differ in size"):
        import_maps(folder)


def test_export_leaves_nothing_half_written(rng, tmp_path):
    (tmp_path / "maps").mkdir()
    with pytest.raises(InputError):
        export_maps(edited(rng), tmp_path / "maps")
    with pytest.raises(InputError, match="no such file"):
        import_maps(tmp_path / "maps")
    assert [p.name for p in tmp_path.iterdir()] == ["maps"]


def test_photograph(rng, tmp_path):
    from PIL import Image

    picture = rng.integers(0, 255, (12, 10, 3)).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "photo.png")
    rep = from_photograph(tmp_path / "photo.png", depth=0.03)
    assert rep.meta["texels"] == [12, 10]
    assert rep.maps["height"].min() == 0
    assert rep.maps["height"].max() == 1
    bright = np.unravel_index(np.argmax(luminance(picture)), (12, 10))
    assert rep.maps["height"][bright][0] > tolerance("gbrdf.photograph.min_bright")
    # From above, without the highlight, it shows the picture.
    plain = from_photograph(tmp_path / "photo.png", depth=0.0, specular=0.0)
    v, u = (np.mgrid[0:12, 0:10] + 0.5) / np.array([12, 10])[:, None, None]
    seen = plain.evaluate(np.stack([u, v], -1), [0, 0, 1], [0, 0, 1]) * np.pi
    np.testing.assert_allclose(seen, plain.maps["diffuse"].astype(float), atol=EXACT)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"diffuse": [1.5, 0, 0]}, "diffuse"),
        ({"diffuse": [np.nan, 0, 0]}, "diffuse"),
        ({"fresnel": -0.1}, "fresnel"),
        ({"material": 2}, "material"),
        ({"material": 0.5}, "material"),
        ({"ndf": -np.ones((2, 4, 4))}, "ndf"),
        ({"ndf": np.ones((2, 4, 5))}, "ndf"),
        ({"ndf": np.full((2, 4, 4), np.inf)}, "ndf"),
        ({"specular": [2.0, 0.0]}, "specular"),
        ({"height_min": -5.0}, "height_min"),
        ({"height_min": 0.1, "height_max": 0.0}, "height_min"),
        ({"rotation": np.inf}, "rotation"),
        ({"rotation": np.zeros((3, 3))}, "rotation"),
        ({"filter_type": "cubic"}, "filter_type"),
    ],
)
def test_bad_maps_name_the_field(rng, changes, field):
    with pytest.raises(InputError, match=field):
        edited(rng, **changes)


def test_the_denominator_at_grazing_is_bounded(rng):
    """k1·n + k2·n − (k1·n)(k2·n) → 0: the factor stays in [0, 1] in float32 and float64, down to subnormal cosines."""
    smallest = np.float32(1e-45)
    for kind in (np.float32, np.float64):
        cosines = np.array([0, smallest, 1e-38, 1e-20, 1e-7, 1e-3, 0.5, 1, -1e-7, -1], kind)
        light, view = (a.ravel() for a in np.meshgrid(cosines, cosines))
        with np.errstate(under="ignore"):
            factor = geometry_factor(light, view)
        assert np.isfinite(factor).all()
        assert ((factor >= 0) & (factor <= 1)).all()
        # Seen from along the surface all light counts, from above its cosine.
        np.testing.assert_allclose(factor[(view <= 0) & (light > 0)], 1)
        np.testing.assert_allclose(
            factor[(view == 1) & (light > 1e-37)], light[(view == 1) & (light > 1e-37)]
        )
    for u, r0 in ((0, 0), (1, 0), (0, 1), (1, 1)):
        assert schlick(u, r0) == (1 if u == 0 else r0)
    w_light, w_view = hemisphere(rng, 4000).astype(float), hemisphere(rng, 4000).astype(float)
    for w in (w_light, w_view):
        w[:, 2] *= 10 ** rng.uniform(-12, 0, 4000)
        w /= np.linalg.norm(w, axis=1, keepdims=True)
    for fresnel in (0.0, 1.0):
        value = edited(rng, fresnel=fresnel, height_min=0.0, height_max=0.0).evaluate(
            [0.3, 0.6], w_light, w_view
        )
        assert np.isfinite(value).all()
        assert (value >= 0).all()
