"""Clustered transfer times local PCA: light, matrices and eigen-BRDFs multiplied out once per light.

Source: Müller, Meseth, Klein 2004, sections 4.3 and 5: ``L_r(p, v) = Σ_j Σ_m α_{p,j} β_{x,m} λ_{m,k_B,j,k_M}(v)`` with
``λ = ⟨e^v_m, m_j(a)⟩`` in parabolic maps of 16 × 16 texels over v, as floats, or as 8-bit codes with four scales for
(m = 0, j = 0), (m = 0, j > 0), (m > 0, j = 0), (m > 0, j > 0).
"""

from __future__ import annotations

import time
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref import conventions
from btfref.numerics.sphere import harmonics, interpolation
from btfref.numerics.sphere.parabolic import bilinear_stencil, texel_directions
from btfref.rendering.environment_light.harmonic_light import shared_tables, table_coefficients
from btfref.representations.protocol import LitByTransfer
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.transfer import ClusteredTransfer
    from btfref.representations.protocol import Representation


#: Components of the matrices and of the material while the light moves, as in the paper.
MOVING = 4, 1

#: Codes −127 … 127 stand for −1 … 1; stored are codes + 127.
LEVELS = 127


class Material:
    """What is known of a material before there is a light.

    Parameters
    ----------
    representation : Representation
        Of a method whose texels share tables.
    order : int
    map_size : int
        Texels a side of a parabolic map over the views.
    file : str, optional
        For messages.
    """

    def __init__(
        self, representation: Representation, order: int, *, map_size: int = 16, file: PathLike | None = None
    ) -> None:
        _, cluster, weights = shared_tables(representation, LitByTransfer, file=file)
        # Clusters that no texel has are not computed.
        self.present, self.cluster = np.unique(cluster, return_inverse=True)
        self.weights, self.order, self.map_size = weights, order, map_size
        self.representation = representation
        found = table_coefficients(representation, order, file=file)[self.present]
        views = interpolation.from_arrays(representation.arrays(), "view")
        index, share = views.stencil(texel_directions(map_size).reshape(-1, 3))
        seen = sum(share[:, k, None, None, None] * found[:, index[:, k]] for k in range(index.shape[1]))
        # Channel, harmonic, then cluster, texel of the map and component: rows of a matrix product.
        seen = np.ascontiguousarray(seen.transpose(4, 2, 0, 1, 3), np.float32)
        self.shape = seen.shape[2:]
        self.seen = seen.reshape(3, order * order, -1)

    def part(self, components: int) -> np.ndarray:
        """The table's columns with all but the first ``components`` components of the material at zero."""
        kept = self.seen.reshape(3, self.order**2, *self.shape).copy()
        kept[..., components + 1 :] = 0
        return kept.reshape(self.seen.shape)

    @cached_property
    def moving(self) -> np.ndarray:
        """The columns while the light moves."""
        return self.part(MOVING[1])


def transferred(
    transfer: ClusteredTransfer, light: ArrayLike, *, two_sided: bool = False, components: int | None = None
) -> np.ndarray:
    """The light after every matrix of the clusters.

    Parameters
    ----------
    transfer : ClusteredTransfer
    light : ndarray, shape (order², 3)
    two_sided : bool
        Also for back sides, whose frames are mirrored.
    components : int, optional
        Of the matrices that are used; default: all.

    Returns
    -------
    ndarray of float32, shape (3, sides, clusters, 1 + components, order²)
    """
    basis = transfer.basis if components is None else transfer.basis[:, : components + 1]
    light = np.asarray(light, np.float32)
    if basis.shape[2] == 1:
        found = np.einsum("kjab,bc->ckja", basis[:, :, 0], light, optimize=True)
    else:
        found = np.einsum("kjcab,bc->ckja", basis, light, optimize=True)
    sides = [found]
    if two_sided:
        order = int(np.sqrt(len(light)))
        sides.append(found * harmonics.mirror_signs(order).astype(np.float32))
    return np.stack(sides, 1)


def products(
    material: Material, light: np.ndarray, *, out: np.ndarray | None = None, moving: bool = False
) -> np.ndarray:
    """λ of all clusters, components and texels of the maps.

    Parameters
    ----------
    material : Material
    light : ndarray
        From :func:`transferred`.
    out : ndarray of float32, optional
        Of the result's shape, to be overwritten: new memory costs as much as the products.
    moving : bool
        With few components of the material; the others are zero.

    Returns
    -------
    ndarray of float32, shape (3, sides, clusters, 1 + components, material clusters, size², 1 + m)
    """
    columns = material.moving if moving else material.seen
    rows = light.reshape(3, -1, light.shape[-1])
    shape = (*light.shape[:-1], *material.shape)
    if out is None:
        out = np.zeros(shape, np.float32)
    flat = out.reshape(3, rows.shape[1], -1)
    for c in range(3):
        np.matmul(rows[c], columns[c], out=flat[c])
    return out


def encoded(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """8-bit codes of :func:`products`, and their scales.

    Returns
    -------
    codes : ndarray of uint8, of the table's shape
    scales : ndarray of float32, shape (2, 2)
        Largest magnitudes for j = 0 and j > 0 (rows), m = 0 and m > 0 (columns).
    """
    parts = [slice(0, 1), slice(1, None)]
    scales = np.zeros((2, 2), np.float32)
    codes = np.full(table.shape, LEVELS, np.uint8)
    for a, j in enumerate(parts):
        for b, m in enumerate(parts):
            block = table[:, :, :, j, :, :, m]
            scales[a, b] = max(np.abs(block).max(initial=0), 1e-30)
            scaled = np.rint(block * np.float32(LEVELS / scales[a, b]))
            codes[:, :, :, j, :, :, m] = (scaled + LEVELS).astype(np.uint8)
    return codes, scales


def decoded(codes: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """What codes stand for, float32."""
    table = (codes.astype(np.float32) - LEVELS) / LEVELS
    j, m = (np.minimum(np.arange(codes.shape[axis]), 1) for axis in (3, 6))
    return table * scales[j][:, m][:, None, None, :]


class TransferLight:
    """The products of one mesh, one material and one light; the light may change.

    Parameters
    ----------
    material : Material
    transfer : ClusteredTransfer
    light : ndarray, shape (order², 3)
    two_sided : bool
    bits : {8, 32}
    """

    def __init__(
        self,
        material: Material,
        transfer: ClusteredTransfer,
        light: np.ndarray,
        *,
        two_sided: bool = False,
        bits: int = 32,
    ) -> None:
        self.material, self.transfer, self.two_sided, self.bits = material, transfer, two_sided, bits
        # Kept for the next light: new memory costs as much as the products.
        self._full: np.ndarray | None = None
        self._coarse: np.ndarray | None = None
        self.relight(light)

    def relight(self, light: np.ndarray, *, moving: bool = False) -> None:
        """Take another light; ``moving`` computes few components of both, until the next call without it refines.

        Parameters
        ----------
        light : ndarray, shape (order², 3)
            World space.
        moving : bool
        """
        start = time.perf_counter()
        components = MOVING[0] if moving else None
        rows = transferred(self.transfer, light, two_sided=self.two_sided, components=components)
        if moving:
            self.table = self._coarse = products(self.material, rows, out=self._coarse, moving=True)
        else:
            self.table = self._full = products(self.material, rows, out=self._full)
        self.milliseconds = 1e3 * (time.perf_counter() - start)
        if self.bits == 8:
            self.codes, self.scales = encoded(self.table)
            self.table = decoded(self.codes, self.scales)

    def tables(self) -> dict[str, np.ndarray]:
        """What changes with the light and ``shaders/environment/lpca_transfer.glsl`` reads: products, their scales."""
        flat = (self.codes if self.bits == 8 else self.table).reshape(-1)
        missing = -len(flat) % 4
        if missing:
            flat = np.concatenate([flat, np.zeros(missing, flat.dtype)])
        scales = self.scales if self.bits == 8 else np.ones((2, 2), np.float32)
        return {"transfer_products": flat.reshape(-1, 4), "transfer_scales": scales.reshape(1, 4)}

    def places(self) -> np.ndarray:
        """Of the material's clusters among those that are present, for shaders: float32 (clusters, 4)."""
        count = int(self.material.present.max()) + 1
        table = np.zeros((count, 4), np.float32)
        table[self.material.present, 0] = np.arange(len(self.material.present))
        return table

    @property
    def table_bytes(self) -> int:
        """Of the products as they are stored."""
        return int(self.table.size * self.bits // 8)

    def radiance(
        self,
        uv: np.ndarray,
        w_view: np.ndarray,
        behind: np.ndarray,
        triangle: np.ndarray,
        barycentric: np.ndarray,
    ) -> np.ndarray:
        """Radiance towards the viewer in float64.

        Parameters
        ----------
        uv : ndarray, shape (N, 2)
        w_view : ndarray, shape (N, 3)
            Local frame, above the horizon.
        behind : ndarray of bool, shape (N,)
            The back of a two-sided surface is seen.
        triangle : ndarray of int, shape (N,)
        barycentric : ndarray, shape (N, 3)

        Returns
        -------
        ndarray of float64, shape (N, 3)
        """
        material, meta = self.material, self.material.representation.meta
        n_j = self.table.shape[3]
        result = np.zeros((len(uv), 3))
        step = 1 << 11
        for first in range(0, len(uv), step):
            at = first + np.flatnonzero(conventions.valid_directions(w_view[first : first + step]))
            if not len(at):
                continue
            texel, texel_weight = conventions.texel_stencil(uv[at], meta["texels"], meta["filter_type"])
            view, view_weight = bilinear_stencil(w_view[at], material.map_size)
            side = behind[at].astype(int)
            for corner in range(3):
                own = self.transfer.cluster[triangle[at], corner]
                alpha = self.transfer.weights[triangle[at], corner, :n_j] * barycentric[at, corner, None]
                for t in range(texel.shape[1]):
                    k, beta = material.cluster[texel[:, t]], material.weights[texel[:, t]]
                    for v in range(view.shape[1]):
                        share = texel_weight[:, t] * view_weight[:, v]
                        # Advanced indices apart by slices come first: N, channel, j, m.
                        found = self.table[:, side, own, :, k, view[:, v]]
                        result[at] += share[:, None] * np.einsum("nj,ncjm,nm->nc", alpha, found, beta)
        return result


def corner_table(transfer: ClusteredTransfer) -> np.ndarray:
    """Weights of corners for shaders, float32 (triangles · 3, 1 + components): the cluster in place of the first."""
    table = transfer.weights.reshape(-1, transfer.weights.shape[-1]).copy()
    table[:, 0] = transfer.cluster.ravel()
    return table


def bins(transfer: ClusteredTransfer, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that are drawn for each cluster.

    A triangle belongs to the bins of its corners, and of those across its edges: a ray tracer may give a sample at the
    edge to the neighbour.

    Parameters
    ----------
    transfer : ClusteredTransfer
    neighbours : ndarray of int, shape (triangles, 3)
        −1 where there is none.

    Returns
    -------
    triangles : ndarray of float32, shape (n, 4)
        Indices in the first column, bin by bin.
    starts : ndarray of int64, shape (clusters + 1,)
    """
    n = len(transfer.basis)
    member = np.zeros((len(transfer.cluster), n), bool)
    np.put_along_axis(member, transfer.cluster, True, axis=1)
    wide = member.copy()
    for k in range(3):
        there = neighbours[:, k] >= 0
        wide[there] |= member[neighbours[there, k]]
    cluster, triangle = np.nonzero(wide.T)
    table = np.zeros((len(triangle), 4), np.float32)
    table[:, 0] = triangle
    return table, np.concatenate([[0], np.cumsum(np.bincount(cluster, minlength=n))])
