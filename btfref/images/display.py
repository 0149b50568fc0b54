"""Linear radiance on a display: exposure, clipping, sRGB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from btfref.numerics.colour import encode_srgb
from btfref.types import Facts


@dataclass(frozen=True)
class Display:
    """How linear radiance is shown: scaled, clipped to [0, 1], encoded as sRGB.

    Parameters
    ----------
    stops : float
        The radiance is multiplied by 2 to the power of this.
    """

    stops: float = 0.0

    def linear(self, image: ArrayLike) -> np.ndarray:
        """Displayed light in [0, 1] of linear radiance, same shape, float64; non-finite values become 0."""
        scaled = np.nan_to_num(np.asarray(image, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        return np.clip(scaled * 2.0**self.stops, 0.0, 1.0)

    def encoded(self, image: ArrayLike) -> np.ndarray:
        """Values in [0, 1] encoded as sRGB, same shape, float64."""
        return encode_srgb(self.linear(image))

    def to_dict(self) -> Facts:
        """JSON-able description."""
        return {"stops": self.stops, "curve": "scale, clip to [0, 1], sRGB"}


def fit_display(reference: ArrayLike, mask: np.ndarray | None = None) -> Display:
    """A display that shows a picture well: its 99th percentile, taken over lit pixels, comes to 0.9.

    Parameters
    ----------
    reference : (H, W, 3) array
        Linear radiance. Only the reference decides, so that a wrong test image cannot choose a kind exposure.
    mask : (H, W) bool array, optional
        Pixels that count.

    Returns
    -------
    Display
        Rounded to a quarter stop; 0 stops for a black picture.
    """
    peak = np.nan_to_num(np.asarray(reference, np.float64), nan=0.0, posinf=0.0, neginf=0.0).max(axis=-1)
    lit = peak[peak > 0] if mask is None else peak[(peak > 0) & mask]
    if lit.size == 0:
        return Display(0.0)
    return Display(float(np.round(4 * np.log2(0.9 / np.percentile(lit, 99))) / 4))
