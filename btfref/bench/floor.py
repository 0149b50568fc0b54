"""The floor of a synthesis: Mitsuba's own `eval` of as many BSDF values as it sums up, in one kernel and nothing else.

No estimator that asks the BSDF for each of its values can be faster: rays, sums and memory are left out. What is
counted is direct light alone: each surface point that a texel of a view sees, once for each light.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device

if TYPE_CHECKING:
    from btfref.sampling.surface.estimator import SurfaceEstimator
    from btfref.types import JitArray

#: Lanes of the kernel; each evaluates all lights.
LANES = 1 << 20

#: Runs of the kernel, whose median counts; one more warms up.
ROUNDS = 3


def values_of(estimator: SurfaceEstimator) -> tuple[int, np.ndarray]:
    """BSDF values that the direct light of all its views is the sum of, and the BSDF of each seen point.

    Parameters
    ----------
    estimator : SurfaceEstimator

    Returns
    -------
    int
        Points seen by texels, over all views, times lights.
    ndarray of uint32
        Dr.Jit's numbers of BSDFs: those of the points seen.
    """
    bins = [estimator.bins[row] for row in estimator.row.values()]
    number = estimator.surface.number.numpy()
    seen = np.concatenate([number[some.record] for some in bins])
    return len(seen) * len(estimator.lit), seen


def seconds(count: int, seen: np.ndarray, lights: np.ndarray, *, lanes: int = LANES) -> float:
    """Time of Mitsuba's own `eval` for as many values.

    Parameters
    ----------
    count : int
        Values. Fewer are evaluated, and the time is scaled.
    seen : ndarray of uint32
        Of `values_of`; lanes stand for an even choice of them, one BSDF after the other.
    lights : ndarray (n, 3)
        Directions, in the frame of each point.
    lanes : int

    Returns
    -------
    float
    """
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(0)
    number = np.sort(seen)[np.linspace(0, len(seen) - 1, lanes).astype(np.int64)]
    view = np.abs(rng.normal(size=(3, lanes)))
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.wi = to_device(mi.Vector3f, view / np.linalg.norm(view, axis=0))
    si.uv = to_device(mi.Point2f, rng.random((2, lanes)))
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    bsdf = dr.reinterpret_array(mi.BSDFPtr, to_device(mi.UInt32, number))
    vectors, n = to_device(mi.Float, lights), dr.opaque(mi.UInt32, len(lights))
    context = mi.BSDFContext()
    dr.eval(si, bsdf)

    def add(k: JitArray, total: JitArray) -> tuple[JitArray, JitArray]:
        return k + 1, total + bsdf.eval(context, si, dr.gather(mi.Vector3f, vectors, k))

    taken = []
    for _ in range(1 + ROUNDS):
        start = time.perf_counter()
        state = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Color3f, lanes)
        _, total = dr.while_loop(state, lambda k, _: k < n, add)
        dr.eval(total)
        dr.sync_thread()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:])) * count / (lanes * len(lights))
