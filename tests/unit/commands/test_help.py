"""Help that teaches: methods and their parameters, scenes, lights and environments."""

import re

import pytest

from btfref.cli import main
from btfref.commands.shared import method_help
from btfref.registry import Method, methods
from btfref.scene.shipped import ENVIRONMENTS, lights, names

#: What says in which range a number is.
RANGE = re.compile(r"[Aa]t least|above|power of two|\d to \d|[(\[]\d")


def shown(capsys, *arguments):
    assert main([*arguments, "--help"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 120
    return text


def test_fit_lists_the_methods(capsys):
    text = shown(capsys, "fit")
    for key, row in methods().items():
        assert re.search(rf"^  {key} +{re.escape(row.title)}", text, re.MULTILINE)


@pytest.mark.parametrize("key", list(methods()))
def test_a_method_explains_its_parameters_and_presets(key, capsys):
    row = methods()[key]
    text = shown(capsys, "fit", key)
    documented = method_help.parameters_of(row.fit)
    for name, default in row.parameters.items():
        assert f"  {name}={method_help.typed(default)}" in text
        kind, meaning = documented[name]
        assert kind
        assert meaning
        if re.match(r"int|float", kind):
            assert RANGE.search(meaning), f"{name}: no range in {meaning!r}"
        assert "see " not in meaning.lower() or "`btfref" in meaning
    for name, values in row.presets.items():
        assert f"  {name}" in text
        assert all(f"{key}={method_help.typed(value)}" in text for key, value in values.items())


def test_an_unknown_method_is_one_line(capsys):
    assert main(["fit", "nonsense", "--help"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "nonsense" in error
    assert "lpca" in error


def foreign_fit(btf, *, seed=0, progress=None, terms=(1, 2), note="x", bare=None):
    """Fit by a method of another package.

    More on it.

    Parameters
    ----------
    btf : SampledBTF
    terms : two int
        How ``many``; see :func:`other`.
    note
        See :func:`explained`.
    """


def explained(note):
    """Explained elsewhere.

    Parameters
    ----------
    note : {"x", "y"}
        Which of *these*.

    Returns
    -------
    bare : nothing
        No parameter.
    """


def test_methods_of_others_are_explained_as_far_as_they_are_documented(monkeypatch):
    row = Method("foreign", "A title", "a paper", module=__name__, plugin="", shader="")
    monkeypatch.setitem(globals(), "fit", foreign_fit)
    monkeypatch.setitem(globals(), "PRESETS", {"paper": {"terms": (3, 4), "note": "y"}, "plain": {}})
    lines = method_help.method_help(row).splitlines()
    assert lines[2] == "A title; a paper"
    assert "More on it." in lines
    assert "  terms=[1,2]  two int. How many; see other." in lines
    assert "  note=x       {x, y}. Which of *these*." in lines
    assert "  bare=null" in lines
    assert "  paper  terms=[3,4] note=y" in lines
    assert "  plain  the defaults" in lines


@pytest.mark.parametrize("command", ["render", "realtime", "demand"])
def test_scenes_lights_and_environments_are_named(command, capsys):
    text = shown(capsys, command).partition("scenes that ship:")[2]
    words = set(re.findall(r"[\w-]+", text))
    assert {*names(), *lights(), *ENVIRONMENTS, "btf", "tiling", "filter", "width", "height", "turn"} <= words
