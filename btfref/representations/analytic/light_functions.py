"""What the methods share that store functions of the light instead of tables over it (Meseth, Müller, Klein 2004).

They model luminance; the colour is the texel's chroma times it, as in polynomial texture maps (Malzbender, Gelb and
Wolters 2001, section 3.4). Below the outermost measured light the function is held and faded by the cosine, which is
the convention for lights beyond the last ring, so that nothing is extrapolated towards the horizon.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from btfref import conventions
from btfref.numerics.sphere import interpolation
from btfref.precision import real
from btfref.representations.file.schema import Constant, Edge
from btfref.representations.guide import feature_views, texel_groups
from btfref.representations.lookup import (
    StoredMaps,
    base_meta,
    direction_arrays,
    evaluate_points,
    given,
    refuse_not_finite,
)
from btfref.sampling.passes import over_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike

    from btfref.representations.protocol import Representation
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


M = TypeVar("M", bound="AnalyticMaps")
S = TypeVar("S")
R = TypeVar("R")

#: What is made of a block: see :func:`over_luminance`.
LuminanceWork = Callable[["BTFBlocks", S, slice, np.ndarray, np.ndarray], R]

#: Texels fitted at a time: bounds the memory of luminance tables and of normal equations.
BLOCK = 4096

#: Constants that :func:`edge_constants` makes.
EDGES: dict[str, Constant] = {"light_edge": Edge("light"), "view_edge": Edge("view")}

#: Members of a group of texels whose mean guides importance sampling.
GUIDE_MEMBERS = 16


@dataclass(frozen=True)
class HeldStencils:
    """N lookups: neighbours (indices and weights, (N, T), (N, V)) and directions held at the measured edge (N, 3)."""

    texel: np.ndarray
    texel_weight: np.ndarray
    view: np.ndarray
    view_weight: np.ndarray
    w_light: np.ndarray
    w_view: np.ndarray


def evaluate_analytic(
    representation: Representation,
    kernel: Callable[[HeldStencils], np.ndarray],
    uv: ArrayLike,
    w_light: ArrayLike,
    w_view: ArrayLike,
    *,
    draw: ArrayLike | None = None,
) -> np.ndarray:
    """Evaluate a method whose maps are functions of the light.

    Parameters
    ----------
    representation : Representation
        Its meta holds the constants ``light_edge`` and ``view_edge``.
    kernel : callable
        ``HeldStencils -> (N, 3)`` float64.
    uv, w_light, w_view : array_like, shape (..., 2), (..., 3), (..., 3)
    draw : array_like, shape (...), optional
        See :meth:`btfref.representations.protocol.DrawsViews.evaluate`.

    Returns
    -------
    ndarray of float64, shape (..., 3)
    """
    meta = representation.meta
    views = interpolation.from_arrays(representation.arrays(), "view")

    def lookup(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *draws: np.ndarray) -> np.ndarray:
        texel, texel_weight = conventions.texel_stencil(uv, meta["texels"], meta["filter_type"])
        view, view_weight = views.stencil(w_view, draw=draws[0] if draws else None)
        light, fade = held(w_light, meta["constants"]["light_edge"])
        held_view, _ = held(w_view, meta["constants"]["view_edge"])
        return fade[:, None] * kernel(HeldStencils(texel, texel_weight, view, view_weight, light, held_view))

    return evaluate_points(lookup, uv, w_light, w_view, *given(draw))


def held(w: ArrayLike, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions raised to the outermost measured cosine, and what lights below it fade by.

    Parameters
    ----------
    w : array_like, shape (..., 3)
        Unit vectors above the horizon.
    edge : float
        Smallest measured cosine.

    Returns
    -------
    w : ndarray, shape (..., 3)
        Azimuth kept, ``z`` at least ``edge``.
    fade : ndarray, shape (...)
        ``z / edge`` where that is below 1, else 1.
    """
    w = real(w)
    z = w[..., 2]
    below = z < edge
    radius = np.hypot(w[..., 0], w[..., 1])
    scale = np.where(below, math.sqrt(max(1 - edge * edge, 0)) / np.where(below, radius, 1), 1)
    raised = np.concatenate([w[..., :2] * scale[..., None], np.maximum(z, edge)[..., None]], -1)
    return raised, np.where(below, z / max(edge, 1e-30), 1)


def edge_constants(btf: BTFBlocks) -> dict[str, float]:
    """The smallest measured cosines; 0, which holds nothing, where they reach the horizon."""
    edges = {"light_edge": btf.lights.vectors[:, 2].min(), "view_edge": btf.views.vectors[:, 2].min()}
    return {name: float(np.float32(edge)) if edge > 1e-6 else 0.0 for name, edge in edges.items()}


def luminance_blocks(btf: BTFBlocks) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Luminance and chroma of the texels, some at a time.

    Parameters
    ----------
    btf : BTFBlocks

    Yields
    ------
    part : slice
        Of the flat texel index.
    luminance : ndarray of float32, shape (n_views, n_lights, n)
    chroma : ndarray of float64, shape (n, 3)
        Best common colour of all samples of a texel, of luminance 1: ``Σ B Y / Σ Y²``.

    Raises
    ------
    InputError
        For values that are not finite.
    """
    for rows in _row_blocks(btf):
        yield _luminance_block(btf, rows)


def over_luminance(
    btf: BTFBlocks, work: LuminanceWork[S, R], shared: S, progress: Progress | None = None, label: str = "fit"
) -> Iterator[tuple[slice, R]]:
    """What is made of :func:`luminance_blocks`, in their order; workers of a cluster may make it.

    Parameters
    ----------
    btf : BTFBlocks
    work : callable
        ``(btf, shared, part, luminance, chroma) -> result``, a function of a module.
    shared : object
        The same for all blocks; nothing may change it.
    progress : callable, optional
        ``progress(done, total, label)`` after each block.

    Yields
    ------
    part : slice
        Of the flat texel index.
    result : object
    """
    n_texels = btf.texels[0] * btf.texels[1]
    for part, result in over_blocks(btf, _of_luminance, (work, shared), _row_blocks(btf)):
        yield part, result
        if progress:
            progress(part.stop, n_texels, label)


def _row_blocks(btf: BTFBlocks) -> list[tuple[int, int]]:
    """First and last rows of the blocks."""
    rows, columns = btf.texels
    step = max(1, BLOCK // columns)
    return [(first, min(first + step, rows)) for first in range(0, rows, step)]


def _luminance_block(btf: BTFBlocks, rows: tuple[int, int]) -> tuple[slice, np.ndarray, np.ndarray]:
    """See :func:`luminance_blocks`."""
    columns = btf.texels[1]
    block = np.asarray(btf.rows(*rows), np.float32).reshape(len(btf.views), len(btf.lights), -1, 3)
    refuse_not_finite(block, btf)
    luminance = block @ conventions.LUMINANCE.astype(np.float32)
    energy = np.einsum("vln,vln->n", luminance, luminance, dtype=float)
    chroma = np.einsum("vlnc,vln->nc", block, luminance, dtype=float)
    chroma = np.where(energy[:, None] > 0, chroma / np.where(energy > 0, energy, 1)[:, None], 1.0)
    return slice(rows[0] * columns, rows[1] * columns), luminance, chroma


def _of_luminance(
    btf: BTFBlocks, task: tuple[LuminanceWork[S, R], S], rows: tuple[int, int]
) -> Iterator[tuple[slice, R]]:
    """What is made of a block."""
    work, shared = task
    part, luminance, chroma = _luminance_block(btf, rows)
    yield part, work(btf, shared, part, luminance, chroma)


def mean_absolute_error(representation: AnalyticMaps, btf: BTFBlocks) -> np.ndarray:
    """ε of each texel: mean of |B − model| in luminance over all measured pairs; the paper's eq. 2.

    Returns
    -------
    ndarray of float64, shape (n_texels,)
        In units of the radiance factor π B, where a white diffuser under perpendicular light has 1.
    """
    result = np.zeros(int(np.prod(btf.texels)))
    for part, error in over_luminance(btf, _absolute_error, representation):
        result[part] = error
    return result


def _absolute_error(
    btf: BTFBlocks,
    representation: AnalyticMaps,
    part: slice,
    luminance: np.ndarray,
    chroma: np.ndarray,
) -> np.ndarray:
    """:func:`mean_absolute_error` of a block."""
    texels, n_views = np.arange(part.start, part.stop), len(btf.views)
    result = np.zeros(len(texels))
    for view in range(n_views):
        model = representation.luminance_tables(texels, np.array([view]))[:, 0]
        result += np.pi * np.abs(luminance[view].T - model).mean(1, dtype=float) / n_views
    return result


def fit_report(representation: AnalyticMaps, btf: BTFBlocks) -> dict[str, float]:
    """JSON-able average, least and largest ε over texels, as Table 1 of the paper has them."""
    error = mean_absolute_error(representation, btf)
    return {"average": float(error.mean()), "minimum": float(error.min()), "maximum": float(error.max())}


#: Bytes a texel and view of reflectance fields that Meseth et al. report: about 365 MB for 256² texels and 81 views.
PUBLISHED_BYTES = 365e6 / (256 * 256 * 81)


def memory_report(maps: dict[str, np.ndarray], texels: int, n_views: int | None = None) -> dict[str, int]:
    """JSON-able bytes of a method's maps by the type of their numbers.

    Parameters
    ----------
    maps : dict of str to ndarray
        Without the direction tables.
    texels : int
    n_views : int, optional
        Of a reflectance field: adds what the paper reports for as many texels and views.

    Returns
    -------
    dict
        ``float_bytes``, ``half_bytes``, ``code_bytes`` (8 bits, where they hold); ``published_bytes``.
    """
    numbers = sum(int(array.size) for array in maps.values())
    result = {"float_bytes": 4 * numbers, "half_bytes": 2 * numbers, "code_bytes": numbers}
    if n_views is not None:
        result["published_bytes"] = round(PUBLISHED_BYTES * texels * n_views)
    return result


def finished(
    made: type[M],
    method: str,
    btf: BTFBlocks,
    maps: dict[str, np.ndarray],
    parameters: Facts,
    *,
    filter_type: str,
    constants: Facts | None = None,
    facts: Facts,
    by_view: bool,
) -> M:
    """A representation of fitted maps, with what the fit says of itself.

    Parameters
    ----------
    made : type
        Of the representation.
    method : str
    btf : BTFBlocks
        What was fitted.
    maps : dict of str to ndarray
        Stored ones, without the direction tables.
    parameters : dict
        Of the fit.
    filter_type : {"bilinear", "nearest"}
    constants : dict, optional
        Beside the measured edges.
    facts : dict
        For ``meta["fit"]``, beside ``epsilon`` (:func:`fit_report`) and ``memory`` (:func:`memory_report`).
    by_view : bool
        Whether it is a reflectance field for each view; see :func:`memory_report`.
    """
    meta = base_meta(method, btf, parameters, filter_type=filter_type)
    meta["constants"] = edge_constants(btf) | (constants or {})
    result = made(maps | direction_arrays(btf.views, btf.lights), meta)
    memory = memory_report(maps, int(np.prod(btf.texels)), len(btf.views) if by_view else None)
    meta["fit"] = facts | {"epsilon": fit_report(result, btf), "memory": memory}
    return result


class AnalyticMaps(StoredMaps, ABC):
    """Maps of a method whose model of luminance is known at measured directions."""

    @abstractmethod
    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Model of luminance at measured views and all measured lights, shape (n, n_views, n_lights).

        Parameters
        ----------
        texels, views : ndarray of int, shapes (n,), (n_views,)
            Flat indices of texels, and indices of views.
        """

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and means over a few members of each."""
        rows, columns = self.meta["texels"]
        n_views, n_lights = (len(self.maps[f"{kind}_directions"]) for kind in ("view", "light"))
        some = feature_views(n_views)
        features = [
            self.luminance_tables(np.arange(first, min(first + BLOCK, rows * columns)), some)
            for first in range(0, rows * columns, BLOCK)
        ]
        labels = texel_groups(np.concatenate(features).reshape(rows * columns, -1))
        means = np.zeros((int(labels.max()) + 1, n_views, n_lights), np.float32)
        for group in range(len(means)):
            members = np.flatnonzero(labels == group)
            spread = np.linspace(0, len(members) - 1, min(len(members), GUIDE_MEMBERS)).round().astype(int)
            if len(members):
                means[group] = self.luminance_tables(members[spread], np.arange(n_views)).mean(0)
        return labels.reshape(rows, columns), means
