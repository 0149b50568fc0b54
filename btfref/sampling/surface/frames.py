"""Frames and materials that many points share: one table of pairs of directions then serves all of them.

A flat facet has one frame wherever it is met, and a BSDF without textures is the same everywhere: what it sends from a
light to a view is one number for thousands of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import packed, to_device

if TYPE_CHECKING:
    from btfref.sampling.surface.lobes import BroadLobes
    from btfref.sampling.surface.walks import Lights, Surface
    from btfref.types import JitArray

#: Points that must share a frame to have a table, and the most tables.
LEAST, MOST = 64, 32

#: Steps of 1: frames that agree in all rounded components are one.
STEPS = 1e6

#: Set in the code of a record with a table; the other bits are the table's number then.
SHARED = 1 << 31

#: Mitsuba's BSDFs whose parameters, all of them, are among those that `mi.traverse` lists.
_KNOWN = ("SmoothDiffuse", "RoughPlastic", "RoughConductor", "Principled")


def uniform(bsdf: JitArray) -> bool:
    """Whether a BSDF is surely the same at all texture coordinates.

    Parameters
    ----------
    bsdf : mitsuba.BSDF

    Returns
    -------
    bool
    """
    import mitsuba as mi

    if not str(bsdf).startswith(_KNOWN):
        return False
    # Of what is nested only the one value of a uniform texture: others have data, scales or transforms.
    return all(
        "." not in key or (key.count(".") == 1 and key.endswith(".value")) for key in mi.traverse(bsdf).keys()
    )


class SharedFrames:
    """Which records share a frame, and what they send from lights to views.

    Parameters
    ----------
    surface : Surface
    n_points : int
        Records that are points, the first ones: they alone decide which frames have tables, so that parts of a BTF,
        whose other records differ, look up what the whole does.
    lobes : BroadLobes

    Attributes
    ----------
    code : mitsuba.UInt32
        Per record: number of a table with `SHARED`, else that of its BSDF as Dr.Jit knows it, or 0 where there is
        nothing to evaluate beside the broad lobe.
    count : int
        Tables.
    """

    def __init__(self, surface: Surface, n_points: int, lobes: BroadLobes) -> None:
        import mitsuba as mi

        code = surface.number.numpy().astype(np.uint32)
        flat = np.isin(code, [number for number, same in lobes.uniform.items() if same])
        frames = np.concatenate([np.array(surface.shading), np.array(surface.s)])
        rounded = np.round(frames.astype(np.float64) * STEPS).astype(np.int64)
        key = code.astype(np.uint64)
        for row in rounded:
            # Sums of products modulo 2^64; two frames of one key are as likely as any two numbers to be equal.
            key = (key ^ (key >> np.uint64(29))) * np.uint64(0x9E3779B97F4A7C15) + row.astype(np.uint64)
        several, first, times = np.unique(
            key[:n_points][flat[:n_points]], return_index=True, return_counts=True
        )
        order = np.argsort(-times, kind="stable")[:MOST]
        order = np.sort(order[times[order] >= LEAST])
        chosen = np.flatnonzero(flat[:n_points])[first[order]]
        place = np.minimum(np.searchsorted(several[order], key), max(len(order) - 1, 0))
        silent = np.isin(code, lobes.silent)
        self.count = len(order)
        self._number = code[chosen]
        # From the rounded numbers: which of its records comes first does not matter.
        self._shading, self._s = rounded[:3, chosen] / STEPS, rounded[3:, chosen] / STEPS
        if self.count:
            code = np.where(
                flat & (several[order][place] == key), place.astype(np.uint32) | np.uint32(SHARED), code
            )
        self.code = to_device(mi.UInt32, np.where(silent, 0, code))

    def table(self, views: np.ndarray, lights: Lights, context: JitArray) -> JitArray:
        """BSDF times cosine of all tables: [table, view, light, 4], the fourth number unused.

        Parameters
        ----------
        views : ndarray (n, 3)
        lights : Lights
        context : mitsuba.BSDFContext
        """
        import drjit as dr
        import mitsuba as mi

        lane = dr.arange(mi.UInt32, self.count * len(views) * lights.count)
        light, rest = lane % lights.count, lane // lights.count
        which, view = rest // len(views), rest % len(views)
        shading, s = (
            dr.gather(mi.Vector3f, to_device(mi.Float, rows.T), which) for rows in (self._shading, self._s)
        )
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
        si.sh_frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
        si.n = si.sh_frame.n
        si.wi = si.to_local(dr.gather(mi.Vector3f, to_device(mi.Float, views), view))
        bsdf = dr.reinterpret_array(
            mi.BSDFPtr, dr.gather(mi.UInt32, to_device(mi.UInt32, self._number), which)
        )
        value = bsdf.eval(context, si, si.to_local(dr.gather(mi.Vector3f, lights.vectors, light)))
        return packed([*value, dr.zeros(mi.Float, dr.width(lane))])


def silent_beside_diffuse(bsdfs: Sequence[JitArray], ids: Sequence[int]) -> list[int]:
    """Numbers of the BSDFs that are a diffuse lobe and nothing else."""
    import mitsuba as mi

    others = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
    return [number for bsdf, number in zip(bsdfs, ids, strict=True) if not bsdf.flags() & others]
