"""Synthesis to a target error: reached, unbiased, honest, resumable, and the same bytes however it is made."""

import numpy as np
import pytest
from stores import contents

from btfref.comparison.significance import welch_test
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import Mesostructure, Part, build
from btfref.sampling import SampledBTF, open_store
from btfref.sampling.paths import adaptive
from btfref.sampling.paths.adaptive import make_plan
from btfref.sampling.store import layout
from btfref.sampling.store.selection import Selection
from btfref.sampling.synthesis import synthesize, synthesize_store

pytestmark = pytest.mark.usefixtures("llvm")

SETTINGS = {"texels": 16, "views": "2x4", "lights": "2x4", "dtype": "float32", "estimator": "path"}


@pytest.fixture(scope="module")
def tile():
    """Diffuse squares of 4 % and 90 % that light each other: noise in some places, none in others."""
    parts = []
    for part, rho in zip(build("checker", resolution=32, smoothness=0.2).parts, (0.9, 0.04), strict=True):
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [rho] * 3}}
        parts.append(Part(part.vertices, part.faces, bsdf, normals=part.normals))
    return Mesostructure("squares", {}, tuple(parts))


@pytest.mark.parametrize(("estimator", "target"), [("path", 0.01), ("surface", 0.025)])
def test_the_target_is_reached_with_honest_variance(tmp_path, tile, estimator, target):
    stores = [
        synthesize_store(
            tmp_path / f"{seed}.btf.zarr",
            tile,
            seed=seed,
            target_error=target,
            **SETTINGS | {"estimator": estimator},
        )
        for seed in (1, 2)
    ]
    (a, va), (b, vb) = (store.read() for store in stores)
    for store, values, variance in ((stores[0], a, va), (stores[1], b, vb)):
        reached = np.sqrt(variance.mean(dtype=np.float64)) / values.mean(dtype=np.float64)
        facts = adaptive.summary(store)
        assert facts["reached"] == pytest.approx(reached, rel=tolerance("synthesis.summary"))
        assert reached <= target * tolerance("synthesis.target.exceeded")
        assert facts["samples"]["least"] < facts["samples"]["mean"] < facts["samples"]["most"]
    # Independent runs, whose allocations differ. Lights and channels share their paths; texels and views do not.
    apart = (a.astype(np.float64) - b).mean((1, 4))
    p = welch_test(apart.mean(), apart.var(ddof=1) / apart.size, 0.0, 0.0)[1]
    assert p > tolerance("synthesis.z.significance")
    noisy = (va + vb) > 0
    z = (a - b)[noisy] / np.sqrt((va + vb)[noisy])
    assert tolerance("synthesis.z.min_median") <= np.median(np.abs(z)) <= tolerance("synthesis.z.median")


def test_samples_go_where_the_variance_is(tile, tmp_path):
    """Fewer samples than a uniform synthesis of the same error, most of them in the noisy texels."""
    store = synthesize_store(tmp_path / "a.btf.zarr", tile, seed=3, target_error=0.01, **SETTINGS)
    facts = adaptive.summary(store)
    uniform = synthesize(tile, seed=4, spp=int(facts["samples"]["mean"]) // 2 * 2, **SETTINGS)
    error = np.sqrt(uniform.variance.mean(dtype=np.float64)) / uniform.values.mean(dtype=np.float64)
    assert facts["reached"] < error
    samples = store.maps("samples")[:]
    noisy = store.maps("pilot")[..., :2].mean(-1)
    correlation = np.corrcoef(np.log(samples).ravel(), np.log(noisy + 1e-12).ravel())[0, 1]
    assert correlation > tolerance("synthesis.seen.min_correlation")


def test_a_limit_per_texel_costs_samples_where_it_is_broken(tmp_path, tile):
    facts, above = [], []
    for limit in (10.0, 0.05):
        store = synthesize_store(
            tmp_path / f"{limit}.btf.zarr", tile, target_error=0.05, texel_error=limit, **SETTINGS
        )
        facts.append(adaptive.summary(store))
        variance, mean = np.moveaxis(store.maps("reached")[:].astype(np.float64), -1, 0)
        above.append(np.mean(np.sqrt(variance) > 0.05 * np.maximum(mean, adaptive.FLOOR * mean.mean())))
    assert facts[1]["samples"]["mean"] > facts[0]["samples"]["mean"]
    assert facts[0]["texels_above"] == 0
    assert facts[1]["texels_above"] == pytest.approx(above[1])
    assert above[1] <= tolerance("synthesis.target.texels_above") < above[0]


@pytest.mark.parametrize("estimator", [pytest.param("path", marks=pytest.mark.long), "surface"])
def test_same_bytes_in_one_go_in_parts_and_in_small_blocks(tmp_path, tile, estimator, monkeypatch):
    settings = SETTINGS | {"target_error": 0.05, "seed": 7, "estimator": estimator}
    whole, parts = tmp_path / "whole.btf.zarr", tmp_path / "parts.btf.zarr"
    synthesize_store(whole, tile, **settings)
    store = synthesize_store(parts, tile, only=Selection(views=(1, 4)), **settings)
    assert store.coverage.any(axis=(1, 2, 3)).sum() == 2
    with pytest.raises(InputError, match="all lights"):
        synthesize_store(parts, tile, only=Selection(lights=(1,)), **settings)
    monkeypatch.setattr("btfref.sampling.paths.estimator.SAMPLE_BUFFER", 300_000)
    seen = []
    synthesize_store(parts, tile, progress=lambda *call: seen.append(call), **settings)
    assert seen == [(k, 8, "synthesis") for k in range(3, 9)]  # the pilot was kept
    assert contents(whole) == contents(parts)
    memory = synthesize(tile, **settings)
    assert np.array_equal(memory.values, SampledBTF.load(whole).values)


def test_tiles_are_resumed(tmp_path, tile, monkeypatch):
    """Views of several files: an interruption between two of them loses one file at most."""
    monkeypatch.setattr(layout, "SHARD", 12 * 64 * 64 * 8 * 2)
    settings = {"texels": 192, "views": [[0, 0, 1.0]], "lights": "2x4", "spp": 2, "max_depth": 2}
    settings |= {"estimator": "path"}
    whole = synthesize_store(tmp_path / "whole.btf.zarr", tile, **settings)
    assert whole.shard == (1, 2)
    killed = tmp_path / "killed.btf.zarr"

    class StopError(Exception):
        pass

    calls = []
    write = type(whole).write_part

    def stopping(self, *args, **keywords):
        write(self, *args, **keywords)
        calls.append(args)
        if len(calls) == 3:
            raise StopError

    monkeypatch.setattr(type(whole), "write_part", stopping)
    with pytest.raises(StopError):
        synthesize_store(killed, tile, **settings)
    assert open_store(killed).coverage[0, 0].sum() == 5
    synthesize_store(killed, tile, **settings)
    assert len(calls) == 6
    assert contents(tmp_path / "whole.btf.zarr") == contents(killed)


def test_an_allocation_meets_its_prediction():
    """Known variances: the goal is met to the steps of the ladder, with far fewer samples than everywhere alike."""
    rng = np.random.default_rng(0)
    pilots = [np.stack([s2, s2, np.ones_like(s2)], -1) for s2 in np.exp(rng.normal(0, 2, (6, 32, 32)))]
    for pilot in pilots:  # smooth, so that the neighbours' mean is no surprise
        pilot[..., :2] = pilot[..., :2].mean((0, 1))
    target, texel_error = 0.02, 0.03
    plan = make_plan(lambda: iter(pilots), target=target, texel_error=None, most=1 << 16, whole_views=False)
    counts = np.stack([plan.counts(pilot) for pilot in pilots])
    s2 = np.stack(pilots)[..., 0]
    error = np.sqrt(np.mean(s2 / counts))
    assert target * tolerance("synthesis.target.ladder") <= error
    assert error <= target * (1 + tolerance("synthesis.target.classes"))
    assert counts.mean() < s2.mean() / target**2
    assert set(np.unique(counts)) <= {8 * 2**k for k in range(14)} | {12 * 2**k for k in range(14)}
    limited = make_plan(
        lambda: iter(pilots), target=0.05, texel_error=texel_error, most=1 << 16, whole_views=False
    )
    counts = np.stack([limited.counts(pilot) for pilot in pilots])
    assert np.sqrt(s2 / counts).max() <= texel_error * (1 + tolerance("synthesis.target.classes"))
    black = [np.zeros((4, 4, 3))]
    plan = make_plan(lambda: iter(black), target=0.02, texel_error=0.01, most=64, whole_views=False)
    assert (plan.counts(black[0]) == adaptive.LEAST).all()


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"target_error": 0}, "target_error"),
        ({"target_error": "fine"}, "target_error"),
        ({"texel_error": 0.1}, "texel_error"),
        ({"target_error": 0.1, "spp": 4}, "spp"),
        ({"memory": 1 << 20}, "memory"),
        ({"scheduler": "dusk"}, "scheduler"),
        ({"scheduler": "dask", "workers": 0}, "workers"),
    ],
)
def test_bad_settings_are_one_clear_line(tmp_path, settings, field):
    with pytest.raises(InputError) as error:
        synthesize_store(tmp_path / "a.btf.zarr", "flat", texels=2, views="1x3", lights="1x3", **settings)
    assert error.value.field == field
    assert "\n" not in str(error.value)


def test_p_values_of_texels_are_those_of_a_uniform_synthesis(tile):
    """Numbers of samples chosen by a pilot leave the tests of texels as they are without one."""
    share = {}
    for name, extra in (("uniform", {"spp": 32}), ("adaptive", {"target_error": 0.02})):
        a, b = (synthesize(tile, seed=seed, **SETTINGS, **extra) for seed in (11, 12))
        p = welch_test(a.values, a.variance, b.values, b.variance, n_a=8, n_b=8)[1]
        share[name] = np.nanmean(p < 0.01)
    assert share["adaptive"] <= share["uniform"] + tolerance("synthesis.target.more_rejected")
