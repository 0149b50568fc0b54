"""What a representation is: anything with these methods satisfies it; there is no base class to derive from."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Representation(Protocol):
    """A compressed BTF: maps, a definition in float64, and what the ports read.

    Attributes
    ----------
    meta : dict
        JSON-able facts. ``method``: key; ``filter_type``: "nearest" or "bilinear"; ``texels``: (rows, columns);
        ``views``, ``lights``: {"name", "count"}; ``parameters``: of the fit; ``parent``: attributes of the sampled
        BTF; ``versions``; ``constants``: scalars that become GLSL defines.
    """

    meta: dict[str, Any]

    def evaluate(self, uv, w_light, w_view, *, lod=0.0) -> np.ndarray:
        """Value B in 1/sr, cosine included.

        Parameters
        ----------
        uv : array_like, shape (..., 2)
        w_light, w_view : array_like, shape (..., 3)
            Unit vectors in the local frame; the leading shapes broadcast.
        lod : float
            Level of detail, 0 = finest, a step for each halving of the resolution; methods without levels ignore it,
            those with levels also take one value a lookup.

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Linear Rec. 709. Exactly 0 where a direction is below the horizon or not finite. Lossy methods may
            return small negative values; hosts count them and never clamp in silence.
        """

    def arrays(self) -> dict[str, np.ndarray]:
        """All maps, float16, float32, uint32 or uint8 (value code / 255), last axis = channels.

        Their names are the parts of the file.
        """

    def port_arrays(self) -> dict[str, np.ndarray]:
        """The maps as the ports read them: last axis a multiple of 4, what one lookup needs contiguous.

        Their names are those of samplers and of Mitsuba's parameters; several maps may become one.
        """

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Guide of importance sampling.

        Returns
        -------
        group : ndarray of uint32, shape (rows, columns)
            Group of each texel.
        mean : ndarray of float, shape (n_groups, n_views, n_lights)
            Mean luminance of B of the group's texels.
        """

    @classmethod
    def from_arrays(cls, arrays, meta) -> Representation:
        """The representation whose :meth:`arrays` and ``meta`` these are."""
