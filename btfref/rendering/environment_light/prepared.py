"""A way to light a representation by an environment, made ready: what shaders read, and the same in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref import conventions
from btfref.numerics.sphere import interpolation
from btfref.representations.lookup import CHUNK
from btfref.types import Facts

if TYPE_CHECKING:
    from btfref.rendering.environment_light.light_set import LightSet
    from btfref.rendering.environment_light.transfer_light import TransferLight
    from btfref.representations.protocol import Representation

#: Values of B evaluated at a time in float64.
BLOCK = 1 << 18

#: ``evaluate(uv, w_light, w_view, point)``: B at some of the points, whose indices are ``point``.
Evaluate = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

#: Triangles (N,) and barycentric coordinates (N, 3) of the points.
Place = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]

#: ``radiance(uv, w_view, to_world, evaluate=…, place=…)`` in float64, shape (N, 3).
Radiance = Callable[..., np.ndarray]


#: Indices and weights of what an interpolation reads, each of shape (N, k).
Stencil = tuple[np.ndarray, np.ndarray]

#: ``kernel(texel, view, w_view, frame)``: radiance at some points, shape (N, 3).
Kernel = Callable[[Stencil, Stencil, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Prepared:
    """A way, ready for one representation.

    Parameters
    ----------
    path : str
        Its name.
    shader : str
        GLSL file with ``btf_environment``.
    tables : dict of str to ndarray
        That the file reads, beside the representation's own.
    radiance : callable
        ``(uv (N, 2), w_view (N, 3), to_world (N, 3, 3), *, evaluate=None, place=None) -> (N, 3)`` in float64.
        ``evaluate(uv, w_light, w_view, point)`` stands for the representation's own where points have levels of detail:
        ``point`` are their indices. ``place()`` is :meth:`btfref.scene.hits.Hits.place` of a mesh.
    facts : dict
        JSON-able: for the picture's ``meta``.
    constants : dict
        Of the GLSL file.
    passes : tuple of dict
        Uniforms of pictures that add up; one, without any, where a single picture does.
    bins : ndarray of int, shape (n + 1,), or None
        Where the triangles of each pass begin in the table ``bin_triangles``; None: all are drawn.
    transfer : btfref.rendering.environment_light.transfer_light.TransferLight or None
        What can be lit anew.
    """

    path: str
    shader: str
    tables: dict[str, np.ndarray]
    radiance: Radiance
    facts: Facts = field(default_factory=dict)
    constants: Facts = field(default_factory=dict)
    passes: tuple[Facts, ...] = ({},)
    bins: np.ndarray | None = None
    transfer: TransferLight | None = None


def lit(
    representation: Representation,
    found: LightSet,
    uv: np.ndarray,
    w_view: np.ndarray,
    to_world: np.ndarray,
    *,
    evaluate: Evaluate | None = None,
) -> np.ndarray:
    """Radiance under directional lights in float64, as ``shaders/lib/light/environment_lights.glsl`` sums it.

    Parameters
    ----------
    representation : Representation
    found : btfref.rendering.environment_light.light_set.LightSet
    uv : array_like, shape (N, 2)
    w_view : array_like, shape (N, 3)
        Local frame.
    to_world : array_like, shape (N, 3, 3)
        Columns: the local axes in world space.
    evaluate : callable, optional
        In place of the representation's own: see :class:`Prepared`.

    Returns
    -------
    ndarray of float64, shape (N, 3)
    """
    evaluate = evaluate or (lambda uv, w_light, w_view, _: representation.evaluate(uv, w_light, w_view))
    uv, w_view, to_world = (np.asarray(a, float) for a in (uv, w_view, to_world))
    result = np.zeros((len(uv), 3))
    step = max(1, BLOCK // max(len(found), 1))
    for first in range(0, len(uv) if len(found) else 0, step):
        part = slice(first, first + step)
        w_light = np.einsum("li,nij->nlj", found.w, to_world[part])
        point, light = np.nonzero(w_light[..., 2] > 0)
        at = first + point
        value = evaluate(uv[at], w_light[point, light], w_view[at], at) * found.power[light]
        for k in range(3):
            result[part, k] = np.bincount(point, value[:, k], minlength=len(w_light))
    return result


def by_stencils(
    representation: Representation, kernel: Kernel, uv: ArrayLike, w_view: ArrayLike, to_world: ArrayLike
) -> np.ndarray:
    """Radiance from a method's kernel: stencils, validity and bounded memory around it.

    Parameters
    ----------
    representation : Representation
    kernel : callable
        See :data:`Kernel`.
    uv : array_like, shape (N, 2)
    w_view : array_like, shape (N, 3)
        Local frame.
    to_world : array_like, shape (N, 3, 3)
        Columns: the local axes in world space.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        0 for views below the horizon.
    """
    meta = representation.meta
    views = interpolation.from_arrays(representation.arrays(), "view")
    uv, w_view, to_world = (np.asarray(a, float) for a in (uv, w_view, to_world))
    result = np.zeros((len(uv), 3))
    step = CHUNK // 16
    for first in range(0, len(uv), step):
        part = slice(first, first + step)
        valid = first + np.flatnonzero(conventions.valid_directions(w_view[part]))
        if len(valid):
            texel = conventions.texel_stencil(uv[valid], meta["texels"], meta["filter_type"])
            view = views.stencil(w_view[valid])
            result[valid] = kernel(texel, view, w_view[valid], to_world[valid])
    return result
