"""Numbers that a user may ask for, bounded before memory is: each limit with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from btfref.errors import InputError


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
