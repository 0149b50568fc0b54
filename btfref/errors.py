"""Errors that a user can mend, which the command line turns into one line and exit status 2, and limits of what can be
asked for: numbers are bounded before memory is, each limit with its reason.
"""  # noqa: D205

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.types import PathLike


class BtfrefError(Exception):
    """Base class of the errors that btfref raises on purpose."""


class InputError(BtfrefError, ValueError):
    """A file or an argument that cannot be used.

    Parameters
    ----------
    message : str
        What is wrong, in one line.
    file : path-like, optional
        The file that holds the offending value.
    field : str, optional
        The attribute, option, header field or plugin parameter.
    got, expected : object, optional
        The value found and the value (or set of values) wanted.
    """

    def __init__(
        self,
        message: str,
        *,
        file: PathLike | None = None,
        field: str | None = None,
        got: object = None,
        expected: object = None,
    ) -> None:
        self.message, self.file, self.field, self.got, self.expected = message, file, field, got, expected
        parts = [f"{file}: {message}" if file is not None else message]
        if field is not None:
            parts.append(f"field '{field}'")
        if got is not None:
            parts.append(f"got {got}")
        if expected is not None:
            parts.append(f"expected {expected}")
        super().__init__("; ".join(" ".join(str(part).split()) for part in parts))


class MissingDependencyError(BtfrefError):
    """Something that the machine lacks, with the command that brings it.

    Parameters
    ----------
    what : str
        The library or program that is missing and what needs it.
    mend : str
        What to install or set.
    """

    def __init__(self, what: str, mend: str) -> None:
        self.what, self.mend = what, mend
        super().__init__(f"{what}; {mend}")


@dataclass(frozen=True)
class Limit:
    """The largest number of something.

    Attributes
    ----------
    most : int
    reason : str
        Why not more, for the message.
    """

    most: int
    reason: str

    def __str__(self) -> str:
        return f"at most {self.most}: {self.reason}"


#: Pixels of a picture.
PIXELS = Limit(1 << 26, "a picture of 8192 × 8192 takes 6 GB while it is made")

#: Cells along one side of the regular grid in a pixel.
GRID = Limit(256, "that is 65 536 samples a pixel")

#: Samples of a pixel, or of a texel and view.
SAMPLES = Limit(1 << 20, "noise then is a thousandth of that of one sample")

#: Directions of a set.
DIRECTIONS = Limit(1 << 16, "a texel alone would have 2³² pairs of them")

#: Indices of views, lights, tiles.
INDICES = Limit(1 << 20, "no sampled BTF has as many")

#: Texels along a side.
TEXELS = Limit(1 << 14, "indices of texels stay below 2³²")

#: Seeds of random numbers.
SEED = Limit(2**32 - 1, "random numbers of renderers take 32 bits")

#: Processes.
WORKERS = Limit(1024, "each holds the scene")

#: Whatever counts something else.
COUNT = Limit(2**31 - 1, "numbers are kept in 32 bits")


def refuse_above(limit: Limit, number: int, field: str) -> None:
    """InputError for a number above its limit."""
    if number > limit.most:
        raise InputError("more than can be asked for", field=field, got=number, expected=limit)


def refuse_large_picture(size: tuple[int, int], field: str = "size") -> None:
    """InputError for a picture with more pixels than :data:`PIXELS`.

    Parameters
    ----------
    size : (int, int)
        Width and height.
    field : str
    """
    width, height = size
    if width * height > PIXELS.most:
        raise InputError("a picture is too large", field=field, got=f"{width}x{height}", expected=PIXELS)
