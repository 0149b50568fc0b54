"""Both renderers against the witness."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.comparison.comparison import agreement
from btfref.comparison.metrics import relative_error
from btfref.gates.tolerances import tolerance
from btfref.representations.protocol import Spreads
from btfref.validate.witness.caster import cast
from btfref.validate.witness.scene import GRID, WitnessScene

if TYPE_CHECKING:
    from btfref.gates.verdicts import GateResult
    from btfref.types import PathLike

GATE = "image.witness"


@dataclass(frozen=True, eq=False)
class Testimony:
    """The witness's picture and those of both renderers, at the pixels that can be judged.

    Attributes
    ----------
    expected : ndarray of float64, shape (N, 3)
    images : dict of str to ndarray of float32, shape (N, 3)
        By renderer.
    allowance : ndarray of float64, shape (N, 3)
        What the definition itself changes by within the rounding of a hit: silhouettes of a height field are jumps.
    """

    expected: np.ndarray
    images: dict[str, np.ndarray]
    allowance: np.ndarray

    def gates(self) -> list[GateResult]:
        """``image.witness`` of each renderer; the detail says whose."""
        found = []
        for name, image in self.images.items():
            judged = agreement(image, self.expected, gate=GATE, allowance=self.allowance).gates
            found += [
                replace(one, detail=f"{name}{': ' if one.detail else ''}{one.detail}") for one in judged
            ]
        return found

    def between(self) -> tuple[GateResult, ...]:
        """``image.noise_free`` of one renderer against the other: what they can tell without a witness."""
        first, second = self.images.values()
        return agreement(second, first, gate="image.noise_free", allowance=self.allowance).gates


def testify(path: PathLike) -> Testimony:
    """Draw the witness's scene with a representation in all three ways.

    Parameters
    ----------
    path : path-like
        A representation.

    Returns
    -------
    Testimony
    """
    from btfref import representations
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.reference import render

    representation, scene = representations.load(path), WitnessScene()
    with tempfile.TemporaryDirectory() as folder:
        lookups = cast(scene, Path(folder))
        sure, expected = lookups.sure, lookups.picture(representation.evaluate)
        dictionary = scene.dictionary(Path(folder), path)
        images = {
            "Mitsuba": render(dictionary, grid=GRID, shadows=False).image,
            "OpenGL": realtime(dictionary, grid=GRID, shadows=False).image,
        }
    allowance = np.zeros_like(expected)
    if isinstance(representation, Spreads):
        # Where all agree anyway nothing is needed, and nothing is allowed.
        errors = [relative_error(image, expected) for image in images.values()]
        beyond = (np.max(errors, 0) > tolerance(f"{GATE}.p999")) & sure
        if beyond.any():
            allowance = lookups.picture(representation.spread, beyond)
    return Testimony(expected[sure], {name: image[sure] for name, image in images.items()}, allowance[sure])
