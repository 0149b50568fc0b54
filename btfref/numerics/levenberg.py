"""Batched Levenberg–Marquardt in Dr.Jit: one lane a fit, bounded, with an analytic Jacobian.

Sources: D. W. Marquardt, "An Algorithm for Least-Squares Estimation of Nonlinear Parameters", 1963; damping after
H. B. Nielsen, "Damping Parameter in Marquardt's Method", IMM-REP-1999-05; tests of convergence as in J. J. Moré, "The
Levenberg–Marquardt Algorithm: Implementation and Theory", 1978 (MINPACK). Bounds by an active set: a parameter on its
bound that the gradient pushes outwards is left out of the step; the others are clipped.

Thousands to millions of small fits run side by side on LLVM or CUDA. Each iteration is one kernel that solves for the
step, evaluates residuals and Jacobian at the trial point and accepts or rejects it; converged lanes leave the batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Ways in which a fit ends; 0 is the only one that is no convergence.
STATUS = {
    0: "not converged",
    1: "gradient orthogonal to the residual",
    2: "no further reduction",
    3: "step below resolution",
    4: "residual zero",
}

#: Lanes that are fitted at a time: bounds the memory of the normal equations.
LANES = 1 << 19

_FIRST_DAMPING = 1e-2
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
    def converged(self):
        """Whether each fit converged, shape (N,)."""
        return self.status > 0

    @property
    def summary(self):
        """JSON-able counts: fits, converged ones, ends by kind, mean iterations."""
        count = np.bincount(self.status, minlength=len(STATUS))
        return {
            "fits": len(self.status),
            "converged": int(self.converged.sum()),
            "not_converged": int(count[0]),
            "ends": {STATUS[k]: int(count[k]) for k in STATUS},
            "mean_iterations": float(self.iterations.mean()) if len(self.status) else 0.0,
        }


def backend():
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
    residual,
    start,
    lower,
    upper,
    n_samples,
    *,
    iterations=100,
    gtol=1e-4,
    ftol=1e-6,
    xtol=1e-5,
    progress=None,
):
    """Minimise ``½ Σ_s r(p, lane, s)²`` over p within bounds, for each lane on its own.

    Parameters
    ----------
    residual : callable
        ``(parameters, lane, sample) -> (r, [∂r/∂p_0, …])`` with Dr.Jit floats of the module :func:`backend`;
        ``parameters`` is a list of P floats, ``lane`` and ``sample`` are UInt32. It is recorded inside a loop over
        samples: no data-dependent Python control flow.
    start : array_like, shape (N, P)
        Clipped to the bounds.
    lower, upper : array_like, shape (P,) or (N, P)
    n_samples : int
        Of each lane.
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
    start = np.atleast_2d(np.asarray(start, np.float32))
    n = len(start)
    lower, upper = (np.broadcast_to(np.asarray(b, np.float32), start.shape) for b in (lower, upper))
    parameters = np.clip(start, lower, upper)
    cost, status = np.zeros(n, np.float32), np.zeros(n, np.uint8)
    count = np.zeros(n, np.uint16)
    for first in range(0, n, LANES):
        part = slice(first, min(first + LANES, n))
        solver = _Solver(
            residual, first, parameters[part], lower[part], upper[part], n_samples, (gtol, ftol, xtol)
        )
        solver.run(iterations, (lambda done, first=first: progress(first + done, n)) if progress else None)
        parameters[part], cost[part], status[part], count[part] = solver.results()
    return BatchFit(parameters, cost, status, count)


class _Solver:
    """State of one batch; lanes that have ended are written to the results and leave the state."""

    def __init__(self, residual, first, start, lower, upper, n_samples, tolerances):
        self.module = backend()
        import drjit as dr

        # Opaque numbers: one kernel serves batches of any size.
        self.residual = residual
        self.n_samples, self.first = (dr.opaque(self.module.UInt32, k) for k in (n_samples, first))
        self.tolerances = tolerances
        self.size, self.width = start.shape
        Float, UInt32 = self.module.Float, self.module.UInt32
        columns = lambda a: [Float(np.ascontiguousarray(a[:, i])) for i in range(self.width)]  # noqa: E731
        self.bounds = columns(lower), columns(upper)
        self.out = [Float(c) for c in columns(start)]
        self.out_cost = Float(np.zeros(self.size, np.float32))
        self.out_status = UInt32(np.zeros(self.size, np.uint32))
        self.out_count = UInt32(np.zeros(self.size, np.uint32))
        lane = dr.arange(UInt32, self.size)
        p = columns(start)
        cost, gradient, hessian = self._normal_equations(p, lane)
        damping, growth = dr.full(Float, _FIRST_DAMPING, self.size), dr.full(Float, 2.0, self.size)
        status = dr.zeros(UInt32, self.size)
        self.state = [p, cost, gradient, hessian, damping, growth, status, dr.zeros(UInt32, self.size), lane]
        # Literals would be compiled into the first kernels, and differ from those of later steps.
        dr.make_opaque(self.state)

    def run(self, iterations, progress):
        """Iterate until all lanes have ended or the iterations are used up."""
        import drjit as dr

        for step in range(iterations):
            self._step()
            if step % 4 == 3 or step == iterations - 1:
                running = self.state[6] == 0
                left = dr.count(running)[0]
                if progress:
                    progress(self.size - left)
                if left == 0:
                    break
                if left < 0.75 * dr.width(running):
                    self._write()
                    keep = dr.compress(running)
                    self.state = _gathered(dr, self.state, keep)
                    dr.eval(self.state)
        self._write()

    def results(self):
        """Parameters, cost, status and iterations as NumPy arrays."""
        parameters = np.stack([np.array(c) for c in self.out], 1)
        return parameters, np.array(self.out_cost), np.array(self.out_status), np.array(self.out_count)

    def _write(self):
        import drjit as dr

        p, cost, _, _, _, _, status, count, lane = self.state
        for target, value in zip(self.out, p, strict=True):
            dr.scatter(target, value, lane)
        dr.scatter(self.out_cost, cost, lane)
        dr.scatter(self.out_status, status, lane)
        dr.scatter(self.out_count, count, lane)
        dr.eval(self.out, self.out_cost, self.out_status, self.out_count)

    def _normal_equations(self, p, lane):
        """Cost, gradient Jᵀr, and the upper triangle of JᵀJ row by row, by one pass over the samples."""
        import drjit as dr

        Float, UInt32 = self.module.Float, self.module.UInt32
        width, first, residual, n_samples = self.width, self.first, self.residual, self.n_samples
        zeros = lambda n: [dr.zeros(Float, dr.width(lane)) for _ in range(n)]  # noqa: E731

        def body(sample, cost, gradient, hessian):
            # Copies: an in-place operation of the model must not reach the state.
            r, row = residual([Float(x) for x in p], lane + first, sample)
            cost = dr.fma(0.5 * r, r, cost)
            gradient = [dr.fma(row[i], r, gradient[i]) for i in range(width)]
            pairs = [(i, j) for i in range(width) for j in range(i, width)]
            hessian = [dr.fma(row[i], row[j], h) for (i, j), h in zip(pairs, hessian, strict=True)]
            return sample + 1, cost, gradient, hessian

        _, cost, gradient, hessian = dr.while_loop(
            (UInt32(0), *zeros(1), zeros(width), zeros(width * (width + 1) // 2)),
            lambda sample, *_: sample < n_samples,
            body,
            label="samples",
        )
        return cost, gradient, hessian

    def _step(self):
        """One trial step of every lane of the state."""
        import drjit as dr

        p, cost, gradient, hessian, damping, growth, status, count, lane = self.state
        gtol, ftol, xtol = self.tolerances
        width = range(self.width)
        low, high = ([dr.gather(type(b), b, lane) for b in bounds] for bounds in self.bounds)
        frozen = [
            ((p[i] <= low[i]) & (gradient[i] >= 0)) | ((p[i] >= high[i]) & (gradient[i] <= 0)) for i in width
        ]
        at = {}
        for k, (i, j) in enumerate(zip(*np.triu_indices(self.width), strict=True)):
            at[i, j] = at[j, i] = hessian[k]
        # Scaled to unit columns: float32 then suffices for the factorisation.
        scale = [dr.select(at[i, i] > _TINY, dr.rsqrt(dr.maximum(at[i, i], _TINY)), 0) for i in width]
        dead = [frozen[i] | (at[i, i] <= _TINY) for i in width]
        cosine = [dr.select(dead[i], 0, gradient[i] * scale[i]) for i in width]
        step = _damped_solution(dr, at, scale, dead, cosine, damping)
        trial = [_towards(dr, p[i], step[i], low[i], high[i]) for i in width]
        step = [trial[i] - p[i] for i in width]
        predicted = -sum(
            step[i] * (gradient[i] + 0.5 * sum(at[i, j] * step[j] for j in width)) for i in width
        )

        new_cost, new_gradient, new_hessian = self._normal_equations(trial, lane)
        # NaN compares false: a trial that is not finite is rejected.
        better = new_cost < cost
        actual = cost - new_cost
        gain = dr.select(predicted > 0, actual / dr.maximum(predicted, _TINY), 0)
        largest = sum_max(dr, [dr.abs(c) for c in cosine]) * dr.rsqrt(dr.maximum(2 * cost, _TINY))
        still = sum_max(dr, [dr.abs(step[i]) - xtol * (dr.abs(p[i]) + xtol) for i in width]) <= 0
        flat = (predicted <= ftol * cost) & (dr.abs(actual) <= ftol * cost)
        ended = dr.select(
            cost <= _TINY, 4, dr.select(largest <= gtol, 1, dr.select(flat, 2, dr.select(still, 3, 0)))
        )
        running = status == 0
        take = running & better
        bend = 2 * gain - 1
        self.state = [
            [dr.select(take, trial[i], p[i]) for i in width],
            dr.select(take, new_cost, cost),
            [dr.select(take, a, b) for a, b in zip(new_gradient, gradient, strict=True)],
            [dr.select(take, a, b) for a, b in zip(new_hessian, hessian, strict=True)],
            dr.clip(
                damping * dr.select(better, dr.maximum(1 / 3, 1 - bend * bend * bend), growth), 1e-7, 1e10
            ),
            dr.select(better, 2, dr.minimum(2 * growth, 64)),
            dr.select(running, ended, status),
            count + dr.select(running, self.module.UInt32(1), 0),
            lane,
        ]
        dr.eval(self.state)


def sum_max(dr, values):
    """The largest of a list of Dr.Jit floats, lane by lane."""
    result = values[0]
    for value in values[1:]:
        result = dr.maximum(result, value)
    return result


def _damped_solution(dr, at, scale, dead, cosine, damping):
    """Step of ``(C + λ I) y = −c`` with C the scaled matrix, by Cholesky; 0 for parameters that are held."""
    n = len(scale)
    factor, inverse, y = {}, [], []
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


def _towards(dr, p, step, low, high):
    """``p + step``, at most 90 % of the way to a bound, or on it from nearby.

    A step that overshoots and lands on a bound at once may switch a part of the model off for good: a lobe of height
    zero has no gradient in its other parameters.
    """
    near = _NEAR_BOUND * (high - low)
    floor = dr.select(p - low <= near, low, dr.fma(0.9, low - p, p))
    ceiling = dr.select(high - p <= near, high, dr.fma(0.9, high - p, p))
    return dr.clip(p + step, floor, ceiling)


def _gathered(dr, tree, index):
    if isinstance(tree, list):
        return [_gathered(dr, item, index) for item in tree]
    return dr.gather(type(tree), tree, index)
