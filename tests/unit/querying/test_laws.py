"""Laws of queries: what is drawn follows the density that is stored, whichever rows are asked for together."""

import numpy as np
import pytest
from scipy import stats

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.querying.laws import RadiusLaw, laws
from btfref.querying.settings import QuerySettings

PAIRS = [
    ("uniform", "uniform"),
    ("cosine", "grazing"),
    ("grazing", "cosine"),
    ("halfdiff", "halfdiff"),
]


def cells(rows, least_z, n=(4, 4, 6)):
    """Cell of each row in cos θ_light, cos θ_view and azimuth between them, and the volume of a cell."""
    light, view = (rows[name].astype(float) for name in ("w_light", "w_view"))
    azimuth = [np.arctan2(w[:, 1], w[:, 0]) for w in (light, view)]
    z = [np.clip((w[:, 2] - least_z) / (1 - least_z), 0, 1 - 1e-9) for w in (light, view)]
    phi = np.mod(azimuth[0] - azimuth[1], 2 * np.pi) / (2 * np.pi)
    index = [np.minimum((x * k).astype(int), k - 1) for x, k in zip((*z, phi), n, strict=True)]
    return np.ravel_multi_index(index, n), (2 * np.pi * (1 - least_z)) ** 2 / np.prod(n), int(np.prod(n))


def chi_square(rows, least_z, factor=1.0):
    """p-value of Σ z² over cells: 1 / density, summed over a cell's rows, estimates the cell's volume."""
    cell, volume, n = cells(rows, least_z)
    weight = factor / rows["density"].astype(float)
    count = len(weight)
    mean = np.bincount(cell, weight, n) / count
    square = np.bincount(cell, weight**2, n) / count
    z = (mean - volume) / np.sqrt((square - mean**2) / count)
    return stats.chi2.sf((z**2).sum(), n)


@pytest.mark.parametrize(("light", "view"), PAIRS)
@pytest.mark.parametrize("max_theta", [90, 80])
def test_densities_of_pairs_are_those_of_the_rows(light, view, max_theta):
    law = laws(light, view, "0", max_theta=max_theta)
    rows = law.rows(7, 0, 60_000)
    assert chi_square(rows, law.least_z) > tolerance("queries.law.significance")
    for name in ("w_light", "w_view"):
        w = rows[name].astype(float)
        assert np.abs(np.linalg.norm(w, axis=1) - 1).max() <= tolerance("queries.rounding.length")
        assert w[:, 2].min() > 0
        assert w[:, 2].min() >= law.least_z - tolerance("queries.rounding.length")


def test_a_wrong_density_is_found():
    law = laws("cosine", "uniform", "0")
    rows = law.rows(7, 0, 60_000)
    rows["density"] = rows["density"] * np.where(rows["w_light"][:, 2] > 0.5, 1.05, 1)
    assert chi_square(rows, 0.0) < tolerance("queries.law.significance")


@pytest.mark.parametrize(("law", "power"), [("uniform", 1), ("cosine", 2), ("grazing", 0.5)])
def test_cosines_follow_their_power(law, power):
    z = laws(law, law, "0").rows(3, 0, 20_000)["w_light"][:, 2].astype(float)
    assert stats.kstest(z**power, "uniform").pvalue > tolerance("queries.law.significance")


def test_half_of_grazing_directions_lie_beyond_75_degrees():
    z = laws("grazing", "uniform", "0").rows(1, 0, 10_000)["w_light"][:, 2]
    beyond = int((z < np.cos(np.radians(75.522488))).sum())
    assert stats.binomtest(beyond, len(z)).pvalue > tolerance("queries.law.significance")


def test_sets_are_drawn_evenly():
    law = laws("10x5", np.array([[0, 0, 1.0]]), "0")
    rows = law.rows(2, 0, 20_000)
    _, counts = np.unique(rows["w_light"], axis=0, return_counts=True)
    assert len(counts) == 50
    assert stats.chisquare(counts).pvalue > tolerance("queries.law.significance")
    assert np.allclose(rows["density"], np.float32(1 / 50), rtol=0, atol=0)


def test_radii_follow_their_laws():
    u = np.random.default_rng(5).random(20_000)
    radius, density = RadiusLaw.of("levels:0.01:1,2,1").sample(u)
    values, counts = np.unique(radius, return_counts=True)
    assert values.tolist() == [0.01, 0.02, 0.04]
    assert stats.chisquare(counts, np.array([0.25, 0.5, 0.25]) * len(u)).pvalue > tolerance(
        "queries.law.significance"
    )
    assert density[radius == 0.02].tolist() == [0.5] * counts[1]
    radius, density = RadiusLaw.of("log:0.001:0.1").sample(u)
    assert stats.kstest(np.log(radius / 0.001) / np.log(100), "uniform").pvalue > tolerance(
        "queries.law.significance"
    )
    # 1 / density estimates the length of the range.
    weight = 1 / density
    z = (weight.mean() - 0.099) / (weight.std() / np.sqrt(len(u)))
    assert 2 * stats.norm.sf(abs(z)) > tolerance("queries.law.significance")
    assert RadiusLaw.of(0.25).sample(u)[0].tolist() == [0.25] * len(u)


@pytest.mark.parametrize(
    ("law", "more"), [("halfdiff", {}), ("halfdiff", {"picture": (4, 8)}), ("cosine", {"lights": 3})]
)
def test_rows_do_not_depend_on_those_beside_them(law, more):
    law = laws(law, law, "log:0.001:0.1", **more)
    whole, part = law.rows(11, 0, 4096), law.rows(11, 1003, 77)
    other = law.rows(12, 1003, 77)
    for name, values in part.items():
        assert np.array_equal(values, whole[name][1003:1080])
        assert name in ("uv", "density") or not np.array_equal(values, other[name])


def test_a_picture_has_one_pair_of_directions_and_all_its_texels():
    rows = laws("cosine", "uniform", "0", picture=(2, 3)).rows(0, 0, 12)
    for name in ("w_light", "w_view"):
        pictures = rows[name].reshape(2, 6, 3)
        assert (pictures == pictures[:, :1]).all()
        assert not np.array_equal(pictures[0, 0], pictures[1, 0])
    u, v = rows["uv"][:6].T
    assert np.array_equal(u, np.float32(np.tile((np.arange(3) + 0.5) / 3, 2)))
    assert np.array_equal(v, np.float32(np.repeat((np.arange(2) + 0.5) / 2, 3)))


@pytest.mark.parametrize("light", ["cosine", "10x5"])
def test_lights_of_a_path_have_their_own_law_and_all_else_in_common(light):
    rows = laws(light, "grazing", "log:0.001:0.1", lights=4).rows(5, 0, 4000)
    for name in ("uv", "radius", "w_view", "w_light"):
        groups = rows[name].reshape(1000, 4, -1)
        assert (groups == groups[:, :1]).all() == (name != "w_light")
        assert len(np.unique(groups[:, 0], axis=0)) > (40 if name == "w_light" else 990)
    single = laws(light, "grazing", "log:0.001:0.1").rows(5, 0, 4000)
    assert np.array_equal(rows["w_light"], single["w_light"])


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"n": 0}, "n"),
        ({"n": 1.5}, "n"),
        ({"light": "halfdiff"}, "both"),
        ({"light": "sideways"}, "light"),
        ({"view": [[0, 0, -1.0]]}, "view"),
        ({"view": [[0, 0, 0.0]]}, "view"),
        ({"view": [0, 0, 1.0]}, "view"),
        ({"radius": "-1"}, "radius"),
        ({"radius": "levels:0.1"}, "radius"),
        ({"radius": "log:0.2:0.1"}, "radius"),
        ({"radius": "log:0:0.1"}, "radius"),
        ({"footprint": "hexagon"}, "footprint"),
        ({"max_theta": 0}, "max_theta"),
        ({"max_theta": 91}, "max_theta"),
        ({"spp": 0}, "spp"),
        ({"target_error": 0}, "target_error"),
        ({"target_error": 0.1, "spp": 4}, "spp"),
        ({"picture": 3, "n": 10}, "multiple of 9"),
        ({"picture": (3, 3, 3)}, "picture"),
        ({"max_depth": 1}, "max_depth"),
        ({"lights_per_path": 0}, "lights_per_path"),
        ({"lights_per_path": 2, "light": "halfdiff", "view": "halfdiff"}, "lights_per_path"),
        ({"lights_per_path": 2, "picture": 2, "n": 8}, "lights_per_path"),
        ({"lights_per_path": 2, "target_error": 0.1}, "target_error"),
        ({"seed": -1}, "seed"),
    ],
)
def test_settings_that_cannot_be_used(settings, word):
    with pytest.raises(InputError, match=word):
        QuerySettings(**settings)
