"""The shader composer is strict, and its line numbers survive."""

import re

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.platform import shader_directory
from btfref.rendering.gl.composer import TARGETS, compose, define_block, representation_defines


@pytest.fixture
def shaders(tmp_path):
    """Write shader files: ``shaders(name=text, …)`` with ``__`` for ``/`` and ``_glsl`` for the suffix."""

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return [tmp_path]

    return write


def lines_with_numbers(source):
    """``(file, line) -> text`` as a compiler counts."""
    found, file, line = {}, 0, 0
    for text in source.split("\n"):
        match = re.match(r"#line (\d+) (\d+)$", text)
        if match:
            line, file = int(match[1]), int(match[2])
            continue
        found[source.files[file], line] = text
        line += 1
    return found


def test_nested_includes_once_with_line_numbers(shaders):
    directories = shaders(
        {
            "main.glsl": '#include "a.glsl"\n#include "b.glsl"\nint main_line_3;\n',
            "a.glsl": 'int a_line_1;\n#include "lib/c.glsl"\nint a_line_3;\n',
            "b.glsl": '\n#include "lib/c.glsl"\nint b_line_3;\n',
            "lib/c.glsl": "\nint c_line_2;\n",
        }
    )
    source = compose("main.glsl", directories=directories)
    assert source.startswith("#version 330 core\n")
    numbered = lines_with_numbers(source)
    for file, line, text in [
        ("main.glsl", 3, "int main_line_3;"),
        ("a.glsl", 1, "int a_line_1;"),
        ("a.glsl", 3, "int a_line_3;"),
        ("b.glsl", 3, "int b_line_3;"),
        ("lib/c.glsl", 2, "int c_line_2;"),
    ]:
        assert numbered[file, line] == text
        assert source.count(text) == 1


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('#include "nowhere.glsl"', "unknown shader file"),
        ('#include "../outside.glsl"', "unknown shader file"),
        ("#include <lib/lookup/table.glsl>", "malformed include"),
        ("#include", "malformed include"),
        ('#if 1\n#include "lib/lookup/table.glsl"\n#endif', "inside a conditional"),
        ('#ifdef X\n#ifndef Y\n#endif\n #include "lib/lookup/table.glsl"\n#endif', "inside a conditional"),
        ("#version 330", "version line"),
        ('#include "bad.glsl"', "includes itself"),
        ('#include "representation"', "no representation"),
    ],
)
def test_refusals_name_file_and_line(shaders, text, reason):
    directories = shaders({"bad.glsl": text, "lib/x.glsl": ""})
    with pytest.raises(InputError, match=reason) as caught:
        compose("bad.glsl", directories=directories)
    assert "bad.glsl" in str(caught.value)


def test_own_directory_comes_first_and_representation_is_replaced(shaders):
    directories = shaders(
        {"lib/lookup/table.glsl": "int mine;", "foo.glsl": '#include "lib/lookup/table.glsl"\nint foo;'}
    )
    source = compose("hosts/probe.vert", representation="foo.glsl", directories=directories)
    assert "int mine;" in source
    assert "int foo;" in source
    assert "texelFetch" not in source


def test_messages_get_file_names(shaders):
    source = compose("a.glsl", directories=shaders({"a.glsl": '#include "b.glsl"\n', "b.glsl": "oops\n"}))
    assert source.explain("2:1(3): error: x") == "b.glsl:1(3): error: x"
    assert source.explain("2(1) : error C0: x") == "b.glsl(1) : error C0: x"
    assert source.explain("ERROR: 1:7: x") == "ERROR: a.glsl:7: x"


def test_definitions():
    block = define_block(
        {"a": 3, "b": True, "c": 0.1, "d": "vec2(1.0)", "e": np.float64(2), "f": np.int32(4)}
    )
    assert block.splitlines() == [
        "#define A 3",
        "#define B 1",
        "#define C 0.1",
        "#define D vec2(1.0)",
        "#define E 2.0",
        "#define F 4",
    ]
    for name, value in [("1x", 1), ("gl_x", 1), ("a__b", 1), ("x", float("nan")), ("x", "a\nb"), ("x", [1])]:
        with pytest.raises(InputError):
            define_block({name: value})
    with pytest.raises(InputError, match="target"):
        compose("hosts/probe.frag", target="100 es")


def test_dimensions_are_those_of_the_port_arrays():
    class Stub:
        meta = {"constants": {"order": 5}}  # noqa: RUF012 - read only

        def arrays(self):
            return {"basis": np.zeros((2, 5, 3, 4, 3), np.float16)}

        def port_arrays(self):
            return {"basis": np.zeros((2, 3, 4, 16), np.float16)}

    assert representation_defines(Stub()) == {
        "BASIS_DIM0": 2,
        "BASIS_DIM1": 3,
        "BASIS_DIM2": 4,
        "BASIS_DIM3": 15,
        "BASIS_STRIDE": 4,
        "ORDER": 5,
    }


def shader_files():
    """All GLSL files of the library, by name."""
    root = shader_directory()
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


@pytest.mark.parametrize("name", shader_files())
def test_every_file_says_what_it_provides_and_expects(name):
    first, second = (shader_directory() / name).read_text().splitlines()[:2]
    assert first.startswith("// Provides ")
    assert second.startswith("// Expects ")


def test_no_orphan_in_the_library():
    root = shader_directory()
    texts = [(root / name).read_text() for name in shader_files()]
    for name in shader_files():
        if name.startswith("lib/"):
            assert any(f'#include "{name}"' in text for text in texts), name


def test_targets_differ_in_version_and_precision():
    core, es = (compose("hosts/probe.frag", target=target) for target in TARGETS)
    assert core.startswith("#version 330 core\n")
    assert es.startswith("#version 300 es\n")
    assert "precision highp sampler2DArray;" in es
    assert core.splitlines()[-1] == es.splitlines()[-1]
