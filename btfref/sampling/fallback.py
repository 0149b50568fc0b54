"""Where the shared estimator does not apply, the path estimator takes its place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.mesostructure import Part
    from btfref.types import JitArray


def reason_against_surface(bsdfs: Sequence[JitArray], parts: Sequence[Part] = ()) -> str | None:
    """Why the estimator ``surface`` cannot be used; None where it can.

    Its points scatter light on the side it came from, with BSDFs that can be evaluated: light that passes
    through a surface, mirrors and masks are left to paths. So is what is looked up at vertices: its points know one
    set of texture coordinates.

    Parameters
    ----------
    bsdfs : list of mitsuba.BSDF
        One per part; the variant they were loaded in is active.
    parts : sequence of Part

    Returns
    -------
    str or None
    """
    import mitsuba as mi

    kinds = {
        "a mask": mi.BSDFFlags.Null,
        "transmission": mi.BSDFFlags.Transmission,
        "a mirror": mi.BSDFFlags.Delta,
    }
    for index, bsdf in enumerate(bsdfs):
        for name, flag in kinds.items():
            if mi.has_flag(bsdf.flags(), flag):
                return f"part {index} has {name}"
    for index, part in enumerate(parts):
        if part.attributes:
            return f"part {index} looks up {', '.join(part.attributes)} of its vertices"
    return None
