"""Light in spherical harmonics on methods whose texels share a few tables over views and lights.

Source: G. Müller, J. Meseth, R. Klein, "Fast Environmental Lighting for Local-PCA Encoded BTFs", CGI 2004, section 4.2:
``L_r(x, v) = ⟨b^(x,v), M_p a⟩`` with the environment's coefficients a, the rotation M_p into the local frame, and the
coefficients b of the mean and the eigen-BRDFs, per view. Differs from it in the projection: the interpolated table is
integrated, not the measured samples alone, whose quadrature is exact for two bands only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.numerics.sphere import harmonics, interpolation
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.rendering.environment_light import light_set
from btfref.rendering.environment_light.prepared import Stencil, by_stencils
from btfref.representations.protocol import LitByHarmonics
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.scene.environment import Environment


#: Bands of the paper.
ORDER = 5

#: Nodes in cos θ and φ that integrate a table: steps of φ that the measured azimuths are whole numbers of.
NODES = 128, 720

#: Cells that stand for a picture when it is projected: 0.7 degrees each.
CELL_ROWS = 256

#: Order of the rule that integrates what receivers see of the harmonics.
ESTIMATE = 48


def shared_tables(
    representation: Representation, lit_by: Any, *, file: PathLike | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``representation.shared_tables()`` of a method that satisfies a protocol, `LitByHarmonics` or `LitByTransfer`.

    Raises
    ------
    InputError
        For a method without tables that texels share.
    """
    if not isinstance(representation, lit_by):
        from btfref.registry import representations

        having = [key for key, made in representations().items() if isinstance(made, lit_by)]
        raise InputError(
            "spherical harmonics need tables over lights that texels share",
            file=file,
            field="method",
            got=representation.meta["method"],
            expected=f"one of {', '.join(having)}",
        )
    return representation.shared_tables()


def environment_coefficients(
    environment: Environment, order: int, *, window: str | None = None
) -> np.ndarray:
    """Coefficients of an environment in world space.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    order : int
    window : str, optional
        See :func:`btfref.numerics.sphere.harmonics.window`.

    Returns
    -------
    ndarray of float64, shape (order², 3)
    """
    w, power = environment.cells(CELL_ROWS)
    lit = np.flatnonzero(power.any(1))
    total = np.zeros((order * order, 3))
    for first in range(0, len(lit), 1 << 14):
        part = lit[first : first + (1 << 14)]
        total += harmonics.values(w[part], order).T @ power[part]
    return harmonics.window(window, order)[:, None] * total


def estimated_error(environment: Environment, coefficients: np.ndarray) -> float:
    """How differently receivers see an environment and its harmonics: see `light_set`.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    coefficients : ndarray, shape (order², 3)
        World space.

    Returns
    -------
    float
        Relative RMSE of luminance.
    """
    w, power = environment.cells()
    node, weight = harmonics.sphere_rule(ESTIMATE)
    order = int(np.sqrt(len(coefficients)))
    seen = weight[:, None] * (harmonics.values(node, order) @ coefficients)
    return light_set.estimated_error(node, seen, w, power)


def light_projection(representation: Representation, order: int) -> np.ndarray:
    """Matrix from values at the measured lights to the coefficients of what is interpolated between them.

    Returns
    -------
    ndarray of float64, shape (order², n_lights)
        Shared, and not to be changed.
    """
    tables = {name: table for name, table in representation.arrays().items() if name.startswith("light_")}
    content = tuple((name, a.dtype.str, a.shape, a.tobytes()) for name, a in sorted(tables.items()))
    return _projection(content, order)


@lru_cache(maxsize=8)
def _projection(content: tuple[tuple[str, str, tuple[int, ...], bytes], ...], order: int) -> np.ndarray:
    """The same of tables by content: materials share their sets of lights."""
    tables = {name: np.frombuffer(data, dtype).reshape(shape) for name, dtype, shape, data in content}
    w, weight = gauss_hemisphere(*NODES)
    index, share = interpolation.from_arrays(tables, "light").stencil(w, hold=False)
    weighted = harmonics.values(w, order) * weight[:, None]
    n = len(tables["light_directions"])
    flat = index.ravel()
    found = np.stack([np.bincount(flat, (share * y[:, None]).ravel(), n) for y in weighted.T])
    found.flags.writeable = False  # remembered
    return found


def table_coefficients(
    representation: Representation, order: int, *, file: PathLike | None = None
) -> np.ndarray:
    """Coefficients of the shared tables over the light.

    Returns
    -------
    ndarray of float64, shape (cluster, view, order², 1 + component, 3)
    """
    tables, _, _ = shared_tables(representation, LitByHarmonics, file=file)
    projection = light_projection(representation, order)
    k, m, v, n, _ = tables.shape
    flat = np.moveaxis(tables.astype(np.float32), 3, 0).reshape(n, -1)
    found = (projection @ flat).reshape(order * order, k, m, v, 3)
    return found.transpose(1, 3, 0, 2, 4)


def turn_table(order: int) -> np.ndarray:
    """Quarter turn about x for shaders: row i of the block of its band, float32 (order², 2 · order − 1)."""
    matrix, table = harmonics.quarter_turn(order), np.zeros((order * order, 2 * order - 1), np.float32)
    for band in range(order):
        block = slice(band * band, (band + 1) ** 2)
        table[block, : 2 * band + 1] = matrix[block, block]
    return table


def radiance(
    representation: Representation,
    coefficients: np.ndarray,
    light: np.ndarray,
    uv: ArrayLike,
    w_view: ArrayLike,
    to_world: ArrayLike,
) -> np.ndarray:
    """⟨b, M a⟩ in float64.

    Parameters
    ----------
    representation : Representation
    coefficients : ndarray, shape (cluster, view, order², 1 + component, 3)
    light : ndarray, shape (order², 3)
    uv, w_view, to_world : ndarray, shape (N, 2), (N, 3), (N, 3, 3)

    Returns
    -------
    ndarray of float64, shape (N, 3)
    """
    order = int(np.sqrt(len(light)))
    _, cluster, weights = shared_tables(representation, LitByHarmonics)

    def kernel(texel: Stencil, view: Stencil, w_view: np.ndarray, frame: np.ndarray) -> np.ndarray:
        local, result = harmonics.rotate(light, frame, order), np.zeros((len(frame), 3))
        for index, texel_weight in zip(*(a.T for a in texel), strict=True):
            own, mixed = cluster[index], weights[index]
            for direction, view_weight in zip(*(a.T for a in view), strict=True):
                seen = np.einsum("nimc,nm->nic", coefficients[own, direction], mixed)
                result += (texel_weight * view_weight)[:, None] * np.einsum("nic,nic->nc", seen, local)
        return result

    return by_stencils(representation, kernel, uv, w_view, to_world)
