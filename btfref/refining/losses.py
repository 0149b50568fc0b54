"""How far answers are from true values, in Dr.Jit: what refinement makes small.

All are means over rows. Noise in the true values is theirs as well: of a loss that is not linear in the truth it
moves the least a little, which is why rows want some dozens of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.colour import RGB_TO_XYZ

if TYPE_CHECKING:
    from btfref.types import JitArray

#: ``loss(value, truth, level)``: two Color3f in 1/sr and the mean of the true values, to a Float a row.
Loss = Callable[["JitArray", "JitArray", float], "JitArray"]

#: Share of the mean below which logarithms are those of a constant: darker values are of no account.
_DARK = 0.1

#: Of chroma, so that the square root has a derivative at grey.
_GREY = 1e-4


def relative(value: JitArray, truth: JitArray, level: float) -> JitArray:
    """Squared error over the squared truth and mean: ``Σ (v − q)² / (q² + mean²)``."""
    import drjit as dr

    return dr.sum(dr.square(value - truth) / (dr.square(truth) + level * level))


def log(value: JitArray, truth: JitArray, level: float) -> JitArray:
    """Squared error of ``log(ε + B)``, ε a tenth of the mean; continued by its tangent below 0."""
    import drjit as dr

    small = _DARK * level
    above = dr.log(dr.maximum(value, 0) + small)
    shown = dr.select(value > 0, above, np.log(small) + value / small)
    return dr.sum(dr.square(shown - dr.log(dr.maximum(truth, 0) + small)))


def delta_e(value: JitArray, truth: JitArray, level: float) -> JitArray:
    """Squared colour difference of B times π as colours, in the manner of CIEDE2000.

    Differs from it (Sharma, Wu, Dalal 2005): weights of lightness, chroma and hue are those of the truth, and hue has
    neither its terms by angle nor its rotation, which have kinks. Values below 0 count as what they are.
    """
    import drjit as dr

    (l1, a1, b1), (l2, a2, b2) = _lab(value), _lab(dr.maximum(truth, 0))
    c1, c2 = (dr.sqrt(dr.fma(a, a, dr.fma(b, b, _GREY))) for a, b in ((a1, b1), (a2, b2)))
    lightness, chroma = dr.square(l1 - l2), dr.square(c1 - c2)
    hue = dr.square(a1 - a2) + dr.square(b1 - b2) - chroma
    far = dr.square(l2 - 50)
    s_l, s_c, s_h = 1 + 0.015 * far * dr.rsqrt(20 + far), dr.fma(0.045, c2, 1), dr.fma(0.015, c2, 1)
    return lightness / dr.square(s_l) + chroma / dr.square(s_c) + hue / dr.square(s_h)


def _lab(value: JitArray) -> tuple[JitArray, JitArray, JitArray]:
    """As `btfref.comparison.colour.lab`, of B times π; not clipped below."""
    import drjit as dr

    shown = dr.minimum(np.pi * value, 1)
    rows = (RGB_TO_XYZ / RGB_TO_XYZ.sum(axis=1, keepdims=True)).tolist()
    x, y, z = (_curve(r[0] * shown.x + r[1] * shown.y + r[2] * shown.z) for r in rows)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def _curve(t: JitArray) -> JitArray:
    import drjit as dr

    delta = 6 / 29
    high = t > delta**3
    return dr.select(
        high, dr.exp2(dr.log2(dr.select(high, t, 1)) * (1 / 3)), t * (1 / (3 * delta**2)) + 4 / 29
    )


#: Losses by name.
LOSSES: dict[str, Loss] = {"relative": relative, "log": log, "delta_e": delta_e}
