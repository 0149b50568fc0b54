"""Shares of stages of the error waterfall that are measured on their own, at a few pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from btfref.comparison.colour import delta_e00
from btfref.comparison.significance import Interval, interval, rmse_interval
from btfref.comparison.waterfall import CONFIDENCE
from btfref.images.display import Display
from btfref.types import Facts


@dataclass(frozen=True)
class StagePart:
    """A share of a stage that is measured on its own, at some of the pixels; see :func:`part`.

    Parameters
    ----------
    name, of : str
        The part and its stage.
    rmse, delta_e00 : Interval
        They hold the choice of pixels.
    pixels : int
    beside : bool
        Not a share of the stage, but the same step by another renderer.
    """

    name: str
    of: str
    rmse: Interval
    delta_e00: Interval
    pixels: int
    beside: bool = False

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {**vars(self), "rmse": self.rmse.to_dict(), "delta_e00": self.delta_e00.to_dict()}


def part(
    name: str, of: str, test: ArrayLike, reference: ArrayLike, display: Display, *, beside: bool = False
) -> StagePart:
    """A part of a stage from pictures without noise at pixels that were drawn at random, or at all.

    Parameters
    ----------
    name, of : str
    test, reference : array, shape (pixels, 3)
    display : btfref.comparison.Display
    beside : bool

    Returns
    -------
    StagePart
    """
    square = np.mean((np.asarray(test, float) - reference) ** 2, 1)
    difference, n = delta_e00(test, reference, display), max(len(square), 2)
    mse, colour = (
        interval(x.mean(), x.std() / np.sqrt(n - 1), confidence=CONFIDENCE, freedom=n - 1)
        for x in (square, difference)
    )
    return StagePart(name, of, rmse_interval(mse), colour, len(square), beside)
