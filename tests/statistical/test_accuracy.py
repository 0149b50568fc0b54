"""Both estimators, all mesostructures, thirty random pairs each, against plain renders that share no code."""

import numpy as np
import pytest
from plain_renders import PlainRenders
from scipy.stats import norm

from btfref.comparison.significance import difference_test, welch_test
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.numerics.sphere.directions import directions
from btfref.sampling.synthesis import synthesize

pytestmark = pytest.mark.usefixtures("llvm")

TEXELS = 8

#: Random views and lights of ubo81, and the ring of 75 degrees (from 57 on) among both.
RNG = np.random.default_rng(75)
CHOSEN = [*RNG.choice(57, 4, replace=False).tolist(), *(57 + RNG.choice(24, 2, replace=False)).tolist()]

#: Runs of different seeds, whose spread is the synthesis' own noise, and samples of each. Points and walks are shared
#: by all pairs: as many of them as paths leave the mean of all pairs several times noisier.
RUNS, SPP = {"path": 6, "surface": 24}, {"path": 256, "surface": 1024}

#: Runs and samples where a difference of some percent is all that is looked for.
FEW_RUNS, FEW_SPP = 6, {"path": 256, "surface": 64}

#: Plain renders of each pair, and samples of each.
ROUNDS, ROUND_SPP = 16, 1024


def _runs(tile, estimator, *, runs, spp, max_depth=8):
    vectors = directions("ubo81").vectors[CHOSEN]
    settings = {"texels": TEXELS, "views": vectors, "lights": vectors, "dtype": "float32"}
    settings |= {"estimator": estimator, "spp": spp, "max_depth": max_depth}
    return np.stack([synthesize(tile, seed=seed, **settings).values for seed in range(runs)])


def _compare(llvm, name, estimator, n_pairs, rounds):
    """Rejected texels, and the relative mean bias of all pairs with its standard error."""
    tile = build(name)
    vectors = directions("ubo81").vectors[CHOSEN]
    runs = RUNS[estimator]
    values = _runs(tile, estimator, runs=runs, spp=SPP[estimator]).astype(np.float64)
    plain = PlainRenders(llvm, tile, texels=TEXELS, reach=3, max_depth=8)
    index = np.random.default_rng(30).choice(len(CHOSEN) ** 2, n_pairs, replace=False)
    means, p, theirs, noise = [], [], [], []
    # Python's own numbers: Mitsuba takes no NumPy ones for seeds.
    for v, k in (divmod(number, len(CHOSEN)) for number in index.tolist()):
        image, variance = plain.pair(
            vectors[v], vectors[k], spp=ROUND_SPP, rounds=rounds, seed=100 * (6 * v + k)
        )
        ours = values[:, v, k]
        spread = ours.var(0, ddof=1) / runs
        # Where neither ever varied, rounding is all that can differ.
        floor = (tolerance("synthesis.rounding") * image.max()) ** 2
        p.append(welch_test(ours.mean(0), spread + floor, image, variance + floor, n_a=runs, n_b=rounds)[1])
        means.append(ours.mean((1, 2, 3)))
        theirs.append(image.mean())
        noise.append(3 * variance.sum() / image.size**2)
    # Pairs share points and walks: the spread of whole runs holds what goes together.
    whole = np.mean(means, axis=0)
    error = np.sqrt(whole.var(ddof=1) / runs + np.sum(noise) / n_pairs**2) / np.mean(theirs)
    rejected = difference_test(np.stack(p), significance=tolerance("closing_loop.difference.significance"))
    return rejected.rejected_fraction, whole.mean() / np.mean(theirs) - 1, error


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["path", "surface"])
@pytest.mark.parametrize("name", ["checker", "rings", "tissue", "knit", "leather", "pebbles"])
def test_thirty_pairs_equal_plain_renders(llvm, name, estimator):
    rejected, bias, error = _compare(llvm, name, estimator, 30, ROUNDS)
    assert rejected <= tolerance("closing_loop.difference.rejected_fraction")
    # The whole interval of 95 % lies inside the limit: what is undecided does not pass.
    assert abs(bias) + norm.ppf(0.975) * error <= tolerance("synthesis.surface.bias")


@pytest.mark.parametrize("estimator", ["path", "surface"])
def test_interreflection_adds_light(estimator):
    settings = {"runs": FEW_RUNS, "spp": FEW_SPP[estimator]}
    deep, direct = (
        _runs(build("rings"), estimator, max_depth=depth, **settings).mean((0, 3, 4, 5)) for depth in (8, 2)
    )
    assert deep.mean() / direct.mean() > 1 + 10 * tolerance("synthesis.surface.bias")
