"""The house has floors: imports point down, and nowhere else."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

#: From the top floor down. A module belongs to the longest prefix that names it; modules of one floor may import
#: each other where they share a line's package, and nothing that stands on a line above.
FLOORS = """
btfref.__main__ btfref.docs
btfref.cli
btfref.commands btfref.pytest_plugin
btfref.board
btfref.bench btfref.demo btfref.testing btfref.view
btfref.report
btfref.validate
btfref.stress
btfref
btfref.refining
btfref.rendering
btfref.scene
btfref.datasets
mitsuba_plugins btfref.formats btfref.querying
btfref.representations
btfref.sampling
btfref.mesostructure
btfref.comparison
btfref.images
btfref.numerics btfref.gates
btfref.doctor
btfref.system btfref.provenance
btfref.registry btfref.platform btfref.outputs
btfref.conventions
btfref.errors btfref.precision
btfref.types
""".split("\n")[1:-1]

LEVEL = {name: level for level, line in enumerate(FLOORS) for name in line.split()}


def _modules():
    for package in ("btfref", "mitsuba_plugins"):
        for path in (ROOT / package).rglob("*.py"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            yield name.removesuffix(".__init__"), path


def _room(module):
    """The entry of `LEVEL` that a module belongs to; None for a name that has no floor."""
    parts = module.split(".")
    prefixes = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    return next((p for p in prefixes if p in LEVEL and (p != "btfref" or module == "btfref")), None)


def _imports(path, modules):
    """What a file imports, at its top or inside functions: names of modules of ours."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in modules else node.module for name in names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in ("btfref", "mitsuba_plugins"))


def upward(edges):
    """Those of ``(importing, imported)`` that run up, or along a floor into another room."""
    found = []
    for here, there in edges:
        rooms = _room(here), _room(there)
        if rooms[0] != rooms[1] and LEVEL[rooms[1]] <= LEVEL[rooms[0]]:
            found.append(f"{here} imports {there}")
    return found


def test_every_module_has_a_floor():
    assert [name for name, _ in _modules() if _room(name) is None] == []


def test_imports_point_down():
    modules = dict(_modules())
    edges = [(name, other) for name, path in modules.items() for other in _imports(path, modules)]
    assert len(edges) > 500
    assert upward(edges) == []


@pytest.mark.parametrize(
    "edge",
    [
        ("btfref.numerics.colour", "btfref.rendering.gl.renderer"),
        ("btfref.scene.demand", "btfref.rendering.offline.reference"),
        ("btfref.formats.maps", "mitsuba_plugins.base"),
        ("btfref.sampling.job", "btfref"),
    ],
)
def test_an_import_that_runs_up_is_found(edge):
    assert len(upward([edge])) == 1


def crowded(files, most=15):
    """Folders with more modules or shaders than a reader takes in at a glance → how many."""
    counts = Counter(
        path.parent.as_posix()
        for path in files
        if path.suffix in (".py", ".glsl", ".vert", ".frag") and path.name != "__init__.py"
    )
    return {folder: count for folder, count in counts.items() if count > most}


def test_no_folder_is_a_flat_shelf():
    tops = ("btfref", "mitsuba_plugins", "shaders", "tests")
    files = [path.relative_to(ROOT) for top in tops for path in (ROOT / top).rglob("*")]
    assert len(files) > 400
    assert crowded(files) == {}


def test_a_flat_shelf_is_found():
    shelf = [Path("shelf", f"{n}.py") for n in range(15)]
    assert crowded([*shelf, Path("shelf/__init__.py"), Path("shelf/notes.md")]) == {}
    assert crowded([*shelf, Path("shelf/one_more.glsl")]) == {"shelf": 16}
