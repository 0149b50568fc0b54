"""Under radiance 1 from everywhere a picture is its own albedo: every method, three scenes, against quadrature.

The albedo of a method with levels of detail is that of what a pixel shows: the integral over the hemisphere of the B
that the sample's footprint filters, with its level and its probes along the footprint, and not the finest level's.
"""

from functools import partial

import numpy as np
import pytest

from btfref.conventions import PixelClass
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.registry import methods
from btfref.rendering.environment_light.lighting import Lighting
from btfref.rendering.environment_light.prepared import Prepared
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.approximate import approximate
from btfref.scene import environment
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("renderers", "coarse_environments")

SIZE = (20, 20)
SCENES = ("plane", "sphere", "cloth")

#: Lights of the constant environment, a rule of the second order with steps of 3 degrees, and the quadrature's nodes.
#: Height fields cast shadows with sharp edges, which any rule finds at the rate of its steps only: both are finer.
LIGHTS, NODES = 4096, (48, 96)
FINER = {"gbrdf": (1 << 14, (160, 320))}

#: One in so many of the picture's points is integrated: a sphere has many pixels that gates look at, a plane has few.
EVERY = {"plane": 2, "sphere": 9, "cloth": 3}

#: Points that are integrated at a time.
STEP = 16

#: In the default run: the method that has levels of detail.
QUICK = {"laplacian"}

CELLS = [
    pytest.param(
        key,
        scene,
        marks=[] if key in QUICK else [pytest.mark.long],
        id=f"{key}-{scene}",
    )
    for key in methods()
    for scene in SCENES
]


def albedo(every, nodes, uv, w_view, to_world, evaluate=None, place=None):
    """The integral of B over the hemisphere of the light, as of :class:`Prepared`; NaN where it is not computed."""
    w, weight = gauss_hemisphere(*nodes)
    result = np.full((len(uv), 3), np.nan)
    some = np.arange(0, len(uv), every)
    for first in range(0, len(some), STEP):
        at = some[first : first + STEP]
        point, light = np.repeat(at, len(w)), np.tile(np.arange(len(w)), len(at))
        value = evaluate(uv[point], w[light], w_view[point], point).reshape(len(at), len(w), 3)
        result[at] = np.einsum("l,nlc->nc", weight, value)
    return result


@pytest.mark.parametrize(("key", "scene"), CELLS)
def test_a_constant_environment_shows_the_albedo(fits, monkeypatch, key, scene):
    parameters = {"btf": str(fits.path(key)), "lights": "constant"}
    settings = {"parameters": parameters, "grid": 1, "size": SIZE}
    file = scene_file(scene)
    lights, nodes = FINER.get(key, (LIGHTS, NODES))
    if key in FINER:
        # The coarse environment has fewer cells than that.
        monkeypatch.setattr(environment, "CELL_ROWS", 2 * environment.CELL_ROWS)
    image = realtime(file, environment="lights", lights=lights, **settings)
    assert image.meta["environment_lights"] == lights
    monkeypatch.setattr(
        Lighting,
        "prepared",
        lambda *_, **__: Prepared("lights", "", {}, partial(albedo, EVERY[scene], nodes)),
    )
    exact = approximate(file, path="lights", **settings).image
    inside = (pixel_classes(file, **settings) == PixelClass.INTERIOR) & np.isfinite(exact).all(-1)
    assert inside.sum() > 8
    assert exact[inside].min() > 0
    difference = np.abs(image.image - exact)[inside].max()
    assert difference <= tolerance("environment.furnace.max") * exact[inside].max(), (
        difference / exact[inside].max()
    )


def test_levels_have_albedos_of_their_own(fits, monkeypatch):
    """What the finest level reflects is not what a distant pixel must show: the test above can tell them apart."""
    parameters = {"btf": str(fits.path("laplacian")), "lights": "constant", "tiling": "16"}
    settings = {"parameters": parameters, "grid": 1, "size": SIZE, "path": "lights"}
    file = scene_file("plane")
    monkeypatch.setattr(
        Lighting, "prepared", lambda *_, **__: Prepared("lights", "", {}, partial(albedo, 16, NODES))
    )
    filtered = approximate(file, **settings).image
    inside = np.isfinite(filtered).all(-1)
    rep = fits("laplacian")
    finest = lambda uv, w_light, w_view, _: rep.evaluate(uv, w_light, w_view)  # noqa: E731
    fine = lambda uv, w_view, to_world, **_: albedo(16, NODES, uv, w_view, to_world, finest)  # noqa: E731
    monkeypatch.setattr(Lighting, "prepared", lambda *_, **__: Prepared("lights", "", {}, fine))
    difference = np.abs(approximate(file, **settings).image - filtered)[inside].max()
    assert difference > 10 * tolerance("environment.furnace.max") * filtered[inside].max()
