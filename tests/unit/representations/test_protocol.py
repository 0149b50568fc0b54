"""Which method satisfies which optional protocols, as a class and as an instance; the example from outside too."""

import sys
from importlib import import_module
from pathlib import Path

import pytest
from oracle import oracle_btf

from btfref.registry import methods
from btfref.representations import protocol

OUTSIDE = Path(__file__).parents[2] / "third_party" / "tinted_brdf"

#: Optional protocols of representations, and the methods that satisfy them.
REPRESENTATIONS = {
    "KeepsDirections": {"raw", "svd", "lpca", "laplacian", "rf_poly", "rf_lobes", "lafortune_lut"},
    "HasEntries": {"lpca", "gbrdf"},
    "KeepsRows": {"raw", "svd", "lpca", "laplacian", "rf_poly", "rf_lobes"},
    "HasLevels": {"laplacian"},
    "Spreads": {"gbrdf"},
    "SeesTexels": {"gbrdf"},
    "SharesTables": {"lpca"},
    "LitByHarmonics": {"lpca"},
    "LitByTransfer": {"lpca"},
    "HasSchema": set(methods()),
    "DrawsViews": {"raw", "svd", "lpca", "laplacian", "rf_poly", "rf_lobes", "lafortune_lut"},
    "HasExponents": {"rf_lobes", "lafortune", "lafortune_lut"},
}

#: Likewise of fit modules.
MODULES = {"FitModule": set(methods()), "FitsPartially": {"raw"}, "StatesMemory": set(methods())}

#: Likewise of Dr.Jit evaluators.
EVALUATORS = {
    "Evaluator": set(methods()),
    "LevelledEvaluator": {"laplacian"},
    "Displaced": {"gbrdf"},
    "HoldsFixed": {"gbrdf"},
    "Proposes": {"rf_lobes", "lafortune", "lafortune_lut", "gbrdf"},
}


def optional(module):
    """Names of the runtime protocols that a module defines."""
    return {name for name, value in vars(module).items() if getattr(value, "_is_runtime_protocol", False)}


def satisfied(thing, module, names):
    return {name for name in names if isinstance(thing, getattr(module, name))}


def test_no_protocol_is_left_out():
    from mitsuba_plugins import protocol as ports

    assert optional(protocol) == {"Representation", *REPRESENTATIONS, *MODULES}
    assert optional(ports) == {"ShowsMethod", *EVALUATORS}


@pytest.mark.parametrize("key", methods())
def test_representations_satisfy_what_they_should(key, fits):
    expected = {"Representation"} | {name for name, keys in REPRESENTATIONS.items() if key in keys}
    names = ["Representation", *REPRESENTATIONS]
    made = fits(key)
    assert satisfied(made, protocol, names) == expected
    # Asked of the class, before there is an instance: all but what only an instance has.
    assert satisfied(type(made), protocol, names) == expected - {"Representation"}


@pytest.mark.parametrize("key", methods())
def test_fit_modules_satisfy_what_they_should(key):
    fitting = methods()[key].fitting
    assert satisfied(fitting, protocol, MODULES) == {name for name, keys in MODULES.items() if key in keys}


@pytest.mark.parametrize("key", methods())
def test_evaluators_satisfy_what_they_should(key, fits, load_plugin):
    from mitsuba_plugins import protocol as ports

    bsdf = load_plugin(fits.path(key))
    assert isinstance(bsdf, ports.ShowsMethod)
    expected = {name for name, keys in EVALUATORS.items() if key in keys}
    assert satisfied(bsdf.evaluator, ports, EVALUATORS) == expected
    # The number of levels is known of an instance only.
    assert satisfied(type(bsdf.evaluator), ports, EVALUATORS) == expected - {"LevelledEvaluator"}


def test_a_method_from_outside_derives_from_nothing_and_satisfies_them(monkeypatch, llvm):
    from mitsuba_plugins import protocol as ports

    monkeypatch.syspath_prepend(OUTSIDE)
    try:
        row = import_module("tinted_brdf").METHOD
        made = row.fit(oracle_btf((4, 4)))
        assert satisfied(made, protocol, ["Representation", *REPRESENTATIONS]) == {
            "Representation",
            "HasSchema",
        }
        assert satisfied(row.fitting, protocol, MODULES) == {"FitModule"}
        evaluator = import_module(row.plugin).Evaluator
        assert satisfied(evaluator, ports, EVALUATORS) == {"Evaluator"}
        assert evaluator.__mro__ == (evaluator, object)
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "tinted_brdf"]:
            del sys.modules[name]


@pytest.mark.parametrize("around", ["nothing", "twosided", "mask"])
@pytest.mark.parametrize(("key", "displaced"), [("raw", False), ("gbrdf", True)])
def test_displaced_materials_are_known_inside_of_others(key, displaced, around, fits, llvm, load_plugin):
    from mitsuba_plugins.protocol import is_displaced

    inner = load_plugin(fits.path(key))
    if around != "nothing":
        inner = {"type": "twosided", "inner": inner}
    if around == "mask":
        inner = {"type": "mask", "opacity": 0.5, "inner": inner}
    scene = llvm.load_dict({"type": "scene", "shape": {"type": "sphere", "bsdf": inner}})
    assert is_displaced(scene.shapes()[0].bsdf()) is displaced
    assert not is_displaced(llvm.load_dict({"type": "diffuse"}))
