"""The plugin ``btf`` inside Mitsuba: registration, parameters, gradients, two sides, transforms."""

import numpy as np
import pytest
from probes import hemisphere, probe_points

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.device_arrays import to_device
from btfref.representations import load
from btfref.stress.evaluators import surface


def value(mi, plugin, uv, w_light, w_view, mode=None):
    context = mi.BSDFContext() if mode is None else mi.BSDFContext(mode)
    si = surface(mi, len(uv), np.asarray(uv).T, np.asarray(w_view).T)
    return np.array(plugin.eval(context, si, to_device(mi.Vector3f, np.asarray(w_light).T))).T


def test_registers_again_after_a_variant_change(fits, llvm):
    import mitsuba_plugins

    first = mitsuba_plugins.load(fits.path("lpca"))
    # A variant that cannot take the plugin gives way to one that can.
    llvm.set_variant("scalar_rgb")
    second = mitsuba_plugins.load(fits.path("lpca"))
    assert llvm.variant() == "llvm_ad_rgb"
    assert str(first) == str(second)
    assert "method=lpca" in str(second)


@pytest.mark.parametrize(
    "variant", ["scalar_rgb", "llvm_ad_spectral", "llvm_ad_mono", "llvm_ad_mono_polarized"]
)
def test_other_variants_are_refused(variant, need):
    need("llvm")
    import mitsuba as mi

    import mitsuba_plugins

    mi.set_variant(variant)
    with pytest.raises(InputError, match="RGB variant"):
        mitsuba_plugins.register()


@pytest.mark.parametrize(
    ("parameters", "field"),
    [
        ({"filter_type": "cubic"}, "filter_type"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("nan")}, "scale"),
        ({"sampling": "none"}, "sampling"),
        ({"interpolation": "linear"}, "interpolation"),
    ],
)
def test_bad_parameters_name_the_field(fits, llvm, load_plugin, parameters, field):
    with pytest.raises(RuntimeError, match=f"field '{field}'"):
        load_plugin(fits.path("raw"), **parameters)


def test_singular_transforms_are_refused(fits, llvm, load_plugin):
    with pytest.raises(RuntimeError, match="singular"):
        load_plugin(fits.path("raw"), to_uv=llvm.ScalarTransform4f().scale([0, 1, 1]))


@pytest.mark.parametrize("hand", [1, -1])
def test_scale_and_transform(fits, llvm, load_plugin, rng, hand):
    """``scale`` multiplies; ``to_uv`` moves the texture, and its rotation or reflection turns the local frame."""
    mi = llvm
    representation = load(fits.path("raw"))
    uv, w_light, w_view = probe_points(rng, 2000, representation)
    uv = np.mod(uv, 1).astype(np.float32)
    transform = mi.ScalarTransform4f().translate([0.3, 0.1, 0]).rotate([0, 0, 1], 30).scale([2, 2 * hand, 1])
    got = value(mi, load_plugin(fits.path("raw"), scale=2.5, to_uv=transform), uv, w_light, w_view)
    angle = np.radians(30)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * [1, hand]

    def turned(w):
        return np.concatenate([w[:, :2] @ turn.T, w[:, 2:]], 1)

    expected = 2.5 * representation.evaluate(2 * uv @ turn.T + [0.3, 0.1], turned(w_light), turned(w_view))
    scale = expected.max()
    assert np.abs(got - expected).max() <= tolerance("plugin.transform.max") * scale


def test_importance_transport_swaps_the_roles(fits, llvm, load_plugin, rng):
    mi = llvm
    plugin = load_plugin(fits.path("lpca"))
    a, b = hemisphere(rng, 500), hemisphere(rng, 500)
    uv = rng.random((500, 2))
    radiance = value(mi, plugin, uv, a, b)
    importance = value(mi, plugin, uv, b, a, mi.TransportMode.Importance)
    np.testing.assert_allclose(radiance, importance, atol=tolerance("plugin.transform.max") * radiance.max())
    change = np.abs(radiance - value(mi, plugin, uv, b, a)).max() / radiance.max()
    assert change >= tolerance("plugin.reciprocity.min_change")


def test_twosided_mirrors(fits, llvm, load_plugin, rng):
    mi = llvm
    plugin = load_plugin(fits.path("raw"))
    both = mi.load_dict({"type": "twosided", "bsdf": plugin})
    a, b, uv = hemisphere(rng, 500), hemisphere(rng, 500), rng.random((500, 2))
    np.testing.assert_array_equal(value(mi, both, uv, a, b), value(mi, plugin, uv, a, b))
    below = [1, 1, -1]
    np.testing.assert_array_equal(value(mi, both, uv, a * below, b * below), value(mi, plugin, uv, a, b))


def test_renders_in_symbolic_mode(fits, llvm, load_plugin):
    """A path-traced picture with loops and calls recorded, and the same one in evaluated mode."""
    import drjit as dr

    mi = llvm
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
            "shape": {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": load_plugin(fits.path("lpca"))}},
            "other": {"type": "rectangle", "bsdf": load_plugin(fits.path("svd"))},
            "light": {"type": "constant"},
        }
    )
    pictures = []
    for symbolic in (True, False):
        flags = (dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicLoops)
        with dr.scoped_set_flag(flags[0], symbolic), dr.scoped_set_flag(flags[1], symbolic):
            pictures.append(np.array(mi.render(scene, spp=8, seed=0)))
    assert pictures[0].max() > tolerance("rendered.subject.min_peak_plugin")
    np.testing.assert_allclose(*pictures, atol=tolerance("plugin.transform.max"))
