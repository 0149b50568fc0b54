"""What all tests share: requirements, floating-point errors, Dr.Jit state and reference data."""

import functools
import gc
import importlib.util
import os
import shutil
import sys
from pathlib import Path

#: Tests that run side by side have a core each: threads of one would only wait for those of the other.
ONE_CORE = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1
if ONE_CORE:  # read when the libraries load; programs that a test starts inherit it
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}

import numpy as np  # noqa: E402
import pytest  # noqa: E402

DATA = Path(__file__).parent / "data"

#: What a test may need beyond the package's dependencies → how to find out whether it is there.
CAPABILITIES = {
    "chromium": lambda: (
        shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    ),
    "glslang": lambda: shutil.which("glslangValidator") or shutil.which("glslang"),
    "sklearn": lambda: importlib.util.find_spec("sklearn"),
    "matplotlib": lambda: importlib.util.find_spec("matplotlib"),
    "distributed": lambda: importlib.util.find_spec("distributed"),
    "h5py": lambda: importlib.util.find_spec("h5py"),
    "pyarrow": lambda: importlib.util.find_spec("pyarrow"),
    "llvm": lambda: _llvm(),
    "gl": lambda: _gl(),
    "wgpu": lambda: importlib.util.find_spec("wgpu") and _vulkan(),
}

#: Where Chromium keeps a device of Vulkan that needs no GPU, and the loader that finds it.
SWIFTSHADER = ("/usr/lib/chromium", "/usr/lib/chromium-browser", "/opt/google/chrome")


def _vulkan():
    """Variables under which a program finds a device of Vulkan without a GPU: Chromium's, or Mesa's."""
    for folder in map(Path, SWIFTSHADER):
        if (folder / "vk_swiftshader_icd.json").exists():
            icd = str(folder / "vk_swiftshader_icd.json")
            return {"VK_ICD_FILENAMES": icd, "LD_LIBRARY_PATH": str(folder)}
    for path in Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"):
        return {"VK_ICD_FILENAMES": str(path)}
    return None


@functools.cache
def _llvm():
    """Path of the library that Dr.Jit is to load (looked for once: it takes 20 ms)."""
    from btfref.errors import MissingDependencyError
    from btfref.platform import prepare_llvm

    try:
        return prepare_llvm()
    except MissingDependencyError:
        return None


def _gl():
    """A standalone EGL context can be made (decided once: making one costs a tenth of a second)."""
    if not hasattr(_gl, "found"):
        try:
            import moderngl

            context = moderngl.create_standalone_context(backend="egl")
            _gl.found = context.info["GL_RENDERER"]
            context.release()
        except Exception:  # whatever the driver raises, the answer is no
            _gl.found = None
    return _gl.found


def required(name):
    """Whether BTFREF_REQUIRE (comma-separated names, or ``all``) says that a capability must be there."""
    wanted = {word.strip() for word in os.environ.get("BTFREF_REQUIRE", "").split(",")}
    return bool(wanted & {name, "all"})


@pytest.fixture(scope="session")
def capabilities():
    """The table that `need` looks into."""
    return CAPABILITIES


@pytest.fixture(scope="session")
def need():
    """``need("gl")`` returns what was found; if missing it skips, or fails where BTFREF_REQUIRE says so."""

    def check(name):
        found = CAPABILITIES[name]()
        if not found:
            message = f"{name} is not on this machine"
            if required(name):
                pytest.fail(f"{message}, but BTFREF_REQUIRE={os.environ['BTFREF_REQUIRE']}")
            pytest.skip(message)
        return found

    return check


@pytest.fixture
def reference_file():
    """Path of stored reference data in ``tests/data``; a missing reference fails the test."""

    def find(name):
        path = DATA / name
        if not path.exists():
            pytest.fail(f"reference {path.relative_to(DATA.parent)} is missing")
        return path

    return find


@pytest.fixture(scope="session")
def fits(tmp_path_factory):
    """Fits of every method to the oracle's tables, made on first use by one worker for all: see `oracle.Fits`."""
    from oracle import Fits

    # Workers of one run have folders of their own beside each other.
    root = tmp_path_factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "fits"
    folder.mkdir(exist_ok=True)
    return Fits(folder)


@pytest.fixture
def rng():
    """A generator with a fixed seed."""
    return np.random.default_rng(20040601)


@pytest.fixture(autouse=True)
def _floating_point_errors_raise():
    """Division by zero, NaN and overflow in NumPy are errors; a float16 store underflows by design."""
    with np.errstate(divide="raise", invalid="raise", over="raise", under="ignore"):
        yield


@pytest.fixture
def llvm(need):
    """Mitsuba with the variant ``llvm_ad_rgb`` set; Dr.Jit's memory is freed after the test."""
    need("llvm")
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    yield mi
    _free()


@pytest.fixture(scope="session")
def renderers(need):
    """Both renderers can run here: Mitsuba on LLVM, and OpenGL."""
    need("llvm")
    need("gl")


@pytest.fixture(scope="module")
def _plugins():
    """Plugins of a module's tests: making one takes a second, mostly for its tables of sampling."""
    kept = {}
    yield kept
    kept.clear()


@pytest.fixture
def load_plugin(llvm, _plugins):
    """``load_plugin(path, **parameters)``: the plugin of a file, in ``llvm_ad_rgb``; shared, not to be changed."""
    import mitsuba_plugins

    def load(path, **parameters):
        key = (str(path), *((name, str(value)) for name, value in sorted(parameters.items())))
        if key not in _plugins:
            _plugins[key] = mitsuba_plugins.load(path, **parameters)
        return _plugins[key]

    return load


@pytest.fixture
def evaluator(need):
    """``evaluator(name, representation, path)`` of `btfref.stress.evaluators`, where this machine has what it needs."""
    from btfref.stress import evaluators

    def make(name, representation, path=None, **parameters):
        row = evaluators.EVALUATORS[name]
        if row.needs:
            need(row.needs)
        return evaluators.evaluator(name, representation, path, **parameters)

    yield make
    if "drjit" in sys.modules:
        _free()


@pytest.fixture(scope="module")
def coarse_environments():
    """A quarter of the cells that stand for an environment: for tests whose two sides are made of the same ones."""
    from btfref.rendering.environment_light import harmonic_light
    from btfref.scene import environment

    with pytest.MonkeyPatch.context() as patch:
        for module in (environment, harmonic_light):
            patch.setattr(module, "CELL_ROWS", module.CELL_ROWS // 2)
        yield


@pytest.fixture(scope="module", autouse=True)
def _free_jit_state():
    """No array of one test module keeps memory, or leaves pending work, for the next."""
    yield
    if "drjit" in sys.modules:
        _free()
        # What is left, modules above all, stays: collections of the next module's tests need not look at it again.
        gc.freeze()


def _free():
    import drjit as dr

    gc.collect()
    gc.collect()
    dr.flush_malloc_cache()
