"""Rendering: offline by Mitsuba, in real time by OpenGL, light from environments; and what every renderer returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from btfref.types import Facts


@dataclass(frozen=True)
class RenderResult:
    """A rendered image.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, 3)
        Linear Rec. 709 radiance, row 0 at the top.
    variance : ndarray of float32, shape (H, W, 3), or None
        Of the mean, per pixel and channel; None where nothing is random or it was not asked for.
    meta : dict
        JSON-able facts: renderer, settings, versions, times.
    pictures : ndarray of float32, shape (n, H, W, 3), or None
        Independent pictures whose mean is the image, of renderers that keep them.
    """

    image: np.ndarray
    variance: np.ndarray | None = None
    meta: Facts = field(default_factory=dict)
    pictures: np.ndarray | None = None

    @property
    def batches(self) -> np.ndarray:
        """The independent pictures, of a result that must have them."""
        if self.pictures is None:
            raise ValueError("the renderer kept no independent pictures")
        return self.pictures
