"""Queries of geometry against closed forms, plain Mitsuba renders that share no code, and themselves."""

import numpy as np
import pytest
from plain_renders import PlainRenders
from scipy import stats
from stores import contents

import btfref
from btfref.comparison.significance import difference_test, welch_test
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import Mesostructure, build
from btfref.mesostructure.base import square_below
from btfref.numerics.sphere.directions import spherical
from btfref.querying import QuerySettings, query_file
from btfref.querying.files import zarr_file
from btfref.querying.job import QueryJob
from btfref.sampling.synthesis import synthesize
from btfref.sampling.variant import mitsuba_variant

pytestmark = pytest.mark.usefixtures("llvm")


def test_a_lambertian_plane_has_its_closed_form():
    rho = np.array([0.2, 0.5, 1.0])
    rows = next(btfref.queries("flat", n=500, spp=3, radius=0.1, reflectance=rho.tolist()))
    expected = rho / np.pi * rows["w_light"][:, 2:].astype(float)
    limit = tolerance("queries.flat.relative")
    assert (np.abs(rows["B"] - expected) <= limit * expected).all()
    assert (rows["variance"] <= (limit * expected) ** 2).all()
    assert (rows["samples"] == 3).all()


def answers(tile, rows, count, stream=0, **settings):
    """Mean and variance of given rows."""
    with mitsuba_variant("llvm_ad_rgb"):
        paths = QueryJob(tile, QuerySettings(spp=count, **settings)).make_source(stream).paths
        return paths.samples(rows, np.arange(len(rows["uv"])), count)


def texels(n, w_light, w_view):
    """Rows whose footprints are the texels of a tile."""
    v, u = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    uv = np.stack([u, v], -1).reshape(-1, 2)
    rows = {
        "uv": uv,
        "radius": np.full(n * n, 0.5 / n),
        "w_light": np.tile(w_light, (n * n, 1)),
        "w_view": np.tile(w_view, (n * n, 1)),
    }
    return {name: np.float32(values) for name, values in rows.items()}


@pytest.mark.parametrize(
    ("name", "pairs"),
    [
        ("checker", 2),
        *(pytest.param(name, 10, marks=pytest.mark.long) for name in ("checker", "rings", "tissue")),
    ],
)
def test_rows_agree_with_plain_renders(llvm, name, pairs):
    """Texels as square footprints, at pairs of directions on no grid; every second one is oblique."""
    tile = build(name, **({"resolution": 32} if name == "checker" else {}))
    rng = np.random.default_rng(17)
    counts = {"spp": 64, "rounds": 6} if pairs < 10 else {"spp": 512, "rounds": 20}
    plain = PlainRenders(llvm, tile, texels=4, reach=3, max_depth=8)
    p, means = [], []
    for k in range(pairs):
        theta = np.radians([20 + 40 * (k % 2) + 10 * rng.random(), 60 * rng.random()])
        view, light = spherical(theta, 2 * np.pi * rng.random(2))
        rows = texels(4, light, view)
        mean, variance = answers(tile, rows, counts["spp"] * counts["rounds"], footprint="square", seed=k)
        other, spread = plain.pair(view, light, seed=1000 * k, **counts)
        shape = (16, 3)
        scale = other.mean() * tolerance("synthesis.rounding.relative")
        _, found = welch_test(
            mean, variance + scale**2, other.reshape(shape), spread.reshape(shape), n_b=counts["rounds"]
        )
        assert other.mean() > 0
        p.append(found)
        means.append(mean)
    verdict = difference_test(np.array(p), significance=tolerance("queries.z.significance"))
    assert verdict.rejected == 0
    # Values of the pair before are seen to be others.
    _, wrong = welch_test(
        means[-2], variance + scale**2, other.reshape(shape), spread.reshape(shape), n_b=counts["rounds"]
    )
    assert difference_test(wrong, significance=tolerance("queries.z.significance")).rejected > 0


def test_rows_agree_with_the_grid_of_a_synthesis():
    lights = spherical(np.radians([10, 50, 70]), np.array([0, 1.0, 4.0]))
    view = lights[2]
    btf = synthesize(
        "checker", texels=4, views=lights, lights=lights, spp=512, dtype="float32", seed=5, resolution=32
    )
    p = []
    for k, light in enumerate(lights):
        mean, variance = answers(
            build("checker", resolution=32), texels(4, light, view), 512, footprint="square", seed=2
        )
        expected, spread = (a[2, k].reshape(16, 3) for a in (btf.values, btf.variance))
        floor = (expected.mean() * tolerance("synthesis.rounding.relative")) ** 2
        p.append(welch_test(mean, variance + floor, expected, spread + floor)[1])
    verdict = difference_test(np.array(p), significance=tolerance("queries.z.significance"))
    assert verdict.rejected == 0


def test_variances_are_those_of_the_rows():
    """Two independent answers to the same rows differ by what their variances say."""
    tile = build("checker", resolution=32)
    settings = {"radius": "0.05", "max_theta": 80.0, "n": 600}
    rows = QuerySettings(**settings).laws.rows(0, 0, 600)
    (a, va), (b, vb) = (answers(tile, rows, 64, stream, **settings) for stream in (0, 1))
    noisy = va + vb > 0
    z = (a - b)[noisy].astype(float) / np.sqrt((va + vb)[noisy])
    assert noisy.mean() > tolerance("synthesis.seen.min_noisy")
    assert tolerance("queries.z.min_median") <= np.median(np.abs(z)) <= tolerance("queries.z.median")
    # In the mean over all rows nothing is left of it.
    total = (a.astype(float) - b).mean(-1)
    score = total.mean() / (total.std() / np.sqrt(len(total)))
    assert 2 * stats.norm.sf(abs(score)) > tolerance("queries.law.significance")


def test_all_laws_have_the_same_albedo():
    """∫∫ B over both hemispheres and the tile: the mean of B / density, whatever the rows were drawn from."""
    found = []
    for light, view in (
        ("uniform", "uniform"),
        ("cosine", "grazing"),
        ("grazing", "cosine"),
        ("halfdiff", "halfdiff"),
    ):
        rows = next(
            btfref.queries(
                "checker", n=12_000, batch=12_000, spp=1, light=light, view=view, max_depth=3, resolution=32
            )
        )
        value = (rows["B"].mean(-1) / rows["density"]).astype(float)
        found.append((value.mean(), value.var() / len(value)))
    for k, (mean, variance) in enumerate(found):
        for other, spread in found[:k]:
            p = welch_test(mean, variance, other, spread)[1]
            assert p > tolerance("queries.law.significance"), (k, found)
    assert found[0][0] > 5 * np.sqrt(found[0][1])


def test_lights_of_one_path_see_what_rows_by_themselves_see():
    """In the mean and by their variances; two equal lights of a path see the same."""
    tile = build("checker", resolution=32)
    settings = {"radius": "0.05", "max_theta": 80.0, "n": 400}
    rows = QuerySettings(**settings, lights_per_path=4).laws.rows(0, 0, 400)
    rows["w_light"][3::4] = rows["w_light"][::4]
    (a, va), (b, vb) = (
        answers(tile, rows, 64, stream, lights_per_path=lights, **settings)
        for stream, lights in ((0, 4), (1, 1))
    )
    assert np.array_equal(a[3::4], a[::4])
    assert not np.array_equal(b[3::4], b[::4])
    noisy = va + vb > 0
    z = (a - b)[noisy].astype(float) / np.sqrt((va + vb)[noisy])
    assert noisy.mean() > tolerance("synthesis.seen.min_noisy")
    assert tolerance("queries.z.min_median") <= np.median(np.abs(z)) <= tolerance("queries.z.median")
    total = (a.astype(float) - b).mean(-1).reshape(100, 4).mean(1)
    score = total.mean() / (total.std() / np.sqrt(len(total)))
    assert 2 * stats.norm.sf(abs(score)) > tolerance("queries.law.significance")


@pytest.mark.parametrize("lights", [1, 3])
def test_batches_change_no_row(lights):
    settings = {"n": 120, "spp": 8, "radius": "0.05", "resolution": 16, "lights_per_path": lights}
    (whole,) = btfref.queries("checker", batch=120, **settings)
    parts = list(btfref.queries("checker", batch=50, **settings))
    for name, values in whole.items():
        assert np.array_equal(values, np.concatenate([part[name] for part in parts]))


def test_rows_reach_their_target_error():
    """As a root mean square over the rows; what their pilots missed is not in it."""
    settings = {"n": 400, "radius": "0.02", "max_theta": 70.0, "target_error": 0.1}
    rows = next(btfref.queries("checker", spp=4096, resolution=16, **settings))
    assert len(np.unique(rows["samples"])) > 2
    level = np.maximum(rows["B"].mean(-1), rows["B"].mean() / 10)
    relative = np.sqrt(rows["variance"].mean(-1)) / level
    assert np.sqrt(np.mean(relative**2)) <= settings["target_error"] * tolerance("queries.target.exceeded")


def test_what_transmits_is_traced():
    """A floor under a black mask that lets half of the light through, seen and lit through it."""

    def sheet(floor):
        mask = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
        ground = {"type": "diffuse", "reflectance": floor}
        return Mesostructure("sheet", {}, (square_below(0.0, mask), square_below(-0.1, ground)))

    white, black = (next(btfref.queries(sheet(floor), n=200, spp=256, seed=1)) for floor in (1.0, 0.0))
    # Through the mask to the floor and back: f cos / 4.
    error = white["B"].astype(float).mean(-1) - white["w_light"][:, 2] / (4 * np.pi)
    score = error.sum() / np.sqrt(white["variance"].mean(-1, dtype=float).sum())
    assert 2 * stats.norm.sf(abs(score)) > tolerance("queries.law.significance")
    assert not black["B"].any()


@pytest.mark.long
@pytest.mark.filterwarnings("default")
def test_the_number_of_workers_changes_no_byte(need, tmp_path, monkeypatch):
    need("distributed")
    monkeypatch.setattr(zarr_file, "CHUNK", 500)
    settings = {"n": 4000, "spp": 4, "radius": "0.05", "resolution": 16}
    paths = [tmp_path / f"{k}.queries.zarr" for k in range(3)]
    query_file(paths[0], "checker", **settings)
    for workers in (1, 2):
        query_file(paths[workers], "checker", scheduler="dask", workers=workers, **settings)
        assert contents(paths[workers]) == contents(paths[0])
    assert sorted(p.name for p in tmp_path.iterdir()) == [p.name for p in paths]
