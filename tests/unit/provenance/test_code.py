"""What a result depends on is found: imports of every kind, shaders, data, packages of others."""

import os
import sys
from importlib import metadata
from pathlib import Path

import pytest

from btfref import provenance
from btfref.gates import tolerances
from btfref.platform import LLVMChoice, shader_directory
from btfref.provenance import code
from btfref.provenance.imports import Imported, read
from btfref.registry import Method, method, methods

ROOT = Path(__file__).parents[3]

CELL, CHECKS = "btfref.validate.cell", "btfref.validate.stages.checks"
FITS, MATERIAL = "btfref.validate.stages.fits", "btfref.validate.material"
VIEWS, REFERENCE = "btfref.validate.pictures", "btfref.validate.own_renderer"


def depends(root, key, name):
    """Whether results of a stage for a method depend on a file of the checkout or of the shaders."""
    files = code.closure(root, (key,) if key else ()).files
    return any(path in files for path in ((ROOT / name).resolve(), (shader_directory() / name).resolve()))


@pytest.mark.parametrize(
    ("root", "key", "name"),
    [
        # A port that another method brings, and what it is derived from.
        (CELL, "lafortune_lut", "mitsuba_plugins/lafortune.py"),
        (CHECKS, "hf", "mitsuba_plugins/cmf.py"),
        (CELL, "svd", "mitsuba_plugins/lib/port.py"),
        # Modules of a definition besides the registry's row; base classes; a fit in modules of its own.
        (FITS, "hf", "btfref/representations/factored/definition.py"),
        (CHECKS, "lafortune_lut", "btfref/representations/analytic/light_functions.py"),
        (FITS, "gbrdf", "btfref/representations/gbrdf/decomposition/normals.py"),
        (CHECKS, "svd", "btfref/representations/lookup.py"),
        # Shaders and their includes, by a host or by a representation.
        (CELL, "svd", "lib/lookup/texels.glsl"),
        (CHECKS, "laplacian", "lib/numbers/split_sum.glsl"),
        (CELL, "svd", "lib/surface/frame.glsl"),
        (CELL, "rf_lobes", "environment/rf_lobes.glsl"),
        (CELL, "lpca", "environment/lights.glsl"),
        # What views are made of, whatever the method.
        (VIEWS, "raw", "btfref/representations/tabulated/raw.py"),
        (VIEWS, "raw", "btfref/scene/shipped/sphere.ply"),
        (CHECKS, "raw", "btfref/stress/lookups.py"),
        # Data, gates, and what is imported in functions, by name from a lazy package, or from a table of strings.
        (MATERIAL, None, "btfref/numerics/cie1931_d65.csv"),
        (MATERIAL, None, "btfref/mesostructure/rings.py"),
        (MATERIAL, None, "btfref/sampling/surface/walks.py"),
        (FITS, "raw", "btfref/sampling/sampled_btf.py"),
        (CELL, "raw", "btfref/gates/tolerances.toml"),
        (CELL, "gbrdf", "btfref/representations/gbrdf/tolerances.toml"),
        (REFERENCE, "lafortune_lut", "mitsuba_plugins/lafortune.py"),
    ],
)
def test_what_a_result_depends_on_is_found(root, key, name):
    assert depends(root, key, name)


@pytest.mark.parametrize(
    ("root", "key", "name"),
    [
        # Work on one method leaves the results of others valid.
        (CELL, "svd", "btfref/representations/tabulated/lpca.py"),
        (CELL, "svd", "mitsuba_plugins/lpca.py"),
        (CELL, "rf_lobes", "representations/lafortune.glsl"),
        (CELL, "lpca", "btfref/representations/factored/fit.py"),
        (CELL, "svd", "btfref/representations/gbrdf/tolerances.toml"),
        # A limit decides no fit, a port no fit, a shader no picture of Mitsuba's, no picture a material.
        (FITS, "gbrdf", "btfref/representations/gbrdf/tolerances.toml"),
        (FITS, "svd", "mitsuba_plugins/svd.py"),
        (FITS, "svd", "representations/svd.glsl"),
        (REFERENCE, "svd", "representations/svd.glsl"),
        (MATERIAL, None, "btfref/rendering/offline/reference.py"),
        (CELL, "svd", "btfref/report/document.py"),
        (CELL, "svd", "btfref/commands/validate.py"),
    ],
)
def test_what_a_result_does_not_depend_on_is_left_out(root, key, name):
    assert (ROOT / name).is_file() or (shader_directory() / name).is_file()
    assert not depends(root, key, name)


def test_every_method_has_its_files():
    for key, row in methods().items():
        files = code.closure(CELL, (key,)).files
        for module in (row.module, row.fit_module, row.plugin):
            assert not module or code.module_file(module) in files
        assert (shader_directory() / row.shader).resolve() in files


@pytest.fixture
def package(tmp_path, monkeypatch):
    """``package(files)``: a package of others on the path, from names and texts."""
    monkeypatch.syspath_prepend(tmp_path)

    def make(files):
        for name, text in files.items():
            path = tmp_path / "others" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
        code.forget()
        return {p.relative_to(tmp_path / "others").as_posix(): p.resolve() for p in tmp_path.rglob("*.*")}

    yield make
    code.forget()
    for name in [name for name in sys.modules if name.split(".")[0] == "others"]:
        del sys.modules[name]


def found(files, root):
    return {name for name, path in files.items() if path in code.closure(root).files}


def test_imports_of_every_kind(package):
    files = package(
        {
            "__init__.py": "def unused():\n    import others.left_out\n",
            "start.py": "from __future__ import annotations\n"
            "from typing import TYPE_CHECKING\n"
            "import others.plain\n"
            "from others import named\n"
            "from . import beside\n"
            "from .lazy import Asked\n"
            "try:\n    from others.tried import x\nexcept ImportError:\n    from others.handled import x\n"
            "if TYPE_CHECKING:\n    from others.typed import T\nelse:\n    import others.run\n"
            "class C:\n    def f(self):\n        with open('x'):\n            from others.inner import y\n"
            "ROWS = {'a': 'others.table:row'}\n",
            "lazy/__init__.py": "from typing import TYPE_CHECKING\nimport others.at_once\n"
            "if TYPE_CHECKING:\n    from others.home import Asked\n    from others.other_home import Other\n"
            "def __getattr__(name):\n    return 1\n",
            **{
                f"{name}.py": ""
                for name in (
                    "plain named beside tried handled typed run inner table home other_home left_out at_once"
                ).split()
            },
        }
    )
    expected = (
        "__init__ start plain named beside lazy/__init__ at_once tried handled run inner table home".split()
    )
    assert found(files, "others.start") == {f"{name}.py" for name in expected}


def test_strings_of_a_class_count_where_it_is_taken(package):
    text = "".join(
        f"class {name}:\n    PLACE = 'others.of_{file}:x'\n"
        for name, file in (("A", "a"), ("B(A)", "b"), ("C", "c"))
    )
    files = package(
        {
            "__init__.py": "",
            "classes.py": text,
            "one.py": "from others.classes import B\n",
            "all.py": "import others.classes\n",
            **{f"of_{name}.py": "" for name in "abc"},
        }
    )
    assert found(files, "others.one") == {"__init__.py", "one.py", "classes.py", "of_a.py", "of_b.py"}
    assert found(files, "others.all") >= {"of_a.py", "of_b.py", "of_c.py"}


def test_a_package_of_others_counts_as_a_whole_and_what_it_imports(package, monkeypatch):
    files = package(
        {
            "__init__.py": "",
            "definition.py": "import others.helper\n",
            "helper.py": "",
            "port.py": "",
            "odd/data.bin": "",
            "own.glsl": '#include "part.glsl"\n#include "lib/lookup/table.glsl"\n',
            "part.glsl": "",
        }
    )
    row = Method("own", "", "", "others.definition", "others.port", "own.glsl", "others")
    monkeypatch.setattr("btfref.registry.methods", lambda: {"own": row})
    before = code.code_of(CELL, "own")
    closure = code.closure(CELL, ("own",))
    assert set(files.values()) <= set(closure.files)
    assert (shader_directory() / "lib/lookup/table.glsl").resolve() in closure.files
    files["odd/data.bin"].write_text("changed", "utf-8")
    code.forget()
    assert code.code_of(CELL, "own") != before


def test_a_module_that_is_missing_is_told():
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        code.closure("btfref.no_such_module")


def test_relative_imports_and_stars(tmp_path):
    path = tmp_path / "m.py"
    path.write_text("from .. import a\nfrom ..b import *\nimport c.d as e\n", "utf-8")
    assert read(path, "p.q.m").now == [Imported("p", "a"), Imported("p.b"), Imported("c.d")]


def forget_versions():
    """As another process sees them: one asks for each version once."""
    code.code_of.cache_clear()
    provenance._installed.cache_clear()


@pytest.mark.parametrize("name", ["numpy", "scipy", "scikit-learn", "PyMaxflow", "mitsuba", "drjit"])
def test_versions_are_part_of_it(monkeypatch, name):
    before = code.code_of(CELL, "svd")
    version = metadata.version
    monkeypatch.setattr(metadata, "version", lambda asked: "0" if asked == name else version(asked))
    forget_versions()
    assert code.code_of(CELL, "svd") != before
    forget_versions()


def test_the_very_library_of_llvm_is_part_of_it(monkeypatch, tmp_path):
    before = code.code_of(CELL, "svd")
    library = tmp_path / "libLLVM.so.19.1"
    library.write_bytes(b"another")
    monkeypatch.setattr("btfref.platform.choose_llvm", lambda: LLVMChoice(str(library), 19, "", ()))
    code.code_of.cache_clear()
    assert code.code_of(CELL, "svd") != before
    code.code_of.cache_clear()


def test_code_that_changes_while_it_runs_is_seen(package):
    files = package({"__init__.py": "", "a.py": ""})
    code.code_of("others.a")
    # Written after this process began: it may have been loaded before.
    assert set(code.changed()) >= {files["a.py"]}
    old = 1_000_000_000
    for path in files.values():
        os.utime(path, ns=(old, old))
    code.forget()
    code.code_of("others.a")
    assert files["a.py"] not in code.changed()
    os.utime(files["a.py"], ns=(old, old + 1))
    assert files["a.py"] in code.changed()


def test_limits_of_methods_are_where_gates_read_them():
    """The rule that leaves a method's limits out of fits names the module that reads limits."""
    assert tolerances.__name__ == code.GATES
    assert method("gbrdf").tolerances.is_file()
