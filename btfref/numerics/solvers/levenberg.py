"""Batched Levenberg–Marquardt in Dr.Jit: one lane a fit, bounded, with an analytic Jacobian.

Sources: D. W. Marquardt, "An Algorithm for Least-Squares Estimation of Nonlinear Parameters", 1963; damping after
H. B. Nielsen, "Damping Parameter in Marquardt's Method", IMM-REP-1999-05; tests of convergence as in J. J. Moré, "The
Levenberg–Marquardt Algorithm: Implementation and Theory", 1978 (MINPACK). Bounds by an active set: a parameter on its
bound that the gradient pushes outwards is left out of the step; the others are clipped.

Thousands to millions of small fits run side by side on LLVM or CUDA, all of them in one kernel: each iteration solves
for the step, evaluates residuals and Jacobian at the trial point and accepts or rejects it; a lane whose fit has ended
writes it out and takes the next one that nobody has.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from btfref.types import Facts, JitArray

#: Ways in which a fit ends; 0 is the only one that is no convergence.
STATUS = {
    0: "not converged",
    1: "gradient orthogonal to the residual",
    2: "no further reduction",
    3: "step below resolution",
    4: "residual zero",
}

#: Fits of one launch: bounds the time between two reports of progress.
LAUNCH = 1 << 17

#: Lanes of a launch; each takes the next fit when its own has ended.
RUNNING_LANES = 1 << 10

#: ``samples(step)``: residuals r of one or several samples and their [u_0, …], see :func:`fit_batch`.
Samples = Callable[[JitArray], list[tuple[JitArray, list[JitArray]]]]

#: ``(p, fit) -> (samples, units)``, see :func:`fit_batch`.
Model = Callable[[list[JitArray], JitArray], tuple[Samples, list[JitArray]]]

_FIRST_DAMPING = 1e-1
_TINY = 1e-30


#: Share of the range of a parameter within which a step may end on the bound.
_NEAR_BOUND = 2e-3


@dataclass(frozen=True)
class BatchFit:
    """Result of N fits of P parameters.

    Attributes
    ----------
    parameters : ndarray of float32, shape (N, P)
        The best point found, within the bounds, converged or not.
    cost : ndarray of float32, shape (N,)
        Half the sum of the squared residuals there.
    status : ndarray of uint8, shape (N,)
        See ``STATUS``.
    iterations : ndarray of uint16, shape (N,)
    """

    parameters: np.ndarray
    cost: np.ndarray
    status: np.ndarray
    iterations: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """Whether each fit converged, shape (N,)."""
        return self.status > 0

    @property
    def summary(self) -> Facts:
        """JSON-able counts: fits, converged ones, ends by kind, mean iterations."""
        count = np.bincount(self.status, minlength=len(STATUS))
        return {
            "fits": len(self.status),
            "converged": int(self.converged.sum()),
            "not_converged": int(count[0]),
            "ends": {STATUS[k]: int(count[k]) for k in STATUS},
            "mean_iterations": float(self.iterations.mean()) if len(self.status) else 0.0,
        }


def backend() -> ModuleType:
    """Dr.Jit's array module: CUDA where there is a device, else LLVM.

    Raises
    ------
    MissingDependencyError
        When there is neither.
    """
    import drjit as dr

    if dr.has_backend(dr.JitBackend.CUDA):
        import drjit.cuda as module
    else:
        from btfref.platform import prepare_llvm

        prepare_llvm()
        import drjit.llvm as module
    return module


def fit_batch(
    model: Model,
    start: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    n_steps: int,
    *,
    iterations: int = 100,
    gtol: float = 1e-4,
    ftol: float = 1e-6,
    xtol: float = 1e-5,
    progress: Callable[[int, int], object] | None = None,
) -> BatchFit:
    """Minimise ``½ Σ_s r_s(p, fit)²`` over p within bounds, for each of N fits on its own.

    Parameters
    ----------
    model : callable
        ``(p, fit) -> (samples, units)`` with Dr.Jit floats of the module :func:`backend`: ``p`` is a list of P floats,
        ``fit`` a UInt32. ``samples(step)`` lists, for one or several samples, ``(r, [u_0, …])`` such that
        ``∂r/∂p_i = u_i units[i]``: what all samples share stays out of their loop. It is recorded in that loop: no
        data-dependent Python control flow.
    start : array_like, shape (N, P)
        Clipped to the bounds.
    lower, upper : array_like, shape (P,) or (N, P)
    n_steps : int
        Steps of the loop over the samples of a fit.
    iterations : int
        At most so many steps are tried.
    gtol : float
        Converged when each free column of the Jacobian makes a cosine of at most ``gtol`` with the residual.
    ftol : float
        Converged when the predicted and the actual reduction are at most ``ftol`` of the cost. float32 sums leave
        1e-7 to 1e-6 of it undetermined.
    xtol : float
        Converged when no parameter moves by more than ``xtol (|p| + xtol)``.
    progress : callable, optional
        ``progress(done, total)`` with the number of finished fits.

    Returns
    -------
    BatchFit
    """
    first_guess = np.atleast_2d(np.asarray(start, np.float32))
    n = len(first_guess)
    low, high = (np.broadcast_to(np.asarray(b, np.float32), first_guess.shape) for b in (lower, upper))
    first_guess = np.clip(first_guess, low, high)
    solver = _Solver(model, first_guess, low, high, n_steps, iterations, (gtol, ftol, xtol))
    parameters, cost = np.zeros_like(first_guess), np.zeros(n, np.float32)
    status, count = np.zeros(n, np.uint8), np.zeros(n, np.uint16)
    for first in range(0, n, LAUNCH):
        part = slice(first, min(first + LAUNCH, n))
        parameters[part], cost[part], status[part], count[part] = solver.run(part.start, part.stop)
        if progress:
            progress(part.stop, n)
    return BatchFit(parameters, cost, status, count)


class _Solver:
    """One launch: lanes that take the next fit when theirs has ended, until none is left.

    The whole iteration, solution, residuals and all, is one loop within one kernel: the normal equations stay in
    registers, and no lane waits for the slowest of a batch.
    """

    def __init__(
        self,
        model: Model,
        start: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        n_steps: int,
        iterations: int,
        tolerances: tuple[float, float, float],
    ) -> None:
        self.module = backend()
        import drjit as dr

        UInt32 = self.module.UInt32
        self.model, self.tolerances = model, tolerances
        self.size, self.width = start.shape
        # Opaque numbers: one kernel serves any batch.
        self.n_steps, self.limit = (dr.opaque(UInt32, k) for k in (n_steps, iterations))
        self.start, self.lower, self.upper = (
            self.module.Float(np.ascontiguousarray(a, np.float32).ravel()) for a in (start, lower, upper)
        )

    def run(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Fit ``first`` to ``last − 1``: parameters, cost, status and iterations as NumPy arrays."""
        import drjit as dr

        Float, UInt32 = self.module.Float, self.module.UInt32
        size, width = last - first, self.width
        lanes = min(size, RUNNING_LANES)
        out = [dr.zeros(Float, size * width), dr.zeros(Float, size)]
        out += [dr.zeros(UInt32, size), dr.zeros(UInt32, size)]
        begin, end, taken = dr.opaque(UInt32, first), dr.opaque(UInt32, last), UInt32([first + lanes])
        fit = begin + dr.arange(UInt32, lanes)
        dr.eval(out, taken, fit)
        # Python scalars and literals would be compiled into the kernel as constants of the first iteration.
        one = lambda: dr.zeros(Float, lanes)  # noqa: E731
        many = lambda n: [one() for _ in range(n)]  # noqa: E731
        hessian = many(width * (width + 1) // 2)
        state = (fit, dr.zeros(UInt32, lanes), many(width), one(), many(width), hessian, one(), one())
        dr.make_opaque(state)

        def body(
            fit: JitArray,
            count: JitArray,
            p: list[JitArray],
            cost: JitArray,
            gradient: list[JitArray],
            hessian: list[JitArray],
            damping: JitArray,
            growth: JitArray,
        ) -> tuple[JitArray, ...]:
            p, cost, gradient, hessian, damping, growth, status = self._step(
                fit, count == 0, p, cost, gradient, hessian, damping, growth
            )
            ended = (status > 0) | (count >= self.limit)
            place = fit - begin
            for i in range(width):
                dr.scatter(out[0], p[i], place * width + i, ended)
            dr.scatter(out[1], cost, place, ended)
            dr.scatter(out[2], status, place, ended)
            dr.scatter(out[3], count, place, ended)
            following = dr.scatter_inc(taken, UInt32(0), ended)
            fit, count = dr.select(ended, following, fit), dr.select(ended, 0, count + 1)
            return fit, count, p, cost, gradient, hessian, damping, growth

        dr.while_loop(state, lambda fit, *_: fit < end, body, label="fits")
        dr.eval(out)
        parameters, cost, status, count = (np.array(a) for a in out)
        return parameters.reshape(size, width), cost, status, count

    def _normal_equations(
        self, p: list[JitArray], fit: JitArray
    ) -> tuple[JitArray, list[JitArray], list[JitArray]]:
        """Cost, gradient Jᵀr, and the upper triangle of JᵀJ row by row, by one pass over the samples."""
        import drjit as dr

        Float, UInt32 = self.module.Float, self.module.UInt32
        width, n_steps = self.width, self.n_steps
        zeros = lambda n: [dr.zeros(Float, dr.width(fit)) for _ in range(n)]  # noqa: E731
        pairs = [(i, j) for i in range(width) for j in range(i, width)]
        # Copies: an in-place operation of the model must not reach the state.
        samples, units = self.model([Float(x) for x in p], fit)

        def body(
            step: JitArray, cost: JitArray, gradient: list[JitArray], hessian: list[JitArray]
        ) -> tuple[JitArray, JitArray, list[JitArray], list[JitArray]]:
            for r, row in samples(step):
                cost = dr.fma(r, r, cost)
                gradient = [dr.fma(row[i], r, gradient[i]) for i in range(width)]
                hessian = [dr.fma(row[i], row[j], h) for (i, j), h in zip(pairs, hessian, strict=True)]
            return step + 1, cost, gradient, hessian

        _, cost, gradient, hessian = dr.while_loop(
            (UInt32(0), *zeros(1), zeros(width), zeros(len(pairs))),
            lambda step, *_: step < n_steps,
            body,
            label="samples",
        )
        gradient = [g * unit for g, unit in zip(gradient, units, strict=True)]
        hessian = [h * (units[i] * units[j]) for (i, j), h in zip(pairs, hessian, strict=True)]
        return 0.5 * cost, gradient, hessian

    def _step(
        self,
        fit: JitArray,
        fresh: JitArray,
        p: list[JitArray],
        cost: JitArray,
        gradient: list[JitArray],
        hessian: list[JitArray],
        damping: JitArray,
        growth: JitArray,
    ) -> tuple[list[JitArray], JitArray, list[JitArray], list[JitArray], JitArray, JitArray, JitArray]:
        """One trial step, or the start of a fresh fit; returns the state and how the fit ended, 0 if it did not."""
        import drjit as dr

        gtol, ftol, xtol = self.tolerances
        Float, width = self.module.Float, range(self.width)
        at_fit = lambda table, i: dr.gather(Float, table, fit * self.width + i)  # noqa: E731
        low, high = ([at_fit(table, i) for i in width] for table in (self.lower, self.upper))
        frozen = [
            ((p[i] <= low[i]) & (gradient[i] >= 0)) | ((p[i] >= high[i]) & (gradient[i] <= 0)) for i in width
        ]
        at: dict[tuple[int, int], JitArray] = {}
        pairs = [(i, j) for i in width for j in width[i:]]
        for (i, j), value in zip(pairs, hessian, strict=True):
            at[i, j] = at[j, i] = value
        # Scaled to unit columns: float32 then suffices for the factorisation.
        scale = [dr.select(at[i, i] > _TINY, dr.rsqrt(dr.maximum(at[i, i], _TINY)), 0) for i in width]
        dead = [frozen[i] | (at[i, i] <= _TINY) for i in width]
        cosine = [dr.select(dead[i], 0, gradient[i] * scale[i]) for i in width]
        step = _damped_solution(dr, at, scale, dead, cosine, damping)
        trial = [
            dr.select(fresh, at_fit(self.start, i), _towards(dr, p[i], step[i], low[i], high[i]))
            for i in width
        ]
        step = [trial[i] - p[i] for i in width]
        predicted = -sum(
            step[i] * (gradient[i] + 0.5 * sum(at[i, j] * step[j] for j in width)) for i in width
        )

        new_cost, new_gradient, new_hessian = self._normal_equations(trial, fit)
        # NaN compares false: a trial that is not finite is rejected.
        better = new_cost < cost
        actual = cost - new_cost
        gain = dr.select(predicted > 0, actual / dr.maximum(predicted, _TINY), 0)
        largest = sum_max(dr, [dr.abs(c) for c in cosine]) * dr.rsqrt(dr.maximum(2 * cost, _TINY))
        still = sum_max(dr, [dr.abs(step[i]) - xtol * (dr.abs(p[i]) + xtol) for i in width]) <= 0
        flat = (predicted <= ftol * cost) & (dr.abs(actual) <= ftol * cost)
        status = dr.select(
            cost <= _TINY, 4, dr.select(largest <= gtol, 1, dr.select(flat, 2, dr.select(still, 3, 0)))
        )
        bend = 2 * gain - 1
        damping = dr.clip(
            damping * dr.select(better, dr.maximum(1 / 3, 1 - bend * bend * bend), growth), 1e-7, 1e10
        )
        growth = dr.select(better, 2, dr.minimum(2 * growth, 64))
        take = fresh | better
        choose = lambda new, old: [dr.select(take, a, b) for a, b in zip(new, old, strict=True)]  # noqa: E731
        return (
            choose(trial, p),
            dr.select(take, new_cost, cost),
            choose(new_gradient, gradient),
            choose(new_hessian, hessian),
            dr.select(fresh, _FIRST_DAMPING, damping),
            dr.select(fresh, 2, growth),
            dr.select(fresh, self.module.UInt32(0), self.module.UInt32(status)),
        )


def sum_max(dr: ModuleType, values: Sequence[JitArray]) -> JitArray:
    """The largest of a list of Dr.Jit floats, lane by lane."""
    result = values[0]
    for value in values[1:]:
        result = dr.maximum(result, value)
    return result


def _damped_solution(
    dr: ModuleType,
    at: Mapping[tuple[int, int], JitArray],
    scale: list[JitArray],
    dead: list[JitArray],
    cosine: list[JitArray],
    damping: JitArray,
) -> list[JitArray]:
    """Step of ``(C + λ I) y = −c`` with C the scaled matrix, by Cholesky; 0 for parameters that are held."""
    n = len(scale)
    factor: dict[tuple[int, int], JitArray] = {}
    inverse: list[JitArray] = []
    y: list[JitArray] = []
    for i in range(n):
        for j in range(i):
            value = dr.select(dead[i] | dead[j], 0, at[i, j] * scale[i] * scale[j])
            for k in range(j):
                value = dr.fma(-factor[i, k], factor[j, k], value)
            factor[i, j] = value * inverse[j]
        pivot = 1 + damping
        for k in range(i):
            pivot = dr.fma(-factor[i, k], factor[i, k], pivot)
        # Rounding may take a pivot of nearly parallel columns below the damping.
        inverse.append(dr.rsqrt(dr.maximum(pivot, dr.maximum(damping, 1e-6))))
        value = -cosine[i]
        for k in range(i):
            value = dr.fma(-factor[i, k], y[k], value)
        y.append(value * inverse[i])
    for i in reversed(range(n)):
        value = y[i]
        for k in range(i + 1, n):
            value = dr.fma(-factor[k, i], y[k], value)
        y[i] = value * inverse[i]
    return [dr.select(dead[i], 0, y[i] * scale[i]) for i in range(n)]


def _towards(dr: ModuleType, p: JitArray, step: JitArray, low: JitArray, high: JitArray) -> JitArray:
    """``p + step``, at most 90 % of the way to a bound, or on it from nearby.

    A step that overshoots and lands on a bound at once may switch a part of the model off for good: a lobe of height
    zero has no gradient in its other parameters.
    """
    near = _NEAR_BOUND * (high - low)
    floor = dr.select(p - low <= near, low, dr.fma(0.9, low - p, p))
    ceiling = dr.select(high - p <= near, high, dr.fma(0.9, high - p, p))
    return dr.clip(p + step, floor, ceiling)
