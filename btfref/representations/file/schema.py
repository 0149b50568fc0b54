"""What a method says of its maps and constants, so that one validator can check files of all methods.

A class of representations has ``schema(meta)``, a class method, which gives a :class:`Schema`
(:class:`btfref.representations.protocol.HasSchema`). Maps are described by their axes, such as
``"rows columns views 4*lobes"``: whole numbers, names of numbers, or ``a*name+b``. ``rows``, ``columns``, ``views`` and
``lights`` are known from the file; other names are bound where they first occur and hold for all maps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

#: Largest magnitude of a stored float32: products of three such numbers stay within float32, which ports compute in.
LARGEST = 1e12

FLOATS = ("float16", "float32")
CODES = (*FLOATS, "uint8")
INDICES = ("uint32",)

_AXIS = re.compile(r"(?:(\d+)\*)?([a-z_]+)(?:\+(\d+))?")


@dataclass(frozen=True)
class Range:
    """Finite numbers from `least` to `most`, integers alone where `whole`."""

    least: float
    most: float
    whole: bool = False

    def __str__(self) -> str:
        return f"{'a whole' if self.whole else 'a finite'} number in [{self.least:g}, {self.most:g}]"


@dataclass(frozen=True)
class OneOf:
    """One of a few values."""

    values: Sequence[object]

    def __str__(self) -> str:
        return " or ".join(map(repr, self.values))


@dataclass(frozen=True)
class Number:
    """The number of that name, which the shapes of maps have bound."""

    name: str

    def __str__(self) -> str:
        return f"the number of {self.name} in the maps"


@dataclass(frozen=True)
class Edge:
    """The smallest cosine of a table of directions; 0 where that is not above `floor`.

    Attributes
    ----------
    kind : {"view", "light"}
    floor : float
    """

    kind: str
    floor: float = 1e-6

    def __str__(self) -> str:
        return f"the smallest cosine of {self.kind}_directions"


#: What is known of a constant.
Constant = Range | OneOf | Number | Edge


@dataclass(frozen=True)
class MapSchema:
    """One map.

    Attributes
    ----------
    axes : str
        See the module.
    kinds : tuple of str
        Types it may have.
    least, most : float
        Of its values.
    parts : dict of (int, int) to Range
        Of every n-th channel from a first one on, in place of `least` and `most`: (first, n).
    below : tuple of str
        Of an index map: the maps whose first axis its channels are indices of, one for all or one each.
    absent : bool
        Whether NaN marks what a partial file lacks.
    optional : bool
        Whether it may be missing.
    """

    axes: str
    kinds: tuple[str, ...] = FLOATS
    least: float = -LARGEST
    most: float = LARGEST
    parts: Mapping[tuple[int, int], Range] = field(default_factory=dict)
    below: tuple[str, ...] = ()
    absent: bool = False
    optional: bool = False


@dataclass(frozen=True)
class Schema:
    """All maps of a method, but for the tables of directions, and all its constants.

    Attributes
    ----------
    maps : dict of str to MapSchema
    constants : dict of str to Constant
        Others are refused: a constant becomes a macro of the shader.
    numbers : dict of str to int
        Numbers that are known beforehand.
    optional : tuple of str
        Constants that may be missing.
    """

    maps: Mapping[str, MapSchema]
    constants: Mapping[str, Constant] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)
    optional: tuple[str, ...] = ()


def bound(axes: str, shape: Sequence[int], numbers: dict[str, int]) -> bool:
    """Whether a shape has these axes; names that are not in `numbers` are added to it.

    Parameters
    ----------
    axes : str
    shape : sequence of int
    numbers : dict of str to int

    Returns
    -------
    bool
    """
    wanted = axes.split()
    if len(wanted) != len(shape):
        return False
    for axis, n in zip(wanted, shape, strict=True):
        if axis.isdecimal():
            if n != int(axis):
                return False
            continue
        found = _AXIS.fullmatch(axis)
        assert found, axis
        factor, name, more = int(found[1] or 1), found[2], int(found[3] or 0)
        if name not in numbers:
            if n - more < 1 or (n - more) % factor:
                return False
            numbers[name] = (n - more) // factor
        if n != factor * numbers[name] + more:
            return False
    return True
