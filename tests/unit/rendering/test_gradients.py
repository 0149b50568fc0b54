"""Derivatives by the maps of the plugin ``btf``: what is offered, that they are right, and how maps are stored."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
from oracle import oracle_btf
from probes import hemisphere

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.device_arrays import to_device
from btfref.registry import method, methods
from btfref.representations import load, save
from btfref.representations.ported import layout, restored
from btfref.stress.evaluators import surface
from btfref.stress.gradients import Slope, Subject, gradient_gates

#: Float maps that have no derivative.
FIXED = {"gbrdf": {"cells"}}

#: Maps that are computed from others, and cannot be stored.
DERIVED = {"gbrdf": {"cells", "surface", "gloss"}}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """``small(key, **settings)``: the file of a fit with few components, in halves unless told otherwise."""
    folder, made = tmp_path_factory.mktemp("gradients"), {}

    def fit(key, **settings):
        name = "-".join([key, *map(str, settings.values())])
        if name not in made:
            # The derivative's kernel takes long to compile with the usual number of components, and is no other code.
            known = inspect.signature(method(key).fit).parameters
            few = {
                k: v
                for k, v in (("components", 2), ("clusters", 2), ("lobes", 1), ("hidden", 4), ("passes", 1.0))
                if k in known
            }
            if key == "laplacian":
                few = {"components": (2, 1, 1), "levels": 3}
            made[name] = folder / f"{name}.{key}.exr"
            save(method(key).fit(oracle_btf((8, 6)), **few, **settings), made[name])
        return made[name]

    return fit


def offered(mi, plugin):
    """The maps that ``mi.traverse`` offers."""
    parameters = mi.traverse(plugin)
    return {n: parameters[n] for n in parameters.keys() if n not in ("scale", "pixel_angle", "camera")}


@pytest.mark.parametrize("key", methods())
def test_float_maps_are_offered_in_float32_and_nothing_else(key, fits, llvm, load_plugin):
    ports = fits(key).port_arrays()
    floats = {n for n, a in ports.items() if a.dtype.kind == "f" and not n.startswith(("view_", "light_"))}
    maps = offered(llvm, load_plugin(fits.path(key)))
    assert set(maps) == floats - FIXED.get(key, set())
    for name, values in maps.items():
        assert isinstance(values, llvm.TensorXf)
        np.testing.assert_array_equal(values.numpy(), ports[name].astype(np.float32))


@pytest.mark.parametrize("key", methods())
def test_derivatives_along_a_map(key, llvm, rng, small):
    """The largest map, and the one of weights where there is one: each alone, in halves."""
    import drjit as dr

    import mitsuba_plugins

    mi = llvm
    plugin = mitsuba_plugins.load(small(key))
    parameters = mi.traverse(plugin)
    maps = offered(mi, plugin)
    largest = max(maps, key=lambda n: len(maps[n].array))
    uv, w_light, w_view = rng.random((256, 2)), hemisphere(rng, 256), hemisphere(rng, 256)
    si, wo = surface(mi, len(uv), uv.T, w_view.T), to_device(mi.Vector3f, w_light.T)
    for name in dict.fromkeys([largest, *(n for n in ("weights",) if n in maps)]):
        start = mi.TensorXf(parameters[name])
        # Of one sign, so that contributions do not cancel.
        step = mi.TensorXf(rng.random(start.shape).astype(np.float32))

        def values(t, name=name, start=start, step=step):
            parameters[name] = start + t * step
            parameters.update()
            return plugin.eval(mi.BSDFContext(), si, wo)

        def mean(h, values=values):
            """In float64: the difference of two means would show how float32 adds up."""
            return np.array(values(dr.opaque(mi.Float, h)), float).mean()  # one kernel for all steps

        t = mi.Float(0)
        dr.enable_grad(t)
        loss = dr.mean(dr.mean(values(t)))
        dr.backward(loss)
        slope = dr.grad(t)[0]
        # Richardson's extrapolation of the central difference: some methods are not linear in their maps.
        wide, narrow = ((mean(h) - mean(-h)) / (2 * h) for h in (0.006, 0.003))
        difference = (4 * narrow - wide) / 3
        assert abs(difference) >= tolerance("plugin.reaches.min_slope")  # the map does reach the value
        assert abs(slope - difference) <= tolerance("plugin.gradient.max") * abs(difference)
        parameters[name] = start
        parameters.update()


def test_the_gate_fails_for_silence_and_for_what_is_wrong():
    right = Slope(("weights",), 0.1, 0.1, 0.1)
    assert all(gate.passed for gate in gradient_gates([right]))
    silent = gradient_gates([right, replace(right, forward=0.0)])
    assert [gate.passed for gate in silent] == [False, False]
    wrong = gradient_gates([right, replace(right, backward=0.09)])
    assert [gate.passed for gate in wrong] == [False, True]
    assert not any(gate.passed for gate in gradient_gates([])[:1])  # nothing was measured


@pytest.mark.filterwarnings("error")
def test_a_rendered_mean(llvm, small):
    """By the gate: forward and backward derivatives of a picture, of two maps together.

    Between texels in the long run: four times the code to compile.
    """
    import mitsuba_plugins

    subject = Subject(mitsuba_plugins.load(small("raw"), filter_type="nearest"))
    assert set(subject.names) == {"scale", "values"}
    together = subject.slope(("scale", "values"))
    failed = [gate.line for gate in gradient_gates([together]) if not gate.passed]
    assert not failed


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
@pytest.mark.parametrize("storage", ["half", "float"])
@pytest.mark.parametrize("key", methods())
def test_rendered_means_of_everything(key, storage, filter_type, llvm, small):
    import mitsuba_plugins

    if "storage" not in inspect.signature(method(key).fit).parameters and storage == "float":
        pytest.skip("one storage")
    settings = {"storage": storage} if storage == "float" else {}
    subject = Subject(mitsuba_plugins.load(small(key, **settings), filter_type=filter_type))
    failed = [gate.line for gate in gradient_gates(subject.slopes()) if not gate.passed]
    assert not failed


@pytest.mark.long
def test_steps_of_adam_reach_a_picture(llvm, tmp_path):
    """From weights that were moved away, with a fit of the defaults: the squared error that the steps make small."""
    import mitsuba_plugins

    save(method("lpca").fit(oracle_btf((8, 6))), tmp_path / "default.lpca.exr")
    plugin = mitsuba_plugins.load(tmp_path / "default.lpca.exr", filter_type="nearest")
    before, after = Subject(plugin).approach("weights")
    assert after**2 <= before**2 * tolerance("gradient.steps.left")


@pytest.mark.parametrize("key", methods())
def test_maps_find_their_way_back(key, fits):
    """What the ports read, put back, gives the same maps; what is computed from maps is refused."""
    made = fits(key)
    ports = made.port_arrays()
    floats = {n for n, a in ports.items() if a.dtype.kind == "f" and not n.startswith(("view_", "light_"))}
    derived = DERIVED.get(key, set())
    assert set(layout(made).numbers) == floats - derived
    again = restored(made, {name: ports[name] for name in floats - derived})
    for name, array in made.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
        assert again.arrays()[name].dtype == array.dtype
    for name in derived:
        with pytest.raises(InputError, match="computed from others"):
            restored(made, {name: ports[name]})


def test_changed_maps_are_rounded_and_saved(fits, llvm, tmp_path):
    import mitsuba_plugins

    plugin = mitsuba_plugins.load(fits.path("lpca"))
    parameters = llvm.traverse(llvm.load_dict({"type": "twosided", "bsdf": plugin}))
    key = next(name for name in parameters.keys() if name.endswith("weights"))
    parameters[key] = 1.001 * llvm.TensorXf(parameters[key])
    parameters.update()
    made = mitsuba_plugins.representation_of(plugin)
    save(made, tmp_path / "out.exr")
    found, was = load(tmp_path / "out.exr").arrays(), fits("lpca").arrays()
    expected = (was["weights"].astype(np.float32) * np.float32(1.001)).astype(np.float16)
    np.testing.assert_array_equal(found["weights"], expected)
    np.testing.assert_array_equal(found["basis"], was["basis"])
    with pytest.raises(InputError, match="materials"):
        mitsuba_plugins.representation_of(llvm.load_dict({"type": "diffuse"}))
