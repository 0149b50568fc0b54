"""Batched Levenberg–Marquardt: known answers, bounds, reported convergence, Jacobians of the models."""

import types

import numpy as np
import pytest

from btfref.gates.tolerances import tolerance
from btfref.numerics.solvers.levenberg import backend, fit_batch
from btfref.numerics.sphere.directions import directions
from btfref.representations.analytic.lafortune import lafortune_model
from btfref.representations.analytic.rf_lobes import fit_lobes, lobe_model
from btfref.stress.data import bumpy_values


@pytest.fixture
def module(need):
    need("llvm")
    return backend()


def decay(module, data):
    """Model ``a exp(−b x)`` at x = 0, 0.1, …; ``data`` is (n_samples, N)."""
    import drjit as dr

    flat, n = module.Float(np.ascontiguousarray(data, np.float32).ravel()), data.shape[1]

    def model(p, fit):
        def samples(step):
            x = 0.1 * module.Float(step)
            shape = dr.exp(-p[1] * x)
            return [(p[0] * shape - dr.gather(module.Float, flat, step * n + fit), [shape, x * shape])]

        return samples, [module.Float(1), -p[0]]

    return model


def test_known_parameters_are_found(module, rng):
    truth = rng.uniform([0.5, 0.2], [3, 4], (5000, 2))
    data = truth[:, 0] * np.exp(-truth[:, 1] * 0.1 * np.arange(30)[:, None])
    result = fit_batch(decay(module, data), np.ones((5000, 2)), [0, 0], [10, 10], 30)
    assert result.converged.all()
    assert result.summary["not_converged"] == 0
    np.testing.assert_allclose(result.parameters, truth, rtol=tolerance("levenberg.known.rtol"))


def test_bounds_hold_and_give_the_constrained_optimum(module, rng):
    truth = rng.uniform([0.5, 0.2], [3, 4], (1000, 2))
    data = truth[:, 0] * np.exp(-truth[:, 1] * 0.1 * np.arange(30)[:, None])
    result = fit_batch(decay(module, data), np.full((1000, 2), 0.9), [0, 0.5], [1, 10], 30)
    assert result.converged.all()
    assert (result.parameters >= np.float32([0, 0.5])).all()
    assert (result.parameters <= np.float32([1, 10])).all()
    from scipy.optimize import least_squares

    x = 0.1 * np.arange(30)
    for i in range(0, 1000, 50):
        peer = least_squares(
            lambda p, i=i: p[0] * np.exp(-p[1] * x) - data[:, i], [0.9, 0.9], bounds=([0, 0.5], [1, 10])
        )
        assert result.cost[i] <= peer.cost * (1 + tolerance("levenberg.peer.cost")) + tolerance(
            "levenberg.peer.floor"
        )


def test_fits_that_do_not_converge_are_reported(module, rng):
    data = rng.uniform(1, 3, 64) * np.exp(-3 * 0.1 * np.arange(30)[:, None])
    result = fit_batch(decay(module, data), np.full((64, 2), 0.1), [0, 0], [10, 10], 30, iterations=1)
    assert not result.converged.any()
    assert result.summary == result.summary | {"fits": 64, "converged": 0, "not_converged": 64}


def test_lanes_end_on_their_own(module, rng):
    """A batch with easy and hard lanes gives each the result that it has alone, whatever leaves before it."""
    truth = rng.uniform([0.5, 0.2], [3, 4], (400, 2))
    start = np.where(np.arange(400)[:, None] % 4, truth, 0.1)
    data = truth[:, 0] * np.exp(-truth[:, 1] * 0.1 * np.arange(30)[:, None])
    result = fit_batch(decay(module, data), start, [0, 0], [10, 10], 30)
    alone = fit_batch(decay(module, data[:, ::4]), start[::4], [0, 0], [10, 10], 30)
    assert len(np.unique(result.iterations)) > 1
    np.testing.assert_array_equal(result.parameters[::4], alone.parameters)


def doubles():
    """Dr.Jit's array module in float64, for derivatives by differences."""
    import drjit.llvm as llvm

    return types.SimpleNamespace(Float=llvm.Float64, UInt32=llvm.UInt32, Array4f=llvm.Array4f64)


@pytest.mark.parametrize("model", ["lobes", "lafortune", "lafortune with factor"])
def test_jacobians_are_those_of_differences(module, rng, model):
    views, lights = directions("10x5").vectors, directions("ubo81").vectors
    n = 40
    kinds = doubles()
    if model == "lobes":
        made, _ = lobe_model(kinds, np.zeros((n, len(lights)), np.float32), lights, 2)
        p = rng.uniform([-1, -1, 0, 0.1], [1, 1, 3, 2], (n, 2, 4)).reshape(n, -1)
    else:
        factor = rng.uniform(0.5, 2, (n, len(views))) if "factor" in model else None
        data = np.zeros((n, len(views), len(lights)), np.float32)
        made = lafortune_model(kinds, data, views, lights, 2, factor)
        p = rng.uniform([-1, -1, -1, 0, 0.1], [1, 1, 1, 3, 2], (n, 2, 5)).reshape(n, -1)
        p = np.concatenate([rng.uniform(0, 1, (n, 1)), p], 1)
    fit, step = kinds.UInt32(np.arange(n)), kinds.UInt32(rng.integers(0, len(lights) // 4, n))

    def at(q):
        samples, units = made([kinds.Float(np.ascontiguousarray(c)) for c in q.T], fit)
        found = samples(step)
        r = np.stack([np.array(r) for r, _ in found], 1)
        row = [
            [np.array(u * unit) + np.zeros(n) for u, unit in zip(row, units, strict=True)] for _, row in found
        ]
        return r, np.moveaxis(np.array(row), 0, 2)

    _, row = at(p)
    size = 1e-6
    for k in range(p.shape[1]):
        shift = size * (np.arange(p.shape[1]) == k)
        difference = (at(p + shift)[0] - at(p - shift)[0]) / (2 * size)
        scale = np.maximum(np.abs(row[k]), 1)
        assert (np.abs(difference - row[k]) <= tolerance("levenberg.jacobian.max") * scale).all()


def test_lobes_are_no_worse_than_scipy_s(module):
    from scipy.optimize import least_squares

    from btfref.representations.analytic.lobe_start import exponent_limit, lobe_starts

    lights = directions("ubo81")
    data = bumpy_values((6, 5), lights, lights)[20].mean(-1).reshape(81, -1).T.astype(np.float32)
    result = fit_lobes(data, lights, 2)
    starts = lobe_starts(data, lights.vectors, 2)
    assert result.converged.all()

    def model(p):
        s, t, log_n, peak = p.reshape(-1, 4).T
        axis = np.stack([2 * s, 2 * t, 1 - s * s - t * t]) / (1 + s * s + t * t)
        return (peak * np.maximum(lights.vectors @ axis, 1e-9) ** np.exp(log_n)).sum(-1)

    ours = theirs = 0.0
    for i in range(len(data)):
        top = max(4 * data[i].max(), 1e-6)
        upper = np.tile([1.5, 1.5, np.log(exponent_limit(lights)), top], 2)
        lower = np.tile([-1.5, -1.5, 0, 0], 2)
        start = np.clip(starts[i], lower + 1e-6, upper - 1e-6)
        peer = least_squares(lambda p, i=i: model(p) - data[i], start, bounds=(lower, upper))
        ours, theirs = ours + result.cost[i], theirs + peer.cost
    assert ours <= theirs * (1 + tolerance("levenberg.lobes.cost"))
