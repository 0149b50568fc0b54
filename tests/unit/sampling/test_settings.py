"""Settings of a synthesis are said once: what reads them agrees with them."""

import dataclasses
import json

import numpy as np
import pytest

import btfref
from btfref import platform
from btfref.cli import build_parser
from btfref.errors import InputError
from btfref.numerics.sphere.directions import directions
from btfref.provenance import LLVM, versions
from btfref.sampling import SynthesisSettings, open_store
from btfref.sampling.synthesis import synthesize, synthesize_store

SMALL = {"texels": 2, "views": "1x3", "lights": "1x3", "spp": 2}


def test_the_command_line_has_the_defaults_of_the_settings():
    args = vars(build_parser().parse_args(["synth", "checker", "-o", "a.btf.zarr"]))
    args["variance"] = not args["no_variance"]
    defaults = {field.name: field.default for field in dataclasses.fields(SynthesisSettings)}
    assert {name: args[name] for name in SynthesisSettings.names()} == defaults


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"texels": 0}, "texels"),
        ({"texels": "64"}, "texels"),
        ({"texels": np.array(1.5)}, "texels"),
        ({"texels": (1, 2, 3)}, "texels"),
        ({"texels": True}, "texels"),
        ({"spp": 1}, "spp"),
        ({"spp": 4, "target_error": 0.1}, "spp"),
        ({"seed": -1}, "seed"),
        ({"max_depth": 1}, "max_depth"),
        ({"dtype": "float64"}, "dtype"),
        ({"estimator": "photons"}, "estimator"),
        ({"target_error": 0.0}, "target_error"),
        ({"texel_error": 0.1}, "texel_error"),
        ({"target_error": 0.1, "texel_error": "few"}, "texel_error"),
        ({"target_error": 0.1, "variance": False}, "variance"),
    ],
)
def test_settings_that_cannot_be_used_are_named(wrong, named):
    with pytest.raises(InputError) as error:
        SynthesisSettings(**wrong)
    assert error.value.field == named


def test_directions_that_there_are_none_of_are_refused():
    for name in ("views", "lights"):
        with pytest.raises(InputError, match="unknown set of directions"):
            SynthesisSettings(**{name: "everywhere"})


def test_what_depends_on_others_is_derived():
    assert (SynthesisSettings().samples, SynthesisSettings(target_error=0.1).samples) == (64, 4096)
    assert SynthesisSettings(texels=3).sides == (3, 3)
    assert SynthesisSettings(texels=np.array([3, np.int64(4)])).sides == (3, 4)
    assert SynthesisSettings(views="2x3").view_set == directions("2x3")


def test_keywords_are_settings_or_the_mesostructures():
    settings, rest = SynthesisSettings(spp=16).changed({"texels": 8, "cells": 4})
    assert (settings.texels, settings.spp, rest) == (8, 16, {"cells": 4})


@pytest.mark.parametrize(
    ("settings", "parameters"),
    [
        ({"estimator": "path"}, {}),
        ({"variance": False}, {"variance": False}),
        (
            {"target_error": 0.02, "spp": 4096, "estimator": "path"},
            {"spp": 4096, "target_error": 0.02, "texel_error": None, "pilot": 8},
        ),
        (
            {"target_error": 0.02, "texel_error": 0.3, "estimator": "surface", "spp": 64},
            {"target_error": 0.02, "texel_error": 0.3, "pilot": 16},
        ),
    ],
)
def test_stores_say_what_they_always_said(settings, parameters):
    """Literally: a store that is there resumes only when it says the same."""
    said = {
        "texels": [64, 64],
        "spp": 64,
        "max_depth": 8,
        "dtype": "float16",
        "variant": "llvm_ad_rgb",
        "tile": 64,
    }
    assert SynthesisSettings(**settings).attributes() == {
        "seed": 0,
        "estimator": settings.get("estimator", "auto"),
        "parameters": said | parameters,
    }


@pytest.mark.usefixtures("llvm")
def test_settings_and_keywords_make_the_same_btf(tmp_path):
    one = btfref.synthesize("flat", reflectance=0.25, seed=3, **SMALL)
    other = synthesize("flat", SynthesisSettings(**SMALL), seed=3, reflectance=0.25)
    assert np.array_equal(one.values, other.values)
    assert one.attributes == other.attributes
    with pytest.raises(InputError, match="cells"):
        synthesize_store(tmp_path / "a.btf.zarr", "flat", SynthesisSettings(**SMALL), cells=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("llvm")
def test_a_store_that_did_not_say_its_llvm_is_continued(tmp_path):
    """Stores made before it was recorded have none; one of another LLVM is not continued."""
    out = tmp_path / "a.btf.zarr"

    def interrupt(done, total, label):
        raise KeyboardInterrupt

    def edit(change):
        header = out / "zarr.json"
        stored = json.loads(header.read_text())
        change(stored["attributes"]["versions"])
        header.write_text(json.dumps(stored))

    with pytest.raises(KeyboardInterrupt):
        synthesize_store(out, "flat", progress=interrupt, **SMALL)
    said = open_store(out).attributes["versions"]
    assert said["LLVM"]
    edit(lambda versions: versions.update(LLVM="1"))
    with pytest.raises(InputError, match=r"versions\.LLVM"):
        synthesize_store(out, "flat", **SMALL)
    edit(lambda versions: versions.pop("LLVM"))
    assert synthesize_store(out, "flat", **SMALL).complete


def test_versions_say_which_llvm_is_used(monkeypatch):
    for name, said in (("libLLVM-18.so.1", "18"), ("somewhere.so", "somewhere.so")):
        choice = platform.LLVMChoice(f"/opt/{name}", platform.llvm_version(f"/opt/{name}"), "", ())
        monkeypatch.setattr(platform, "choose_llvm", lambda choice=choice: choice)
        assert versions([LLVM])[LLVM] == said
    monkeypatch.setattr(platform, "choose_llvm", lambda: platform.LLVMChoice(None, None, "", ()))
    assert versions([LLVM])[LLVM] is None
