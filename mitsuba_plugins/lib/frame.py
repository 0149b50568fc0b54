"""Which way a texture runs on a surface: twin of `btfref.scene.hits` and of ``shaders/lib/surface/frame.glsl``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from btfref.types import JitArray


def hand_of(si: JitArray) -> JitArray:
    """Sign of det(∂p/∂u, ∂p/∂v, n): −1 where the texture is mirrored against the surface.

    Parameters
    ----------
    si : mitsuba.SurfaceInteraction3f

    Returns
    -------
    mitsuba.Float
        By it Mitsuba's second tangent ``n × s`` becomes one that follows the texture. 1 where there are no derivatives.
    """
    if not dr.width(si.dp_du):  # a place that somebody made up, without derivatives
        return mi.Float(1)
    area = dr.cross(si.dp_du, si.dp_dv)
    return dr.select(dr.dot(area, si.sh_frame.n) < 0, mi.Float(-1), mi.Float(1))
