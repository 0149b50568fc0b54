"""Drawn interpolation: ports agree for given draws, the mean is the blended value, pictures are as defined."""

import numpy as np
import pytest
from probes import hemisphere, probe_points
from scipy import stats

from btfref.cli import main
from btfref.comparison import compare
from btfref.comparison.comparison import agreement
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.numerics import draws
from btfref.numerics.device_arrays import to_device
from btfref.registry import methods
from btfref.rendering.gl.probe import probe
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.reference import render
from btfref.representations import load
from btfref.representations.protocol import DrawsViews, HasLevels, direction_axes
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file
from btfref.stress.evaluators import surface

pytestmark = pytest.mark.usefixtures("renderers")

DRAWING = [key for key, row in methods().items() if isinstance(row.representation, DrawsViews)]

#: All that draw on rings, and one on other directions.
CASES = [*((key, "ubo81") for key in DRAWING), ("lpca", "capped"), ("lpca", "scattered")]


def plugin_values(mi, plugin, uv, w_light, w_view, draw, **further):
    """Values of the plugin's evaluator for draws."""
    import drjit as dr

    at, light, view = (
        to_device(kind, a.T)
        for kind, a in zip((mi.Point2f, mi.Vector3f, mi.Vector3f), (uv, w_light, w_view), strict=True)
    )
    further = {name: to_device(mi.Float, a) for name, a in further.items()}
    value = plugin.evaluator.evaluate(
        at, light, view, mi.Bool(True), draw=to_device(mi.Float, draw), **further
    )
    return np.array(dr.select(mi.Bool(True), value, 0)).T


def test_methods_with_tables_over_views_draw():
    """All whose maps have an axis over views, and no others."""
    rows = methods().items()
    assert [key for key, row in rows if direction_axes(row.representation, "view")] == DRAWING


@pytest.mark.parametrize(("key", "kind"), CASES)
def test_evaluators_agree_for_given_draws(key, kind, fits, llvm, load_plugin, rng):
    """And in the plugin the draw is the hash of the lookup."""
    mi, representation = llvm, fits(key, kind)
    plugin = load_plugin(fits.path(key, kind), sampling="cosine", interpolation="drawn")
    uv, w_light, w_view = probe_points(rng, 2000, representation)
    numbers = draws.of_lookups(uv, w_view)
    expected = representation.evaluate(uv, w_light, w_view, draw=numbers)
    assert agreement(probe(representation, uv, w_light, w_view, draw=numbers), expected).passed
    si, light = surface(mi, len(uv), uv.T, w_view.T), to_device(mi.Vector3f, w_light.T)
    value = np.array(plugin.eval(mi.BSDFContext(), si, light)).T
    assert agreement(value, expected).passed
    # A draw of another view is no small thing: the gate sees it.
    assert not agreement(value, representation.evaluate(uv, w_light, w_view)).passed


def test_levels_of_detail_are_drawn_as_well(fits, llvm, load_plugin, rng):
    representation, n = fits("laplacian"), 1000
    assert isinstance(representation, HasLevels)
    uv, w_light, w_view = rng.random((n, 2)).astype(np.float32), hemisphere(rng, n), hemisphere(rng, n)
    lod, draw = (rng.random(n).astype(np.float32) * scale for scale in (representation.max_lod, 1))
    expected = representation.evaluate(uv, w_light, w_view, lod=lod, draw=draw)
    assert agreement(probe(representation, uv, w_light, w_view, lod, draw=draw), expected).passed
    plugin = load_plugin(fits.path("laplacian"), sampling="cosine", interpolation="drawn")
    value = plugin_values(llvm, plugin, uv, w_light, w_view, draw, lod=lod)
    assert agreement(value, expected).passed


def test_kept_views_are_drawn_as_if_all_were_there(fits, rng):
    """Views that are not there give no number, where they are drawn, and do not count where another is."""
    whole = fits("lpca")
    chosen = np.sort(rng.choice(81, 60, replace=False))
    some, n = load(fits.path("lpca"), views=chosen), 2000
    uv, w_light, w_view = rng.random((n, 2)).astype(np.float32), hemisphere(rng, n), hemisphere(rng, n)
    draw = rng.random(n).astype(np.float32)
    expected, found = (
        probe(whole, uv, w_light, w_view, draw=draw),
        probe(some, uv, w_light, w_view, draw=draw),
    )
    there = np.isfinite(found).all(-1)
    np.testing.assert_array_equal(found[there], expected[there])
    blended = np.isfinite(probe(some, uv, w_light, w_view)).all(-1)
    assert blended.sum() < there.sum() < n
    np.testing.assert_array_equal(
        some.evaluate(*(a[there] for a in (uv, w_light, w_view)), draw=draw[there]),
        whole.evaluate(*(a[there] for a in (uv, w_light, w_view)), draw=draw[there]),
    )
    with pytest.raises(InputError, match="not resident"):
        some.evaluate(uv, w_light, w_view, draw=draw)


@pytest.mark.parametrize("key", DRAWING)
def test_the_mean_over_draws_is_the_blended_value(key, fits, rng):
    """Of the definition, by numbers that fill [0, 1) evenly: what is left is at most the ends of four intervals."""
    representation, n, count = fits(key), 12, 256
    points = [rng.random((n, 1, 2)), hemisphere(rng, n, float)[:, None], hemisphere(rng, n, float)[:, None]]
    values = representation.evaluate(*points, draw=(np.arange(count) + 0.5) / count)
    expected = representation.evaluate(*points)[:, 0]
    error = np.abs(values.mean(1) - expected)
    assert (count * error <= 4 * np.abs(values).max(1)).all()


@pytest.mark.long
@pytest.mark.parametrize("key", DRAWING)
def test_draws_have_no_bias(key, fits, llvm, load_plugin, rng):
    """z of the means of 10⁴ random draws at 256 points in the plugin: normal deviates."""
    n, count = 256, 10_000
    uv, w_light, w_view = rng.random((n, 2)).astype(np.float32), hemisphere(rng, n), hemisphere(rng, n)
    plugin = load_plugin(fits.path(key), sampling="cosine", interpolation="drawn")
    many = [np.repeat(a, count, 0) for a in (uv, w_light, w_view)]
    drawn = plugin_values(llvm, plugin, *many, rng.random(n * count).astype(np.float32)).reshape(n, count, 3)
    drawn = drawn.astype(float).mean(-1)
    expected = fits(key).evaluate(uv, w_light, w_view).mean(-1)
    spread = drawn.std(1, ddof=1)
    # At a measured view nothing is random.
    some = spread > 1e-4 * np.abs(expected).max()
    z = (drawn.mean(1) - expected)[some] / spread[some] * count**0.5
    significance = tolerance("drawn.law.significance")
    assert stats.kstest(z, "norm").pvalue > significance
    assert stats.chi2.sf((z * z).sum(), len(z)) > significance


SIZE = {"size": (40, 40), "grid": 1}


@pytest.fixture(scope="module")
def cloth(fits):
    """The shipped cloth: its file, parameters, and classes of pixels."""
    parameters = {"btf": str(fits.path("lpca")), "lights": "directional3", "tiling": "4"}
    scene = scene_file("cloth")
    return scene, {"parameters": parameters, **SIZE}, pixel_classes(scene, parameters=parameters, **SIZE)


def test_real_time_is_as_the_definition_says(cloth):
    """One frame by the same draws, and the noise of many from others; then their mean is the blended picture."""
    scene, shared, classes = cloth
    one = realtime(scene, shadows=False, interpolation="drawn", seed=3, **shared)
    assert one.variance is None
    same = approximate(scene, interpolation="drawn", seed=3, **shared).image
    gates = compare(one.image, same, classes=classes, gate="image.noise_free", flip=False).gates
    assert all(gate.passed for gate in gates), gates
    blended = realtime(scene, shadows=False, **shared).image
    assert not all(
        g.passed
        for g in compare(one.image, blended, classes=classes, gate="image.noise_free", flip=False).gates
    )

    many = realtime(scene, shadows=False, interpolation="drawn", frames=64, **shared)
    assert many.meta["frames"] == 64
    gates = compare(
        blended, many.image, classes=classes, gate="image.equivalence", variance=many.variance, flip=False
    ).gates
    assert all(gate.passed for gate in gates), gates
    inside = classes == PixelClass.INTERIOR
    other = approximate(scene, interpolation="drawn", frames=12, seed=10, **shared)
    predicted = other.variance[inside].mean() * 12 / 64
    assert abs(many.variance[inside].mean() / predicted - 1) <= tolerance("drawn.noise.relative")


def test_only_random_samples_are_drawn(cloth, fits, llvm, load_plugin):
    import drjit as dr

    mi, (scene, shared, _) = llvm, cloth
    shared = {**shared, "parameters": shared["parameters"]}
    with pytest.raises(InputError, match="only pictures of random samples") as caught:
        render(scene, interpolation="drawn", **shared)
    assert caught.value.field == "interpolation"
    for given in ({"frames": 4}, {"frames": 4, "interpolation": "blended"}):
        with pytest.raises(InputError, match="frames differ by draws alone"):
            realtime(scene, **given, **shared)
    with pytest.raises(InputError, match="equally many frames"):
        realtime(scene, frames=6, interpolation="drawn", **{**shared, "grid": 2})
    with pytest.raises(InputError, match="unknown interpolation"):
        realtime(scene, interpolation="linear", **shared)

    plugin = load_plugin(fits.path("lpca"), sampling="cosine", interpolation="drawn")
    parameters = mi.traverse(plugin)
    dr.enable_grad(parameters["basis"])
    with pytest.raises(InputError, match="gradients need all neighbours"):
        parameters.update()
    dr.disable_grad(parameters["basis"])
    parameters.update()
    si = surface(mi, 1, (0.3, 0.4), (0, 0, 1))
    dr.enable_grad(si.uv)
    with pytest.raises(InputError, match="gradients need all neighbours"):
        plugin.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))


def test_command_line(cloth, tmp_path, capsys):
    scene, shared, _ = cloth
    defined = [word for name, value in shared["parameters"].items() for word in ("-D", f"{name}={value}")]
    command = [
        "realtime",
        str(scene),
        *defined,
        "--size",
        "16x16",
        "--grid",
        "2",
        "-o",
        str(tmp_path / "x.exr"),
    ]
    assert main([*command, "--interpolation", "drawn", "--frames", "6"]) == 2
    assert "a multiple of 4" in capsys.readouterr().err
    assert main([*command, "--interpolation", "drawn", "--frames", "8"]) == 0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "x.exr")]) == 0
    assert "drawn" in capsys.readouterr().out
