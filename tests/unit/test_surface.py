"""The Python surface: what `import btfref` offers, and that a first session with it goes as one would guess."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

import btfref
from btfref.errors import InputError
from btfref.images import save_image

SIZE = (24, 16)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A small representation, from arrays to a file by nothing but the surface."""
    generator = np.random.default_rng(2)
    values = generator.uniform(0.05, 0.3, (8, 8, 4, 4, 3))
    btf = btfref.SampledBTF(values, "2x4", btfref.DirectionSet.of("2x4"))
    path = tmp_path_factory.mktemp("surface") / "noise.raw.exr"
    btfref.save(btfref.fit("raw", btf), path)
    return path


def test_importing_it_brings_in_nothing_and_its_names_are_listed():
    code = "import sys, btfref; print(*sorted({m.split('.')[0] for m in sys.modules})); print(*dir(btfref))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules, names = (line.split() for line in done.stdout.splitlines())
    assert set(modules).isdisjoint({"numpy", "mitsuba", "zarr", "OpenEXR", "argparse"})
    assert set(btfref.__all__) <= set(names)


@pytest.mark.parametrize("name", btfref.__all__)
def test_every_name_is_there_and_explains_itself(name):
    found = getattr(btfref, name)
    if name != "__version__":
        assert callable(found)
        assert len(inspect.getdoc(found)) > 40


def test_another_name_is_an_error():
    with pytest.raises(AttributeError, match="'btfref' has no attribute 'synthesise'"):
        btfref.synthesise  # noqa: B018


def test_submodules_stand_beside_the_functions():
    import btfref.comparison
    import btfref.rendering.offline.reference

    assert btfref.compare is btfref.comparison.compare
    assert btfref.render is btfref.rendering.offline.reference.render


def test_a_shipped_scene_in_both_renderers_and_their_comparison(file, tmp_path):
    parameters = {"btf": file, "lights": "directional1"}
    image = btfref.realtime("plane", parameters=parameters, size=SIZE, grid=2)
    reference = btfref.render("plane", parameters=parameters, size=SIZE, grid=2, shadows=False)
    assert image.image.shape == reference.image.shape == (SIZE[1], SIZE[0], 3)
    by_result = btfref.compare(image, reference, gate="image.noise_free")
    assert by_result.passed
    by_array = btfref.compare(image.image, reference.image)
    save_image(tmp_path / "image.exr", image.image)
    save_image(tmp_path / "reference.exr", reference.image)
    by_file = btfref.compare(tmp_path / "image.exr", str(tmp_path / "reference.exr"))
    assert by_result.metrics == by_array.metrics == by_file.metrics


def test_an_unknown_scene_is_one_line_with_those_that_ship():
    for renderer in (btfref.render, btfref.realtime):
        with pytest.raises(InputError, match=r"plain: no such scene.*plane"):
            renderer("plain")


def test_a_btf_is_saved_and_loaded_as_a_store(tmp_path):
    btf = btfref.SampledBTF(np.full((1, 1, 2, 2, 3), 0.1), [[0, 0, 1]], [[0, 0, 1]])
    btfref.save(btf, tmp_path / "grey.btf.zarr")
    assert np.array_equal(btfref.load(tmp_path / "grey.btf.zarr").values, btf.values)


def test_fit_knows_presets_and_says_which_parameters_there_are():
    btf = btfref.SampledBTF(np.full((1, 1, 2, 2, 3), 0.1), [[0, 0, 1]], [[0, 0, 1]])
    assert btfref.fit("svd", btf, preset="paper", components=2).meta["parameters"]["storage"] == "float"
    with pytest.raises(InputError, match=r"no such parameter.*cluster'.*clusters, components"):
        btfref.fit("lpca", btf, cluster=2)
    with pytest.raises(InputError, match=r"no such preset.*'papers'.*paper"):
        btfref.fit("lpca", btf, preset="papers")
