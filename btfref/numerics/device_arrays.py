"""From NumPy to Dr.Jit, always at the same alignment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.types import JitArray

#: What Dr.Jit aligns its own arrays to, bytes.
ALIGNMENT = 64


def to_device(kind: type[Any], array: ArrayLike) -> JitArray:
    """A Dr.Jit array with a copy of a NumPy array.

    Dr.Jit's LLVM backend takes the memory of a NumPy array as it is, and compiles kernels anew for memory
    that is aligned differently: which of two kernels is needed would depend on what ``malloc`` happened to
    return.

    Parameters
    ----------
    kind : type
        Dr.Jit array type; a static vector type wants its components as rows.
    array : array_like, shape (n,) or (k, n)
        Converted to the type's kind of number.

    Returns
    -------
    kind
    """
    import drjit as dr

    array = np.asarray(array)
    if dr.depth_v(kind) > 1:
        return kind(*(to_device(dr.value_t(kind), row) for row in array))
    numbers = {
        dr.VarType.UInt8: np.uint8,
        dr.VarType.UInt32: np.uint32,
        dr.VarType.Float16: np.float16,
        dr.VarType.Float32: np.float32,
    }
    dtype = np.dtype(numbers[dr.type_v(kind)])
    memory = np.zeros(array.size * dtype.itemsize + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    aligned = memory[first : first + array.size * dtype.itemsize].view(dtype)
    aligned[:] = array.ravel()
    return kind(aligned)


def in_one_kernel(width: int, scatters: Callable[[], object]) -> None:
    """Run several scatters to the same array as one kernel.

    Dr.Jit evaluates an array with a pending scatter before the next one to it, and each of these kernels
    computes anew all that the scatters have in common. Inside a symbolic loop, here of one round, it does not.

    Parameters
    ----------
    width : int
        Number of lanes.
    scatters : callable
        Without arguments; what it captures must be of that width, or single numbers.
    """
    import drjit as dr
    import mitsuba as mi

    def step(k: JitArray) -> tuple[JitArray]:
        scatters()
        return (k + 1,)

    once = dr.opaque(mi.UInt32, 1)
    dr.while_loop((dr.zeros(mi.UInt32, width),), lambda k: k < once, step)


def packed(values: Sequence[JitArray]) -> JitArray:
    """Numbers of each lane side by side, so that one lookup of four costs about what one number costs alone.

    Parameters
    ----------
    values : list of Float
        A multiple of four, of one width; single numbers as well.

    Returns
    -------
    Float
        [lane, value].
    """
    import drjit as dr
    import mitsuba as mi

    width, count = max(map(dr.width, values)), len(values)
    result = dr.empty(mi.Float, width * count)
    dr.eval(values)
    lane = dr.arange(mi.UInt32, width)

    def write() -> None:
        for k, value in enumerate(values):
            dr.scatter(result, value, lane * count + k)

    in_one_kernel(width, write)
    dr.eval(result)
    return result


def unpacked(table: JitArray, index: JitArray, count: int, active: JitArray = True) -> list[JitArray]:
    """The numbers of some lanes of `packed`: a list of ``count``."""
    import drjit as dr
    import mitsuba as mi

    fours = [dr.gather(mi.Array4f, table, index * (count // 4) + k, active) for k in range(count // 4)]
    return [four[k] for four in fours for k in range(4)]
