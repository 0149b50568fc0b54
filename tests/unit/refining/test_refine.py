"""Refinement: nearer to true values, never farther; ranges kept; the file says what was done."""

import json

import numpy as np
import pytest
from oracle import oracle_btf
from probes import hemisphere

import btfref
from btfref.cli import main
from btfref.comparison.colour import ciede2000, lab
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.images import save_image
from btfref.refining import energy
from btfref.refining.energy import largest_albedo
from btfref.refining.losses import LOSSES
from btfref.refining.variables import Variables

#: Few lobes: the derivative's kernel is compiled sooner, and is no other code.
STEPS = 40

#: By which the truth is brighter than the start.
BRIGHTER = 1.3


@pytest.fixture(scope="module")
def btf():
    return oracle_btf((8, 6))


@pytest.fixture(scope="module")
def start(btf):
    return btfref.fit("lafortune", btf, lobes=1)


@pytest.fixture(scope="module")
def rows(start):
    """True values that the maps can meet: their own, brighter."""
    rng = np.random.default_rng(5)
    n = 4000
    found = {"uv": rng.random((n, 2)), "w_light": hemisphere(rng, n), "w_view": hemisphere(rng, n)}
    found["B"] = BRIGHTER * start.evaluate(*found.values())
    return found


@pytest.fixture(scope="module")
def refined(start, rows, need):
    need("llvm")
    return btfref.refine(start, rows, loss="log", steps=STEPS, batch=2000)


def test_it_is_nearer_and_says_so(start, refined, rows):
    facts = refined.meta["refined"][0]
    assert facts["after"] <= tolerance("refine.example.left") * facts["before"]
    assert facts["steps_taken"] == STEPS
    assert facts["history"][0] == [0, facts["before"]]
    assert (facts["loss"], facts["data"], facts["rows"] + facts["held_out"]) == ("log", "rows", 4000)
    json.dumps(refined.meta)
    errors = [np.abs(made.evaluate(*list(rows.values())[:3]) - rows["B"]).mean() for made in (start, refined)]
    assert errors[1] < errors[0]
    assert "refined" not in start.meta


def test_types_and_ranges_are_kept(start, refined):
    for name, array in refined.arrays().items():
        was = start.arrays()[name]
        assert (array.dtype, array.shape) == (was.dtype, was.shape)
    lobes = refined.arrays()["lobes"].astype(float)
    assert np.abs(lobes[..., :3]).max() <= 1
    assert lobes[..., 3].min() >= min(1.0, start.arrays()["lobes"][..., 3].min())
    assert lobes[..., 3].max() <= start.arrays()["lobes"][..., 3].max()
    assert refined.arrays()["peaks"].min() >= 0
    assert refined.arrays()["colour"].min() >= 0
    limit = max(1.0, largest_albedo(start)) * (1 + tolerance("refine.energy.above"))
    assert largest_albedo(refined) <= limit


def test_rows_that_reflect_more_than_falls_on_them_are_followed_as_far_as_energy_allows(start, rows, need):
    need("llvm")
    factor = 2 / largest_albedo(start)
    made = btfref.refine(
        start, rows | {"B": factor * rows["B"]}, loss="log", steps=STEPS, batch=2000, rate=0.05
    )
    facts = made.meta["refined"][0]
    assert largest_albedo(start) < largest_albedo(made) <= 1 + tolerance("refine.energy.above")
    assert 0 < facts["share"] <= 1
    assert facts["after"] < facts["before"]


def test_what_is_reflected_beyond_a_limit_is_that_of_the_definition(start, need):
    need("llvm")
    variables = Variables(start)
    variables.put(variables.zeros())
    limit = largest_albedo(start) / 2
    found = float(energy.excess(variables, limit, np.random.default_rng(3))[0])
    rng = np.random.default_rng(3)
    light, weight = energy.gauss_hemisphere(*energy.RULE)
    uv, view = rng.random((energy.PLACES, 1, 2)), energy._views(rng, energy.PLACES)[:, None]
    albedo = np.einsum("nlc,l->nc", start.evaluate(uv, light[None], view), weight)
    expected = (np.maximum(albedo / limit - energy.FREE, 0) ** 2).sum(-1).mean()
    assert expected > 0
    np.testing.assert_allclose(found, expected, rtol=tolerance("probe.agreement.max"))
    # The start itself is within its own limit.
    assert float(energy.excess(variables, 10 * limit, np.random.default_rng(3))[0]) == 0


def test_what_gets_worse_is_not_taken(start, rows):
    """Steps as large as the maps themselves lead nowhere: the start comes back."""
    made = btfref.refine(start, rows | {"B": rows["B"] / BRIGHTER}, steps=1, rate=1.0)
    facts = made.meta["refined"][0]
    assert (facts["share"], facts["after"]) == (0.0, facts["before"])
    for name, array in made.arrays().items():
        np.testing.assert_array_equal(array, start.arrays()[name])


def test_some_maps_alone(start, rows):
    made = btfref.refine(start, rows, steps=3, maps=["colour"])
    assert (made.arrays()["colour"] != start.arrays()["colour"]).any()
    np.testing.assert_array_equal(made.arrays()["lobes"], start.arrays()["lobes"])


def test_a_sampled_btf_and_the_command(btf, start, tmp_path, need, capsys):
    need("llvm")
    btfref.save(start, tmp_path / "start.exr")
    btf.save(tmp_path / "data.btf.zarr")
    files = [str(tmp_path / name) for name in ("start.exr", "data.btf.zarr", "out.exr")]
    command = ["refine", files[0], "--to", files[1], "-o", files[2], "--steps", "2", "--json"]
    assert main(command) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["data"] == "data.btf.zarr"
    assert btfref.load(files[2]).meta["refined"] == [facts]


@pytest.mark.long
def test_a_picture(start, tmp_path, need):
    """Of a scene with a brighter material: its pixels, rendered anew by ``prb``, are followed."""
    need("llvm")
    arrays = {name: array.copy() for name, array in start.arrays().items()}
    arrays["colour"][..., :3] *= np.float16(BRIGHTER)
    bright = type(start).from_arrays(arrays, start.meta)
    btfref.save(bright, tmp_path / "bright.exr")
    shown = {"lights": "directional1"}
    picture = btfref.render(
        "plane", parameters=shown | {"btf": str(tmp_path / "bright.exr")}, size=(12, 12), spp=64
    )
    save_image(tmp_path / "picture.exr", picture.image)
    made = btfref.refine(
        start,
        tmp_path / "picture.exr",
        scene="plane",
        parameters=shown,
        loss="log",
        steps=20,
        maps=["colour"],
    )
    facts = made.meta["refined"][0]
    assert (facts["data"], facts["rows"] + facts["held_out"]) == ("picture.exr", 144)
    assert facts["after"] <= tolerance("refine.picture.left") * facts["before"]


def test_start_values_stay_at_the_start(start, need):
    """Variables that are zero give the maps as they are, within ranges that hold them."""
    need("llvm")
    variables = Variables(start)
    for name, z in variables.held(variables.zeros()).items():
        assert not np.array(z).any(), name
    for name, array in variables.representation(variables.zeros()).arrays().items():
        np.testing.assert_array_equal(array, start.arrays()[name])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"loss": "l1"}, "loss"),
        ({"steps": 0}, "steps"),
        ({"rate": 0.0}, "rate"),
        ({"footprint": "hexagon"}, "footprint"),
        ({"maps": ["cluster"]}, "maps"),
    ],
)
def test_bad_settings_name_the_field(change, field, start, rows, need):
    need("llvm")
    with pytest.raises(InputError, match=f"field '{field}'"):
        btfref.refine(start, rows, **change)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"B": None}, "B"),
        ({"uv": np.zeros((3, 2))}, "uv"),
        ({"w_view": np.full((4000, 3), np.nan)}, "w_view"),
    ],
)
def test_bad_rows_name_the_column(change, field, start, rows, need):
    need("llvm")
    with pytest.raises(InputError, match=f"field '{field}'"):
        btfref.refine(start, rows | change)


def test_losses_are_zero_for_the_truth_and_that_of_colours_is_near_ciede2000(llvm, rng):
    from btfref.numerics.device_arrays import to_device

    truth = rng.uniform(0.02, 0.25, (500, 3))
    value = truth * rng.uniform(0.95, 1.05, truth.shape)
    on_device = [to_device(llvm.Color3f, a.T) for a in (truth, value)]
    for name, loss in LOSSES.items():
        assert np.abs(np.array(loss(on_device[0], on_device[0], 0.1))).max() <= tolerance(
            "refine.zero.max"
        ), name
    found = np.sqrt(np.array(loss_of_colours(on_device)))
    expected = ciede2000(lab(np.pi * truth), lab(np.pi * value))
    assert np.corrcoef(found, expected)[0, 1] >= tolerance("refine.delta_e.min_correlation")


def loss_of_colours(pair):
    return LOSSES["delta_e"](pair[1], pair[0], 0.1)
