"""What is small and bright leaves the filtered maps: exact bookkeeping, and an estimate that says when it is needed."""

import numpy as np
import pytest

from btfref.gates import tolerance
from btfref.rendering.environment_light.split_light import MOST, TARGET, split_light
from btfref.scene.environment import Environment, bright_texel, cell_angles, constant
from btfref.scene.environments import studio

pytestmark = pytest.mark.usefixtures("coarse_environments")

#: Cosine of the outermost ring of the usual 81 directions.
EDGE = np.cos(np.radians(75))
POWER = tolerance("split_light.power")


def sun_and_sky():
    """Blue above a horizon, with a red sun of a texel that has more power than all else."""
    picture = np.full((32, 64, 3), 0.05, np.float32)
    picture[:16] = [0.3, 0.4, 0.6]
    picture[6, 20] = [3000, 2000, 1000]
    return Environment(picture)


@pytest.mark.parametrize("cosine", [False, True])
@pytest.mark.parametrize(
    ("environment", "least", "most"),
    [
        (sun_and_sky(), 1, 4),
        (bright_texel([0.2, 0.4, 0.6], background=0.01), 1, 4),
        (studio(shape=(32, 64)), 0, MOST),
    ],
    ids=["sun", "texel", "studio"],
)
def test_nothing_is_lost_and_the_target_is_reached(environment, least, most, cosine):
    w, power = environment.cells()
    found = split_light(environment, EDGE, cosine=cosine)
    assert found.lights.error <= TARGET
    assert least <= len(found.lights) <= most
    rest = found.rest.power
    np.testing.assert_array_equal(found.rest.w, w)
    assert (rest >= 0).all()
    assert (rest <= power).all()
    # All channels and cells: what stays and what is taken.
    np.testing.assert_allclose(rest.sum(0) + found.lights.power.sum(0), power.sum(0), rtol=POWER)
    # Colours stay what they are.
    some = power[:, 0] > 0
    np.testing.assert_allclose(
        rest[some, 2] / rest[some, 0], power[some, 2] / power[some, 0], rtol=tolerance("split_light.colour")
    )
    again = split_light(environment, EDGE, cosine=cosine)
    assert again.lights.table().tobytes() == found.lights.table().tobytes()


def test_the_sun_leaves_a_sky():
    environment = sun_and_sky()
    w, power = environment.cells()
    found = split_light(environment, EDGE, cosine=False)
    sun = w[power.sum(1).argmax()]
    assert (found.lights.w @ sun > np.cos(np.radians(6))).all()
    sky = 2 * np.pi * 1.3
    assert found.lights.power.sum() > tolerance("split_light.sun.min_taken") * (power.sum() - sky)
    # What is left has no sun: its brightest cell is a small part of the sun's.
    left, whole = ((p.sum(1) / cell_angles()).max() for p in (found.rest.power, power))
    assert left < tolerance("split_light.sun.left") * whole


def test_broad_light_is_filtered_as_a_whole():
    for environment in (constant(), Environment(np.zeros((4, 8, 3), np.float32))):
        found = split_light(environment, EDGE, cosine=False)
        assert len(found.lights) == 0
        assert found.lights.error <= TARGET
        np.testing.assert_array_equal(found.rest.power, environment.cells()[1])
        # Shaders find a black light.
        assert found.lights.table().shape == (1, 2, 4)
        assert not found.lights.table().any()


def test_angles_of_cells_fill_the_sphere():
    np.testing.assert_allclose(cell_angles(16).sum(), 4 * np.pi, rtol=POWER)
    power = constant().cells(16)[1]
    np.testing.assert_allclose(power[:, 0], cell_angles(16), rtol=POWER)


def test_the_estimate_knows_what_lights_are_for():
    """Without its lights a sun is an error of many percent, and fewer than needed are worse."""
    environment = sun_and_sky()
    whole = split_light(environment, EDGE, cosine=False, target=1.0)
    assert len(whole.lights) == 0
    assert whole.lights.error > 4 * TARGET
    # The cosine that Lafortune's lobes hold hides the horizon.
    hidden = split_light(environment, EDGE, cosine=True, target=1.0)
    assert hidden.lights.error < tolerance("split_light.horizon") * whole.lights.error
    few = split_light(studio(shape=(32, 64)), EDGE, cosine=False, most=2)
    assert len(few.lights) == 2
    assert few.lights.error > TARGET
