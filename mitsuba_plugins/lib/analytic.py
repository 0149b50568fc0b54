"""Dr.Jit ports of what the methods share that store functions of the light.

See :mod:`btfref.representations.analytic.light_functions` and :mod:`btfref.numerics.powers`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.numerics.powers import FLOOR, LIMIT_LOG2, LOWEST_LOG2

if TYPE_CHECKING:
    from btfref.types import JitArray


#: Below this |f|, log2(1 + f) comes from a series in f / (2 + f): 1 + f would round what a large exponent multiplies.
_NEAR_ONE = 0.29


def held(w: JitArray, edge: float) -> tuple[JitArray, JitArray]:
    """As :func:`btfref.representations.analytic.light_functions.held`: the raised direction and the fade."""
    if edge <= 0:
        return w, mi.Float(1)
    below = w.z < edge
    radius = dr.sqrt(dr.fma(w.x, w.x, w.y * w.y))
    scale = dr.select(below, (1 - edge * edge) ** 0.5 / dr.select(below, radius, 1), 1)
    return mi.Vector3f(w.x * scale, w.y * scale, dr.maximum(w.z, edge)), dr.minimum(w.z * (1 / edge), 1)


def safe_power(base: JitArray, exponent: JitArray) -> JitArray:
    """As :func:`btfref.numerics.powers.safe_power`."""
    there = base >= FLOOR
    return _from_log(dr.log2(dr.select(there, base, 1)), exponent, there)


def lobe_power(t: JitArray, light: JitArray, n: JitArray) -> JitArray:
    """As :func:`btfref.numerics.powers.lobe_power`."""
    scale = dr.maximum(dr.maximum(dr.abs(t.x), dr.abs(t.y)), dr.abs(t.z))
    there = scale >= FLOOR
    scale = dr.select(there, scale, 1)
    cosine = dr.dot(dr.select(there, t, 0) / scale, light)
    there &= cosine >= FLOOR
    return _from_log(dr.log2(scale) + dr.log2(dr.select(there, cosine, 1)), n, there)


def unit_lobe(axis: JitArray, light: JitArray, n: JitArray) -> JitArray:
    """As :func:`btfref.numerics.powers.unit_lobe`."""
    h = 0.5 * dr.squared_norm(axis - light)
    there = 1 - h >= FLOOR
    near = h < _NEAR_ONE
    far = dr.log2(dr.select(there & ~near, 1 - h, 1))
    return _from_log(dr.select(near, _log2_near_one(dr.select(near, -h, 0)), far), n, there)


def _log2_near_one(f: JitArray) -> JitArray:
    s = f / (2 + f)
    z = s * s
    # 2 log2(e) atanh(s), the series up to s⁹: the next term is 2e-9 of it.
    p = mi.Float(1 / 9)
    for coefficient in (1 / 7, 1 / 5, 1 / 3, 1):
        p = dr.fma(p, z, coefficient)
    return 2.8853900817779268 * s * p


def _from_log(log: JitArray, exponent: JitArray, there: JitArray) -> JitArray:
    product = dr.clip(log * exponent, LOWEST_LOG2, LIMIT_LOG2)
    return dr.select(there & (product > LOWEST_LOG2), dr.exp2(product), 0)


def parabolic_axis(s: JitArray, t: JitArray) -> JitArray:
    """As :func:`btfref.representations.analytic.rf_lobes.parabolic_axis`."""
    r2 = dr.fma(s, s, t * t)
    scale = 1 / (1 + r2)
    return mi.Vector3f(2 * s * scale, 2 * t * scale, (1 - r2) * scale)


def packet(table: JitArray, entry: JitArray, width: int, active: JitArray = True) -> list[JitArray]:
    """``width`` floats of an entry, a multiple of 4, in a list."""
    quads = [dr.gather(mi.Vector4f, table, entry * (width // 4) + i, active) for i in range(width // 4)]
    return [quad[k] for quad in quads for k in range(4)]
