"""Errors beyond what the rounding of texture coordinates accounts for: few pixels, and never the largest error."""

import numpy as np
import pytest

from btfref import representations
from btfref.comparison import compare
from btfref.gates import tolerance
from btfref.rendering.offline import rounding
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.rounding import rounding_of, uv_rounding

GATE = "image.noise_free"
LIMIT = tolerance(f"{GATE}.p999")


def pictures(count, error):
    """A picture of ones, and one in which some pixels are off by an error."""
    reference = np.ones((40, 40, 3))
    test = reference.copy()
    test.reshape(-1, 3)[:count] += error
    return test, reference


def failed(test, reference, moves):
    asked = []

    def measure(pixels):
        asked.append(int(pixels.sum()))
        return np.where(pixels[..., None], moves, 0.0) * np.ones(3)

    gates = compare(test, reference, gate=GATE, flip=False, rounding=measure).gates
    return {gate.name.rpartition(".")[2] for gate in gates if not gate.passed}, asked


def test_what_rounding_explains_is_taken_off_where_it_is_asked():
    assert failed(*pictures(5, 3 * LIMIT), moves=2.5 * LIMIT) == (set(), [5])
    assert failed(*pictures(5, -3 * LIMIT), moves=2.5 * LIMIT) == (set(), [5])
    assert failed(*pictures(5, 3 * LIMIT), moves=1.5 * LIMIT) == ({"p999"}, [5])
    assert failed(*pictures(5, 0.5 * LIMIT), moves=0.0) == (set(), [])


def test_the_largest_error_is_never_excused():
    most = tolerance(f"{GATE}.max")
    assert failed(*pictures(5, 2 * most), moves=10 * most)[0] == {"max"}


def test_many_pixels_are_no_rounding():
    assert failed(*pictures(400, 3 * LIMIT), moves=1.0) == ({"p999"}, [])


class Moved:
    """A representation whose texture lies elsewhere, the further the more it is seen from the side."""

    def __init__(self, of, step):
        self.of, self.step = of, np.asarray(step)

    def __getattr__(self, name):
        return getattr(self.of, name)

    def evaluate(self, uv, w_light, w_view, **settings):
        far = self.step / np.maximum(w_view[:, 2:], rounding.GRAZING)
        return self.of.evaluate(uv + far, w_light, w_view, **settings)


@pytest.fixture
def scene(fits):
    return {
        "parameters": {"btf": str(fits.path("lafortune")), "lights": "directional3", "tiling": "2"},
        "size": (8, 8),
    }


@pytest.mark.parametrize(
    ("lit_by", "way"), [("directional3", {}), ("envmap", {"path": "lights", "lights": 12})]
)
def test_it_is_the_largest_change_of_the_picture_within_a_step(scene, lit_by, way, monkeypatch, llvm):
    step = 1e-3
    monkeypatch.setattr(rounding, "ROUNDING", step)
    scene["parameters"] |= {"lights": lit_by} | ({"environment": "studio"} if way else {})
    found = uv_rounding("plane", np.full((8, 8), True), grid=1, **scene, **way)
    table = representations.load(scene["parameters"]["btf"])

    def picture(u, v):
        # The texture is repeated twice: a step of the plane is two of the texture.
        moved = Moved(table, (2 * step * u, 2 * step * v))
        return approximate("plane", grid=1, load_file=lambda file: moved, **scene, **way).image.astype(float)

    there = picture(0, 0)
    changes = [abs(picture(*by) - there) for by in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    assert found.max() > 0
    # Pictures are float32.
    single = tolerance("image.lambert.max") * there.max()
    np.testing.assert_allclose(found, np.max(changes, 0), rtol=0, atol=single)


def test_a_wrong_factor_is_no_rounding(scene, llvm):
    image = approximate("plane", grid=2, **scene).image.astype(float)
    bright = np.argsort(-image.max(-1), axis=None)[:6]
    wrong = image.copy()
    wrong.reshape(-1, 3)[bright] *= 1 + 3 * LIMIT
    gates = compare(wrong, image, gate=GATE, flip=False, rounding=rounding_of("plane", grid=2, **scene)).gates
    assert {gate.name for gate in gates if not gate.passed} == {f"{GATE}.p999"}
