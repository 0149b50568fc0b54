"""Image-based light of the methods that store functions of the light: tables for shaders, and the same in float64.

Source: Meseth, Müller, Klein 2004, section 5.2. Differs from it in the foreshortening: their lobes multiply (n · l),
approximated by (n · t); ours hold it. What lies below the local horizon, which a lobe over the sphere sees and the BTF
does not, is cut off: the rest is looked up as two lobes that have its integral and its centroid
(:func:`btfref.rendering.environment_light.prefilter.clipped_lobes`), and what is small and bright is no part of the
maps (:mod:`btfref.rendering.environment_light.split_light`).

A class a method, found by the registry: ``SHADER`` provides ``btf_environment``, ``tables`` what it reads, and
``radiance`` the same in float64, from the same tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.numerics.powers import FLOOR, safe_power
from btfref.rendering.environment_light import prefilter
from btfref.rendering.environment_light.prepared import Stencil, by_stencils
from btfref.rendering.environment_light.split_light import split_light, unsplit
from btfref.representations.analytic import lafortune, rf_lobes, rf_poly
from btfref.representations.analytic.lafortune import flat_maps
from btfref.representations.analytic.light_functions import held
from btfref.representations.analytic.rf_lobes import parabolic_axis

if TYPE_CHECKING:
    from btfref.rendering.environment_light.split_light import Cells, SplitLight
    from btfref.representations.protocol import Representation
    from btfref.scene.environment import Environment


class _PrefilteredLobes:
    """What the methods share whose lobes look into prefiltered maps."""

    #: Whether a lobe multiplies the light's cosine.
    cosine = False

    @classmethod
    def split(cls, representation: Representation, environment: Environment) -> SplitLight:
        """What is filtered and what becomes lights: a `SplitLight`."""
        edge = representation.meta["constants"]["light_edge"]
        return split_light(environment, edge, cosine=cls.cosine)

    @classmethod
    def tables(
        cls,
        representation: Representation,
        environment: Environment | Cells,
        *,
        size: int = prefilter.SIZE,
        slices: int = prefilter.SLICES,
    ) -> dict[str, np.ndarray]:
        """Maps of the environment.

        Parameters
        ----------
        representation : Representation
        environment : btfref.scene.environment.Environment or btfref.rendering.environment_light.split_light.Cells
        size : int
            Texels a side of a parabolic map.
        slices : int
            Sampled exponents 2^(i/2), at least 2.

        Returns
        -------
        dict of str to ndarray of float32
            ``environment_maps`` [2 slices, size, size, 3], ``clipped_lobes`` [slices, heights, 4].
        """
        edge = representation.meta["constants"]["light_edge"]
        return {
            "environment_maps": prefilter.lobe_maps(environment, size=size, slices=slices),
            "clipped_lobes": prefilter.clipped_lobes(edge, cosine=cls.cosine),
        }


class Lobes(_PrefilteredLobes):
    """``rf_lobes``: ``ρ_d D(n) + Σ peak S(axis, n)`` by view."""

    SHADER = "environment/rf_lobes.glsl"

    @classmethod
    def radiance(
        cls,
        representation: rf_lobes.Representation,
        tables: Mapping[str, np.ndarray],
        uv: ArrayLike,
        w_view: ArrayLike,
        to_world: ArrayLike,
    ) -> np.ndarray:
        """See :func:`radiance`."""
        lobes = representation.maps["lobes"]
        lobes = lobes.reshape(-1, lobes.shape[2], lobes.shape[3] // 4, 4)
        colour = representation.maps["colour"].reshape(-1, 4).astype(float)
        maps, clipped = tables["environment_maps"], tables["clipped_lobes"]

        def kernel(texel: Stencil, view: Stencil, w_view: np.ndarray, frame: np.ndarray) -> np.ndarray:
            at = lobes[texel[0][:, :, None], view[0][:, None, :]].astype(float)
            s, t, exponent, peak = np.moveaxis(at, -1, 0)
            axis, to_world = parabolic_axis(s, t), frame[:, None, None, None]
            lobe = prefilter.lobe_lookup(maps, clipped, axis, to_world, np.maximum(exponent, 1))
            value = np.einsum("ntvk,ntvkc,nv->ntc", peak, lobe, view[1])
            value += colour[texel[0]][..., 3:] * _irradiance(maps, frame)[:, None]
            return np.einsum("nt,ntc,ntc->nc", texel[1], value, colour[texel[0]][..., :3])

        return by_stencils(representation, kernel, uv, w_view, to_world)


class Lafortune(_PrefilteredLobes):
    """``lafortune``: for a view, lobes along ``C v`` times the light's cosine, which the share holds.

    ``lafortune_lut``: times the factor of the view as well.
    """

    SHADER = "environment/lafortune.glsl"
    cosine = True

    @classmethod
    def radiance(
        cls,
        representation: lafortune.Representation,
        tables: Mapping[str, np.ndarray],
        uv: ArrayLike,
        w_view: ArrayLike,
        to_world: ArrayLike,
    ) -> np.ndarray:
        """See :func:`radiance`."""
        flat = flat_maps(representation.maps)
        maps, clipped = tables["environment_maps"], tables["clipped_lobes"]
        edge = representation.meta["constants"]["view_edge"]

        def kernel(texel: Stencil, view: Stencil, w_view: np.ndarray, frame: np.ndarray) -> np.ndarray:
            lobes = flat["lobes"][texel[0]]
            t = lobes[..., :3] * held(w_view, edge)[0][:, None, None]
            size, exponent = np.linalg.norm(t, axis=-1), lobes[..., 3]
            axis = t / np.maximum(size, FLOOR)[..., None]
            to_world = frame[:, None, None]
            lobe = prefilter.lobe_lookup(maps, clipped, axis, to_world, np.maximum(exponent, 1))
            value = np.einsum("ntk,ntkc->ntc", flat["peaks"][texel[0]] * safe_power(size, exponent), lobe)
            value += flat["colour"][texel[0]][..., 3:] * _irradiance(maps, frame)[:, None]
            if "factor" in flat:
                factor = flat["factor"][texel[0][:, :, None], view[0][:, None, :]]
                value *= np.einsum("ntv,nv->nt", factor, view[1])[..., None]
            return np.einsum("nt,ntc,ntc->nc", texel[1], value, flat["colour"][texel[0]][..., :3])

        return by_stencils(representation, kernel, uv, w_view, to_world)


class Polynomials:
    """``rf_poly``: coefficients times the environment's moments about the normal; exact but for the map's texels."""

    SHADER = "environment/rf_poly.glsl"

    @classmethod
    def split(cls, representation: Representation, environment: Environment) -> SplitLight:
        """Nothing is taken out: moments hold small lights as well as broad ones."""
        return unsplit(environment)

    @classmethod
    def tables(
        cls, representation: Representation, environment: Environment | Cells, *, size: int = prefilter.SIZE
    ) -> dict[str, np.ndarray]:
        """``environment_moments`` [18, size, size, 3]; see :func:`prefilter.moment_maps`."""
        edge = representation.meta["constants"]["light_edge"]
        return {"environment_moments": prefilter.moment_maps(environment, edge, size=size)}

    @classmethod
    def radiance(
        cls,
        representation: rf_poly.Representation,
        tables: Mapping[str, np.ndarray],
        uv: ArrayLike,
        w_view: ArrayLike,
        to_world: ArrayLike,
    ) -> np.ndarray:
        """See :func:`radiance`."""
        polynomial = representation.maps["polynomial"]
        polynomial = polynomial.reshape(-1, *polynomial.shape[2:])
        chroma = representation.maps["chroma"].reshape(-1, 3).astype(float)
        maps = tables["environment_moments"]

        def kernel(texel: Stencil, view: Stencil, w_view: np.ndarray, frame: np.ndarray) -> np.ndarray:
            xx, yy, zz, xy, xz, yz, x, y, z = (
                prefilter.map_lookup(maps, np.full(len(frame), i), frame[:, :, 2]) for i in range(9)
            )
            rows = [np.stack(row, 1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
            second, first = np.stack(rows, 1), np.stack([x, y, z], 1)
            s, t, n = np.moveaxis(frame, 2, 0)
            both = lambda a, b: np.einsum("ni,nijc,nj->nc", a, second, b)  # noqa: E731
            one = lambda a: np.einsum("ni,nic->nc", a, first)  # noqa: E731
            moments = np.stack([both(s, s), both(t, t), both(s, t), one(s), one(t), both(n, n)], 1)
            at = polynomial[texel[0][:, :, None], view[0][:, None, :]].astype(float)
            coefficient = np.einsum("ntvk,nv->ntk", at, view[1])
            value = np.einsum("ntk,nkc->ntc", coefficient, moments)
            return np.einsum("nt,ntc,ntc->nc", texel[1], value, chroma[texel[0]])

        return by_stencils(representation, kernel, uv, w_view, to_world)


def radiance(
    representation: Representation,
    tables: Mapping[str, np.ndarray],
    uv: ArrayLike,
    w_view: ArrayLike,
    to_world: ArrayLike,
) -> np.ndarray:
    """Radiance towards the viewer under the environment that ``tables`` hold, without the lights taken out of it.

    Parameters
    ----------
    representation : Representation
        Of a method with a prefiltered path.
    tables : dict of str to ndarray
        From the method's class.
    uv : array_like, shape (N, 2)
    w_view : array_like, shape (N, 3)
        Local frame.
    to_world : array_like, shape (N, 3, 3)
        Columns: the local axes x, y, z in world space.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        In W/(m² sr); 0 for views below the horizon.

    Raises
    ------
    InputError
        For a method without a prefiltered path.
    """
    from btfref.registry import image_light

    return image_light(representation.meta["method"]).radiance(representation, tables, uv, w_view, to_world)


def _irradiance(maps: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """The first slice is the cosine."""
    return np.pi * prefilter.map_lookup(maps, np.zeros(len(frame), int), frame[:, :, 2])
