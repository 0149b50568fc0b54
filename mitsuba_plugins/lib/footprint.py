"""Level of detail of a surface interaction: port of :mod:`btfref.numerics.footprint`.

Stock integrators compute no texture derivatives (``path`` drops ray differentials, and JIT variants find the fields
present but zero), so the pixel's cone stands in for them: its angle and apex come from the scene's camera, which
:mod:`btfref.rendering.offline.reference` sets through ``mi.traverse``, or from the material's parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.numerics.footprint import ANISOTROPY, BLUR, TINY

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from btfref.types import JitArray


class LevelOfDetail:
    """λ of an interaction.

    Parameters
    ----------
    mode : {"auto", "distance", "none"}
        "auto": texture derivatives of the integrator where there are any, else the pixel's cone.
    bias : float
        Added to λ.
    unit : float
        Distance at which λ = 0 in mode "distance".
    pixel_angle : float
        That a pixel (or sample) subtends, in radians; 0 where it is not known: λ = 0.
    camera : array_like of 3 floats, or None
        Apex of the cones; None: the origin of the ray.
    affine : list
        Two rows of the transform of texture coordinates.
    texels : (int, int)
        Rows and columns of level 0.
    """

    def __init__(
        self,
        mode: str,
        bias: float,
        unit: float,
        pixel_angle: float,
        camera: Sequence[float] | None,
        affine: list[list[float]],
        texels: tuple[int, int],
    ) -> None:
        self.mode, self.bias = mode, float(bias)
        # Data, not code: a moved camera needs no new kernel.
        self.pixel_angle = mi.Float(float(pixel_angle))
        self.camera = mi.Point3f([np.nan] * 3 if camera is None else [float(x) for x in camera])
        dr.make_opaque(self.pixel_angle, self.camera)
        self.inverse_unit = 1 / float(unit)
        self.texels = rows, columns = texels
        self.affine = [
            [float(a) * n for a in row[:2]] for row, n in zip(affine, (columns, rows), strict=True)
        ]

    def __call__(self, si: JitArray) -> dict[str, JitArray]:
        """Level of detail and the lookups along the footprint.

        Returns
        -------
        dict
            Arguments of an evaluator with levels: ``lod``, before it is clamped to the levels that there are, never
            NaN; ``step`` between lookups, in texture coordinates, and ``ratio``, unless there is only one.
        """
        if self.mode == "none":
            return {"lod": mi.Float(self.bias)}
        distance = dr.norm(si.p - self.camera)
        # Comparisons with NaN are false: without a camera the ray's own length counts.
        distance = dr.select(distance >= 0, distance, si.t)
        if self.mode == "distance":
            return {"lod": self.bias + dr.log2(dr.clip(distance * self.inverse_unit, TINY, 1e30))}
        partial_u, partial_v = (
            mi.Vector2f(a[0] * si.duv_dx.x + a[1] * si.duv_dx.y, a[0] * si.duv_dy.x + a[1] * si.duv_dy.y)
            for a in self.affine
        )
        given = dr.squared_norm(partial_u), dr.dot(partial_u, partial_v), dr.squared_norm(partial_v)
        there = given[0] + given[2] > 0
        square = dr.square(dr.select(distance < 1e18, distance * self.pixel_angle, 0))
        pairs = zip(given, self._slanted(si), strict=True)
        lod, step, ratio = ellipse_footprint(*(dr.select(there, a, square * b) for a, b in pairs))
        rows, columns = self.texels
        return {"lod": self.bias + lod, "step": mi.Vector2f(step.x / columns, step.y / rows), "ratio": ratio}

    def _slanted(self, si: JitArray) -> tuple[JitArray, JitArray, JitArray]:
        """Squared axes in texels of a unit disk across the ray, as the surface stretches it."""
        dp_du, dp_dv = mi.Vector3f(si.dp_du), mi.Vector3f(si.dp_dv)
        e, f, g = dr.squared_norm(dp_du), dr.dot(dp_du, dp_dv), dr.squared_norm(dp_dv)
        area = e * g - f * f
        known = area > 0
        inverse = dr.select(known, 1 / dr.select(known, area, 1), 0)
        of_u, of_v = (dp_du * g - dp_dv * f) * inverse, (dp_dv * e - dp_du * f) * inverse
        u, v = (a[0] * of_u + a[1] * of_v for a in self.affine)
        w = si.to_world(si.wi)
        along_u, along_v, cosine = dr.dot(u, w), dr.dot(v, w), dr.dot(w, si.n)
        stretch = 1 / dr.maximum(cosine * cosine, TINY)
        return (
            dr.fma(along_u * along_u, stretch, dr.squared_norm(u)),
            dr.fma(along_u * along_v, stretch, dr.dot(u, v)),
            dr.fma(along_v * along_v, stretch, dr.squared_norm(v)),
        )

    def traverse(self, callback: JitArray) -> None:
        """Expose what changes with the camera."""
        if self.mode != "none":
            callback.put("pixel_angle", self.pixel_angle, mi.ParamFlags.NonDifferentiable)
            callback.put("camera", self.camera, mi.ParamFlags.NonDifferentiable)


def ellipse_footprint(uu: JitArray, uv: JitArray, vv: JitArray) -> tuple[JitArray, JitArray, JitArray]:
    """As :func:`btfref.numerics.footprint.ellipse_footprint`."""
    # Far beyond any texture, but products of two stay finite.
    uu, uv, vv = (dr.clip(a, -1e15, 1e15) for a in (uu, uv, vv))
    difference = 0.5 * (uu - vv)
    longer = dr.maximum(0.5 * (uu + vv) + dr.sqrt(dr.fma(difference, difference, uv * uv)), TINY)
    shorter = dr.maximum(uu * vv - uv * uv, TINY) / longer
    ratio = dr.sqrt(dr.clip(longer / dr.maximum(shorter, TINY), 1, ANISOTROPY**2))
    square = longer / (ratio * ratio)
    across = uu >= vv
    axis = mi.Vector2f(dr.select(across, longer - vv, uv), dr.select(across, uv, longer - uu))
    step = axis * dr.sqrt(square / dr.maximum(dr.squared_norm(axis), TINY))
    return 0.5 * dr.log2(1 + square * (1 / BLUR)), step, ratio


def probes(ratio: JitArray) -> tuple[JitArray, Callable[[JitArray], JitArray]]:
    """Lookups along a footprint: how many on each side of the middle, and a function that weighs the j-th."""
    half = 0.5 * ratio

    def weight(j: JitArray) -> JitArray:
        return dr.clip(half + 0.5 - dr.abs(mi.Float(j)), 0, 1) / ratio

    return mi.Int32(dr.ceil(half - 0.5)), weight
