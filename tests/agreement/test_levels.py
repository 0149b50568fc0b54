"""Levels of detail: the evaluators agree at any λ, and both renderers see the same footprint."""

import numpy as np
import pytest
from oracle import SHAPE
from probes import probe_points

from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.gates.tolerances import tolerance
from btfref.numerics.device_arrays import to_device
from btfref.numerics.footprint import cone_footprint, probe_weight
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.representations import save
from btfref.representations.laplacian import definition as laplacian
from btfref.scene.description import read_scene
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file
from btfref.stress.evaluators import PORTS, surface
from btfref.stress.judging import port_agreement

LODS = (0.0, 0.37, 2.5, 4.0)
SETTINGS = {
    "default": {},
    "phong, open": {"mean": "phong", "prediction": "open", "components": (5, 1, 3)},
    "paper": laplacian.PRESETS["paper"] | {"levels": 3},
}
#: Without the silhouette's: of one sample a pixel it shows the one surface or the other.
GATES = ("image.noise_free", "image.background")


@pytest.fixture(scope="module")
def made(fits, tmp_path_factory):
    folder, made = tmp_path_factory.mktemp("levels"), {}

    def get(name):
        if name not in made:
            representation = laplacian.fit(fits.btf(), **SETTINGS[name])
            made[name] = representation, folder / f"{len(made)}.laplacian.exr"
            save(*made[name])
        return made[name]

    return get


def gate_of(name):
    """The shared gate for the defaults; where rounding is not averaged over neighbouring directions, one of its own."""
    return "probe.agreement" if name == "default" else "lod.agreement"


def points(btf, representation, *, paper=False):
    uv, w_light, w_view = probe_points(np.random.default_rng(5), 12_000, representation)
    if not paper:
        return uv, w_light, w_view
    # Nearest texels and directions jump: keep away from where rounding decides.
    clear = np.abs(np.mod(uv.astype(float) * SHAPE[::-1], 1) - 0.5).max(1) < 0.49
    for w, directions in ((w_light, btf.lights), (w_view, btf.views)):
        _, weight = directions.interpolation.stencil(w.astype(float))
        ordered = np.sort(weight, 1)
        clear &= ordered[:, -1] - ordered[:, -2] > 1e-3
    return uv[clear], w_light[clear], w_view[clear]


@pytest.mark.parametrize("lod", LODS)
@pytest.mark.parametrize("name", SETTINGS)
def test_all_evaluators_agree_at_any_level(made, fits, evaluator, name, lod):
    representation, path = made(name)
    looked = points(fits.btf(), representation, paper=name == "paper")
    # The plugin's own parameter, and a level of each lookup: the same.
    values = [evaluator("drjit", representation, path, lod="none", lod_bias=lod).evaluate(*looked)]
    values += [evaluator(port, representation, path).evaluate(*looked, lod=lod) for port in PORTS]
    reference = representation.evaluate(*looked, lod=lod)
    for value in values:
        for gate in port_agreement(
            value, representation, looked, lod, gate=gate_of(name), reference=reference
        ).gates:
            assert gate.passed, gate.line
    if lod:
        finest = representation.evaluate(*looked)
        assert not port_agreement(finest, representation, looked, lod, reference=reference).passed


def test_each_lookup_has_its_own_level(made, fits, evaluator, rng):
    representation, path = made("default")
    looked = points(fits.btf(), representation)
    n = len(looked[0])
    lod = np.where(rng.random(n) < 0.3, rng.integers(0, 5, n), rng.uniform(-1, 6, n)).astype(np.float32)
    reference = representation.evaluate(*looked, lod=lod)
    for port in PORTS:
        value = evaluator(port, representation, path).evaluate(*looked, lod=lod)
        for gate in port_agreement(value, representation, looked, lod, reference=reference).gates:
            assert gate.passed, gate.line


def test_other_methods_ignore_the_level(fits, evaluator):
    import mitsuba as mi

    for key in ("lpca", "rf_poly"):
        looked = points(fits.btf(), fits(key))
        subjects = [
            evaluator("drjit", fits(key), fits.path(key), **more)
            for more in ({}, {"lod": "none", "lod_bias": 2.0})
        ]
        np.testing.assert_array_equal(*(subject.evaluate(*looked) for subject in subjects))
        assert not [n for n, _ in mi.traverse(subjects[0].plugin) if "pixel_angle" in n]


def test_the_plugin_averages_along_the_footprint(made, fits, llvm, load_plugin, rng):
    """Against the definition, lookup by lookup, on slanted planes with sheared texture coordinates."""
    import drjit as dr

    mi = llvm
    representation, path = made("default")
    n, angle = 3000, 0.03
    matrix = [[3.0, 0.4], [-0.2, 2.0]]
    to_uv = mi.ScalarTransform4f([[*matrix[0], 0, 0], [*matrix[1], 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    # The frame of the plane is the world's; the rotation of the transform turns directions of the lookup.
    dp_du, dp_dv = rng.normal(size=(2, n, 3)) * [1, 1, 0]
    dp_dv += np.cross([0, 0, 1], dp_du)
    w_view = rng.normal(size=(n, 3))
    w_view[:, 2] = 0.05 + np.abs(w_view[:, 2])
    w_view /= np.linalg.norm(w_view, axis=1, keepdims=True)
    distance, uv = 10 ** rng.uniform(-0.5, 1.5, n), rng.random((n, 2))
    si = surface(mi, n, uv.T, w_view.T)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    frame = [np.array(v).T for v in (si.sh_frame.s, si.sh_frame.t)]
    si.dp_du, si.dp_dv = to_device(mi.Vector3f, dp_du.T), to_device(mi.Vector3f, dp_dv.T)
    si.t = mi.Float(distance)
    light = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    bsdf = load_plugin(path, to_uv=to_uv, pixel_angle=angle)
    found = np.array(bsdf.eval(mi.BSDFContext(), si, to_device(mi.Vector3f, light))).T

    world = w_view[:, :1] * frame[0] + w_view[:, 1:2] * frame[1] + w_view[:, 2:] * [0, 0, 1]
    area = dp_du[:, 0] * dp_dv[:, 1] - dp_du[:, 1] * dp_dv[:, 0]
    of_u = np.stack([dp_dv[:, 1], -dp_dv[:, 0], 0 * area], -1) / area[:, None]
    of_v = np.stack([-dp_du[:, 1], dp_du[:, 0], 0 * area], -1) / area[:, None]
    rows, columns = representation.meta["texels"]
    matrix = np.array(matrix)
    gradients = [s * (a[0] * of_u + a[1] * of_v) for a, s in zip(matrix, (columns, rows), strict=True)]
    lod, step, ratio = cone_footprint(*gradients, world, [0, 0, 1], angle * distance)
    from btfref.numerics.sphere.frames import uv_transform

    _, turn = uv_transform(np.array(to_uv.matrix))
    c, s = turn.cosine, turn.sine

    def handed(w):
        """Texture coordinates that are mirrored against the surface take y of the lookup with them."""
        return np.broadcast_to(w, (n, 3)) * np.where(area < 0, -1, 1)[:, None] ** [0, 1, 0]

    def turned(w):
        w = handed(w)
        return np.stack([c * w[..., 0] - s * w[..., 1], s * w[..., 0] + c * w[..., 1], w[..., 2]], -1)

    expected = sum(
        probe_weight(j, ratio)[:, None]
        * representation.evaluate(
            uv @ matrix.T + j * step / [columns, rows], turned(light), turned(w_view), lod=lod
        )
        for j in range(-3, 4)
    )
    assert (2 * ratio > 3).mean() > tolerance("lod.seen.min_share")
    assert (lod > 1).mean() > tolerance("lod.seen.min_share")
    for gate in agreement(found, expected, gate="lod.footprint").gates:
        assert gate.passed, gate.line
    # Texture derivatives, where an integrator gives them, come first: a head-on square of w texels.
    w = 6.0
    si.duv_dx, si.duv_dy = mi.Vector2f(w / columns, 0), mi.Vector2f(0, w / rows)
    plain = load_plugin(path, pixel_angle=angle)
    found = np.array(plain.eval(mi.BSDFContext(), si, to_device(mi.Vector3f, light))).T
    expected = representation.evaluate(uv, handed(light), handed(w_view), lod=0.5 * np.log2(1 + w * w / 5))
    for gate in agreement(found, expected, gate="lod.footprint").gates:
        assert gate.passed, gate.line
    # Distance alone, as in the paper; the camera's place goes before the ray's length.
    far = load_plugin(path, lod="distance", lod_unit=2.0, camera=mi.ScalarPoint3f(0, 0, 8))
    found = np.array(far.eval(mi.BSDFContext(), si, to_device(mi.Vector3f, light))).T
    for gate in agreement(found, representation.evaluate(uv, handed(light), handed(w_view), lod=2.0)).gates:
        assert gate.passed, gate.line
    assert dr.width(si) == n


@pytest.mark.parametrize(
    ("scene", "more"),
    [("horizon", {"lod": "auto"}), ("turning", {"lod": "auto"}), ("horizon", {"lod": "distance"})],
)
def test_both_renderers_show_the_same_levels(made, llvm, need, scene, more):
    """The shared image gates with level of detail, one sample a pixel: the footprint spans whole levels."""
    need("gl")
    _, path = made("default")
    file, parameters = scene_file(scene), {"btf": str(path), **more}
    settings = {"size": (96, 64), "parameters": parameters}
    expected = render(file, grid=1, shadows=False, **settings)
    classes = pixel_classes(file, grid=1, **settings)
    image = realtime(file, grid=1, shadows=False, **settings)
    comparison = compare(image, expected, classes=classes, gate=GATES, flip=False)
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]
    without = realtime(file, grid=1, shadows=False, size=(96, 64), parameters=parameters | {"lod": "none"})
    assert not compare(without, expected, classes=classes, gate=GATES, flip=False).passed


def test_level_of_detail_antialiases_the_horizon(made, need):
    """Issue 6 in small: a picture of one sample a pixel against the supersampled one without levels."""
    need("gl")
    _, path = made("default")
    settings = {"size": (128, 80)}
    file, parameters = scene_file("horizon"), {"btf": str(path)}
    none = {"parameters": parameters | {"lod": "none"}, **settings}
    truth = realtime(file, grid=12, **none).image
    seen = (truth != 0).any(-1)
    error = [
        np.sqrt(((image.image - truth)[seen] ** 2).mean())
        for image in (
            realtime(file, grid=1, **none),
            realtime(file, grid=1, parameters=parameters, **settings),
        )
    ]
    assert error[0] / error[1] >= tolerance("lod.antialiasing.min_error_ratio")


def test_far_surfaces_fetch_less(made, need):
    """And nothing but the mean where the texture is one texel."""
    need("gl")
    _, path = made("default")
    file, fetches = scene_file("plane"), []
    for tiling in (1, 512):
        parameters = {"btf": str(path), "tiling": str(tiling)}
        result = realtime(file, parameters=parameters, grid=1, size=(64, 64), count_fetches=True)
        fetches.append(result.meta["fetches"])
    assert fetches[1] <= tolerance("lod.cost.fetches") * fetches[0]
    # Rings of views and lights, and at most 16 pairs of the mean.
    assert fetches[1] <= 12 + 16


def test_bad_levels_name_the_field(made, load_plugin):
    from btfref.errors import InputError

    _, path = made("default")
    for parameters, field in (
        ({"lod": "best"}, "lod"),
        ({"lod_unit": 0.0}, "lod_unit"),
        ({"lod_bias": float("nan")}, "lod_bias"),
        ({"pixel_angle": -1.0}, "pixel_angle"),
    ):
        with pytest.raises(RuntimeError, match=f"field '{field}'"):
            load_plugin(path, **parameters)
    with pytest.raises(InputError, match="level of detail"):
        read_scene(scene_file("horizon"), {"btf": str(path), "lod": "best"})
