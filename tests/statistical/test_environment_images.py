"""Pictures under environments against the path tracer: every method, four environments, three scenes.

The gates are equivalence tests: a noisy reference is inconclusive, never a pass. References have no cast shadows, as
the pictures, and the same sub-pixel positions, so that what is left is the approximation.
"""

import gc
import weakref

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.comparison.significance import tile_equivalence, tile_half_widths
from btfref.conventions import PixelClass
from btfref.gates.tolerances import tolerance
from btfref.registry import methods
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.converged import converged
from btfref.rendering.offline.direct_light import regular
from btfref.rendering.offline.reference import render
from btfref.scene.loading import loaded
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("renderers", "coarse_environments")

SCENES = ("plane", "sphere", "cloth")
ENVIRONMENTS = ("constant", "sky", "studio", "bright-texel")
GATES = {
    "lights": ("image.environment_lights",),
    "prefiltered": ("image.environment", "image.environment_tiles"),
}

#: In the default run.
QUICK = {
    ("lpca", "cloth", "bright-texel"),
    ("rf_lobes", "sphere", "bright-texel"),
}


def cell(key, scene, environment):
    """A cell of the matrix, long unless quick."""
    marks = [] if (key, scene, environment) in QUICK else [pytest.mark.long]
    return pytest.param(key, scene, environment, marks=marks, id=f"{key}-{scene}-{environment}")


CELLS = [cell(k, s, e) for k in methods() for s in SCENES for e in ENVIRONMENTS]


def compared(path, scene, environment, gates, *, size=(24, 24), way="auto", **options):
    """A picture and its converged reference, compared."""
    parameters = {"btf": str(path), "lights": "envmap", "environment": environment}
    settings = {"parameters": parameters, "size": size, "grid": 2}
    file = scene_file(scene)
    image = realtime(file, environment=way, **options, **settings)
    classes = pixel_classes(file, **settings)
    reference = converged(file, classes == PixelClass.INTERIOR, gate=gates, shadows=False, **settings)
    if reference.meta["noise_ratio"] > 1:
        # Not an AssertionError: an undecided cell is no known miss.
        pytest.fail("the reference is too noisy to tell")
    return image, compare(image, reference, classes=classes, gate=gates, flip=False)


@pytest.mark.parametrize(("key", "scene", "environment"), CELLS)
def test_every_method_under_every_environment(fits, key, scene, environment):
    way = "prefiltered" if methods()[key].image_light else "lights"
    image, found = compared(fits.path(key), scene, environment, GATES[way])
    assert image.meta["environment_path"] == way
    assert found.passed, [gate.line for gate in found.gates]


def test_spherical_harmonics_say_where_they_fail(fits):
    """Five bands under a single bright texel: not a pass, and the picture's own facts warn of it."""
    gates = GATES["lights"]
    image, found = compared(fits.path("lpca"), "sphere", "bright-texel", gates, way="sh")
    assert [gate.outcome for gate in found.gates if gate.name.endswith("relative_rmse")] == ["fail"]
    assert image.meta["ringing"] > tolerance("harmonics.texel.min_ringing")
    assert image.meta["estimated_error"] > tolerance("image.environment_lights.relative_rmse")


def test_the_reference_without_shadows_is_unbiased(fits):
    """A constant environment in a bowl: exactly the albedo without shadows, and darker with them."""
    parameters = {"btf": str(fits.path("lpca")), "lights": "constant"}
    settings = {"parameters": parameters, "size": (24, 24), "grid": 2}
    file = scene_file("bowl")
    # Order 1 of spherical harmonics is exact here.
    exact = realtime(file, environment="sh", order=1, **settings)
    inside = pixel_classes(file, **settings) == PixelClass.INTERIOR
    plain = render(file, spp=1024, seed=3, shadows=False, **settings)
    found = compare(
        exact, plain, classes=inside.astype(np.uint8), gate="image.environment_lights", flip=False
    )
    assert found.passed, [gate.line for gate in found.gates]
    shadowed = render(file, spp=256, seed=3, **settings)
    share = shadowed.image[inside].mean() / plain.image[inside].mean()
    assert share < tolerance("rendered.bowl.shadowed")
    # The usual integrator, with random positions, has the same mean.
    with loaded(file, parameters, size=(24, 24)) as made:
        batches, variance, spp = regular(made, 2, 250, 0, shadows=True)
    image = batches.mean(0)
    assert spp >= 250
    z = (image - shadowed.image)[inside] / np.sqrt(variance + shadowed.variance)[inside]
    assert np.abs(z).mean() < tolerance("rendered.bowl.mean_z")
    assert abs(z.mean()) * np.sqrt(z.size) < 5


@pytest.mark.parametrize(
    ("lights", "more", "drawn"),
    [
        ("directional1", {}, "cosine"),
        ("directional1", {"with_variance": True}, "data"),
        ("constant", {}, "data"),
    ],
)
def test_a_grid_draws_by_the_data_where_it_draws(fits, monkeypatch, lights, more, drawn):
    """Tables to draw by are left out under delta lights alone: without them an environment is all noise."""
    from mitsuba_plugins import base

    seen, guide = [], base.LightGuide
    monkeypatch.setattr(base, "LightGuide", lambda *given: seen.append(given[-1]) or guide(*given))
    parameters = {"btf": str(fits.path("lpca")), "lights": lights}
    render(scene_file("plane"), parameters=parameters, grid=1, spp=4, size=(8, 8), **more)
    assert seen == [drawn]


def test_no_garbage_is_collected_while_kernels_are_traced(fits, monkeypatch):
    """A material in Python that a collection frees in the middle of Dr.Jit's list of materials is a crash."""
    from btfref.rendering.offline import reference

    seen, once = [], reference._monte_carlo
    monkeypatch.setattr(
        reference, "_monte_carlo", lambda *arguments: seen.append(gc.isenabled()) or once(*arguments)
    )
    parameters = {"btf": str(fits.path("rf_poly")), "lights": "constant"}
    assert gc.isenabled()
    render(scene_file("plane"), parameters=parameters, spp=2, size=(4, 4))
    assert seen == [False]
    assert gc.isenabled()


def test_dead_materials_are_gone_before_anything_is_traced(fits, llvm):
    """They hang in cycles with their scenes, and only a collection frees them."""
    import mitsuba_plugins
    from btfref.sampling.variant import mitsuba_variant

    class Scene:
        pass

    scene = Scene()
    scene.itself, scene.material = scene, mitsuba_plugins.load(fits.path("rf_poly"))
    alive = weakref.ref(scene)
    gc.disable()
    try:
        del scene
        assert alive() is not None
        with mitsuba_variant("llvm_ad_rgb"):
            assert alive() is None
    finally:
        gc.enable()


def test_tiles_have_three_outcomes(rng):
    """A region that is off by more, less, or an unknown amount."""
    mask = np.ones((32, 40), bool)
    mask[30:] = False
    noise = rng.normal(size=(32, 40, 3))
    wrong = np.zeros_like(noise)
    wrong[8:16, 16:24] = 0.05
    settings = {"mask": mask, "tolerance": 0.02}

    def outcome(difference, sigma):
        variance = np.full(noise.shape, sigma**2)
        return tile_equivalence(difference + sigma * noise, variance, **settings).outcome

    assert outcome(0 * wrong, 0.01) == "pass"
    assert outcome(wrong, 0.01) == "fail"
    assert outcome(0 * wrong, 1.0) == "inconclusive"
    assert outcome(wrong, 1.0) == "inconclusive"
    assert tile_equivalence(wrong, wrong, np.zeros_like(mask), tolerance=0.02) is None


def test_the_noisiest_tile_decides_how_long(fits):
    """All pixels together are decided long before the tile with the highlight is."""
    file, gate = scene_file("sphere"), "image.environment_lights"
    parameters = {"btf": str(fits.path("lpca")), "lights": "envmap", "environment": "studio"}
    shared = {"parameters": parameters, "size": (24, 24), "grid": 2, "shadows": False}
    mask = np.ones((24, 24), bool)
    found = converged(file, mask, gate=gate, **shared)
    assert found.meta["noise_ratio"] <= 1
    relative = found.variance / found.image.mean() ** 2
    widest = tile_half_widths(relative, mask, significance=tolerance(f"{gate}.significance")).max()
    assert widest <= tolerance("reference.tile_half_width") * tolerance(f"{gate}.relative_tile_bias")
    # The first round alone does not tell.
    first = converged(file, mask, gate=gate, most=1, **shared)
    assert first.meta["noise_ratio"] > 1
