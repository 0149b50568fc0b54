"""Pictures at both ends of the waterfall: the float64 definition, and the mesostructure under every hit."""

from types import SimpleNamespace

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.registry import methods
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.exact import render_exact
from btfref.rendering.offline.geometry import geometry_classes, render_geometry
from btfref.rendering.offline.reference import render
from btfref.representations import save
from btfref.sampling.synthesis import synthesize
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

SIZE = (40, 40)


@pytest.fixture(autouse=True)
def _renderer(need):
    need("llvm")


#: In the default run: a method without levels of detail, and the one that has them; `btfref validate` shows all.
QUICK = ("lpca", "laplacian")


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in QUICK else pytest.mark.long) for key in methods()]
)
def test_the_reference_is_the_definition_in_float32(fits, key):
    """Curved, both sides seen, transformed texture, point lights: only rounding is between them."""
    scene, parameters = scene_file("cloth"), {"btf": str(fits.path(key)), "lights": "points2"}
    shared = {"parameters": parameters, "grid": 2, "size": SIZE}
    expected = approximate(scene, **shared)
    image = render(scene, parameters=parameters, grid=2, shadows=False, size=SIZE)
    comparison = compare(
        image, expected, classes=pixel_classes(scene, **shared), gate="image.float64", flip=False
    )
    assert comparison.passed, [gate.line for gate in comparison.gates if not gate.passed]
    assert expected.image.max() > tolerance("rendered.subject.min_peak")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """``made(name)``: path of a small representation of a mesostructure."""
    folder = tmp_path_factory.mktemp("made")

    def get(name):
        path = folder / f"{name}.svd.exr"
        if not path.exists():
            btf = synthesize(name, texels=8, views="10x5", lights="10x5", spp=2, estimator="path")
            save(methods()["svd"].fit(btf, components=1), path)
        return str(path)

    return get


def test_a_flat_mesostructure_is_known(made):
    """Every path ends at a Lambertian plane, whose BTF is a cosine at any direction: the same picture without noise."""
    scene, parameters = scene_file("sphere"), {"btf": made("flat"), "lights": "directional3"}
    shared = {"parameters": parameters, "size": SIZE}
    found = render_exact(scene, spp=16, grid=2, **shared)
    lambert = SimpleNamespace(
        meta={"filter_type": "bilinear", "texels": [8, 8]},
        evaluate=lambda uv, w_light, w_view: np.maximum(w_light[:, 2:], 0) * np.ones(3) / np.pi,
    )
    expected = approximate(scene, grid=8, load_file=lambda path: lambert, **shared).image
    inside = (pixel_classes(scene, grid=2, **shared) == PixelClass.INTERIOR) & (expected > 0.05).all(-1)
    ratio = found.image[inside] / expected[inside]
    # The tile's albedo; jittered samples where the other picture has a grid: smooth shading differs by a little.
    assert tolerance("rendered.albedo.min_median") < np.median(ratio) <= 1
    assert np.abs(ratio.mean(0) / np.median(ratio, 0) - 1).max() < tolerance("rendered.albedo.spread")


def test_on_a_plane_it_is_the_path_traced_geometry(made):
    """Two programs for one truth: borders apart, nothing but noise is between them."""
    scene, parameters = scene_file("plane"), {"btf": made("checker"), "lights": "directional1"}
    shared = {"parameters": parameters, "size": SIZE}
    mine = render_exact(scene, spp=32, seed=3, **shared)
    theirs = render_geometry(scene, spp=128, seed=4, **shared)
    classes = geometry_classes(scene, **shared)
    comparison = compare(mine, theirs, classes=classes, flip=False)
    bias = comparison.statistics["interior"]["bias"]
    assert bias["low"] <= 0 <= bias["high"]
    error = comparison.statistics["interior"]["rmse_without_noise"]
    mean = comparison.metrics["interior"]["mean_reference"]
    assert error["low"] < tolerance("rendered.geometry.relative") * mean
    assert (classes == PixelClass.INTERIOR).mean() > tolerance("rendered.subject.min_covered")


def test_same_seed_same_picture(made):
    shared = {"parameters": {"btf": made("checker")}, "size": (12, 12), "spp": 4}
    first, again, other = (render_exact(scene_file("plane"), seed=s, **shared).image for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
