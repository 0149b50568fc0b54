"""Energy of all modelled mesostructures: none sends out more light than comes in, and each sends out some."""

import numpy as np
import pytest

from btfref.gates.tolerances import tolerance
from btfref.mesostructure import FROM_FILES, MESOSTRUCTURES, build
from btfref.numerics.sphere.directions import spherical
from btfref.querying.job import QueryJob
from btfref.querying.settings import QuerySettings
from btfref.sampling.variant import mitsuba_variant

pytestmark = pytest.mark.usefixtures("llvm")

#: Polar angles of the lights, and rows of each.
THETA, ROWS = np.radians([10.0, 50.0, 80.0]), 4096

MODELLED = sorted(set(MESOSTRUCTURES) - set(FROM_FILES) - {"flat"})


def reflected(tile, theta):
    """Share of a light that leaves, ∫ B cos θ_v dω_v / cos θ_l, and its standard error, (3,) each."""
    rng = np.random.default_rng(1)
    cosine = np.sqrt(1 - rng.random(ROWS))
    views = spherical(np.arccos(cosine), 2 * np.pi * rng.random(ROWS))
    light = spherical(theta, 1.0)
    rows = {
        "uv": rng.random((ROWS, 2)),
        "radius": np.zeros(ROWS),
        "w_light": np.broadcast_to(light, (ROWS, 3)),
        "w_view": views,
    }
    with mitsuba_variant("llvm_ad_rgb"):
        paths = QueryJob(tile, QuerySettings(n=ROWS, spp=4)).make_source().paths
        found = paths.samples({k: np.float32(v) for k, v in rows.items()}, np.arange(ROWS), 4)[0]
    share = np.pi * found.astype(float) / light[2]
    return share.mean(0), share.std(0, ddof=1) / np.sqrt(ROWS)


@pytest.mark.long
@pytest.mark.parametrize("name", MODELLED)
def test_no_more_light_leaves_than_comes(name):
    tile = build(name)
    for theta in THETA:
        share, error = reflected(tile, theta)
        assert (share - tolerance("modelled.energy.standard_errors") * error <= 1).all()
        assert (share > 0).all()


def test_a_white_plane_sends_everything_back():
    """Rationale: the check above says nothing if what it measures is too small. Expected: 1, of albedo one."""
    for theta in THETA:
        share, error = reflected(build("flat", reflectance=1.0), theta)
        assert (
            np.abs(share - 1)
            <= error * tolerance("modelled.energy.standard_errors") + tolerance("queries.flat.relative")
        ).all()
