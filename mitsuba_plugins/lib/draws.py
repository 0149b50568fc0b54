"""Dr.Jit port of :mod:`btfref.numerics.draws`: one neighbour of a lookup instead of all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from btfref.errors import InputError
from btfref.numerics.draws import LEAST

if TYPE_CHECKING:
    from collections.abc import Iterable

    from btfref.types import JitArray


def chosen(
    pairs: list[tuple[JitArray, JitArray]], draw: JitArray, *, hold: bool
) -> tuple[JitArray, JitArray]:
    """As :func:`btfref.numerics.draws.chosen`: the drawn one of some (index, weight), with the weight of all.

    Weights that ``hold`` sum to 1, and that is what the compiler shall know.
    """
    total = mi.Float(1) if hold else sum((weight for _, weight in pairs[1:]), pairs[0][1])
    before, target = mi.Float(0), draw * total
    index = pairs[0][0]
    for following, weight in pairs:
        # One without weight is never drawn: its interval is empty.
        index = dr.select((target >= before) & (weight > 0), following, index)
        before = before + weight
    return index, total


def of_lookups(uv: JitArray, w_view: JitArray) -> JitArray:
    """As :func:`btfref.numerics.draws.of_lookups`: a function of the lookup alone, the same in all methods of a BSDF.

    Raises
    ------
    InputError
        For lookups that gradients are wanted of: what is drawn does not change with them.
    """
    refuse_gradients((uv, w_view))
    numbers = (mi.Float(x) for x in (uv.x, uv.y, w_view.x, w_view.y))
    # A comparison with NaN is false.
    numbers = (dr.select(dr.abs(x) >= LEAST, x, 0) for x in numbers)
    a, b, c, d = (dr.reinterpret_array(mi.UInt32, x) for x in numbers)
    a, b, c, d = (x * 1664525 + 1013904223 for x in (a, b, c, d))
    for last in (False, True):
        a = a + b * d
        b = b + c * a
        c = c + a * b
        d = d + b * c
        if not last:
            a, b, c, d = (x ^ (x >> 16) for x in (a, b, c, d))
    return mi.Float(a >> 8) * 2.0**-24


def refuse_gradients(values: Iterable[JitArray]) -> None:
    """InputError where one of some values has a gradient."""
    if any(dr.grad_enabled(value) for value in values):
        raise InputError(
            "gradients need all neighbours of a lookup",
            field="interpolation",
            got="'drawn'",
            expected="blended",
        )
