"""Radiance transfer of a mesh: how distant light, in spherical harmonics, arrives in the local frame of every corner.

Sources: P.-P. Sloan, J. Kautz, J. Snyder, "Precomputed Radiance Transfer for Real-Time Rendering in Dynamic,
Low-Frequency Lighting Environments", SIGGRAPH 2002 (transfer matrices); P.-P. Sloan, J. Hall, J. Hart, J. Snyder,
"Clustered Principal Components for Precomputed Radiance Transfer", SIGGRAPH 2003; Müller, Meseth, Klein 2004, section
4.3. Matrices belong to the corners of triangles instead of vertices, because ∂p/∂u, and so the frame, is constant on a
triangle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.numerics.solvers.clustering import leading_axes, local_pca
from btfref.numerics.solvers.lowrank import range_basis
from btfref.numerics.sphere import harmonics
from btfref.scene.hits import corner_frames
from btfref.types import JitArray, Progress

if TYPE_CHECKING:
    from btfref.scene.shapes import MeshDescription


#: Rays from a vertex that find what hides the environment: 1024 make steps of 6 degrees, five bands have lobes of 45.
RAYS = 1024

#: Rays start off the surface by this share of the scene's size.
OFFSET = 1e-4

#: Vertices whose rays are traced at a time.
BLOCK = 512

#: Dimension of the span of all matrices in which corners are clustered.
SUBSPACE = 96


@dataclass(frozen=True)
class TransferSettings:
    """What is precomputed, and how it is stored.

    Parameters
    ----------
    clusters, components : int
        Of the local PCA of the matrices; the paper's are 32 and 8.
    shadows : bool
        Whether the scene's meshes hide the environment from each other and themselves.
    bounces : int
        Of light from mesh to mesh, as from Lambertian surfaces of the materials' mean albedo, in colour; needs
        ``shadows``.
    bits : {8, 32}
        Of a stored product: codes with four scales, or floats.
    map_size : int
        Texels a side of the products' parabolic maps over the views; the paper's is 16.
    seed : int
    """

    clusters: int = 32
    components: int = 8
    shadows: bool = False
    bounces: int = 0
    bits: int = 32
    map_size: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least, most in (
            ("clusters", 1, 4096),
            ("components", 1, 256),
            ("bounces", 0, 64),
            ("map_size", 2, 256),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
                raise InputError(
                    "a setting of the transfer is out of range",
                    field=name,
                    got=getattr(self, name),
                    expected=f"a whole number in [{least}, {most}]",
                )
        if self.bits not in (8, 32):
            raise InputError(
                "unknown storage of the transfer", field="bits", got=self.bits, expected="8 or 32"
            )
        if self.bounces and not self.shadows:
            raise InputError("light between meshes needs shadows", field="bounces", got=self.bounces)


@dataclass(frozen=True)
class ClusteredTransfer:
    """Local PCA of the matrices of a mesh's corners: ``M ≈ Σ_j weight_j · basis[cluster, j]``.

    Parameters
    ----------
    cluster : ndarray of int64, shape (triangles, 3)
        Clusters that no corner has are left out.
    weights : ndarray of float32, shape (triangles, 3, 1 + components)
        The first is 1, of the cluster's mean.
    basis : ndarray of float32, shape (clusters, 1 + components, channels, order², order²)
        One channel where all three are alike; the weights are the same for all.
    error : float
        Relative RMS error of the matrices.
    """

    cluster: np.ndarray
    weights: np.ndarray
    basis: np.ndarray
    error: float


def corner_matrices(mesh: MeshDescription, order: int, transfer: np.ndarray | None = None) -> np.ndarray:
    """Matrices from the environment's coefficients in world space to those of the light in a corner's frame.

    Parameters
    ----------
    mesh : MeshDescription
    order : int
    transfer : ndarray, shape (vertices, channels, order², order²), optional
        In world space: see :func:`vertex_transfer`. Without it nothing hides the environment.

    Returns
    -------
    ndarray of float32, shape (triangles, 3, channels, order², order²)
    """
    frames = corner_frames(mesh)
    channels = 1 if transfer is None else transfer.shape[1]
    result = np.zeros((*frames.shape[:2], channels, order * order, order * order), np.float32)
    for first in range(0, len(frames), 2 * BLOCK):
        part = slice(first, first + 2 * BLOCK)
        turn = harmonics.rotation_matrix(frames[part], order)[:, :, None]
        result[part] = turn if transfer is None else turn @ transfer[mesh.faces[part]]
    return result


def vertex_transfer(
    meshes: Sequence[MeshDescription],
    order: int,
    *,
    bounces: int = 0,
    albedo: Sequence[ArrayLike] = (),
    progress: Progress | None = None,
) -> list[np.ndarray]:
    """What the meshes let through and reflect, at every vertex.

    Parameters
    ----------
    meshes : sequence of MeshDescription
        All of the scene.
    order : int
    bounces : int
        Of light from mesh to mesh.
    albedo : sequence of array_like, shape (3,)
        Of each mesh, for those.
    progress : callable, optional

    Returns
    -------
    list of ndarray of float32, shape (vertices, channels, order², order²)
        World space: ``∫ V(w) y_i y_j dw``, and what other places send in place of what they hide. Surfaces reflect on
        their front sides, two-sided ones on both. One channel without bounces, else three.

    Raises
    ------
    MissingDependencyError
        Without a usable LLVM.
    """
    from btfref.platform import prepare_llvm
    from btfref.sampling.variant import mitsuba_variant

    prepare_llvm()
    w = fibonacci(RAYS)
    y = harmonics.values(w, order).astype(np.float32) * np.float32(np.sqrt(4 * np.pi / RAYS))
    starts = np.cumsum([0, *(len(m.positions) for m in meshes)])
    size = max(np.ptp(np.concatenate([m.positions for m in meshes]), axis=0).max(), 1e-30)
    n = order * order
    direct = []
    # Radiance of the front and back sides per coefficient, all meshes' vertices in one list.
    channels = 3 if bounces else 1
    sent = np.zeros((channels, starts[-1], 2, n), np.float32)
    with mitsuba_variant("llvm_ad_rgb") as mi:
        scene = mi.load_dict(
            {"type": "scene", **{f"mesh_{i}": _mitsuba_mesh(mi, m, i) for i, m in enumerate(meshes)}}
        )
        hits = [_hits(mi, scene, mesh, meshes, starts, w, OFFSET * size) for mesh in meshes]
    for vertex, _, _ in hits:
        own = np.zeros((len(vertex), n, n), np.float32)
        for first in range(0, len(vertex), BLOCK):
            part = slice(first, first + BLOCK)
            blocked = (vertex[part, :, 0] >= 0).astype(np.float32)
            # What is hidden is taken from the whole, so that nothing is lost where nothing is hidden.
            own[part] = np.eye(n, dtype=np.float32) - np.einsum("vd,di,dj->vij", blocked, y, y, optimize=True)
        direct.append(own)
    total = [np.repeat(d[:, None], channels, 1) for d in direct]
    lobe = [_diffuse(mesh, w, y) for mesh in meshes]
    for bounce in range(bounces):
        for i, mesh in enumerate(meshes):
            for side in (0, 1):
                two = side == 0 or mesh.twosided
                scale = np.asarray(albedo[i], float) / np.pi * two
                found = np.einsum("vi,vcij->cvj", lobe[i][side], total[i])
                sent[:, starts[i] : starts[i + 1], side] = scale[:, None, None] * found
        for i in range(len(meshes)):
            total[i] = np.stack([direct[i] + _gathered(y, *hits[i], own) for own in sent], 1)
        if progress:
            progress(bounce + 1, bounces, "light between meshes")
    return total


def fibonacci(n: int) -> np.ndarray:
    """Directions spread evenly over the sphere, shape (n, 3)."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    phi = np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


def vertex_normals(mesh: MeshDescription) -> np.ndarray:
    """Unit normals of vertices; of a mesh without them, the mean of its triangles', shape (n, 3)."""
    if mesh.normals is not None:
        normals = np.asarray(mesh.normals, float) * (-1 if mesh.flip else 1)
    else:
        _, corner, _, _ = mesh.corners()
        normals = np.zeros((len(mesh.positions), 3))
        np.add.at(normals, mesh.faces.ravel(), corner.reshape(-1, 3))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _diffuse(mesh: MeshDescription, w: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Coefficients of the clamped cosine about the normals of both sides, two of shape (vertices, order²)."""
    cosine = vertex_normals(mesh) @ w.T
    scale = np.sqrt(4 * np.pi / len(w))
    return [scale * (np.maximum(sign * cosine, 0).astype(np.float32) @ y) for sign in (1, -1)]


def _mitsuba_mesh(mi: JitArray, mesh: MeshDescription, number: int) -> JitArray:
    made = mi.Mesh(f"mesh_{number}", len(mesh.positions), len(mesh.faces))
    values = mi.traverse(made)
    values["vertex_positions"] = to_device(mi.Float, mesh.positions)
    values["faces"] = to_device(mi.UInt32, mesh.faces)
    values.update()
    return made


def _hits(
    mi: JitArray,
    scene: JitArray,
    mesh: MeshDescription,
    meshes: Sequence[MeshDescription],
    starts: np.ndarray,
    w: np.ndarray,
    offset: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What every ray of every vertex meets.

    Returns
    -------
    vertex : ndarray of int32, shape (vertices, rays, 3)
        Corners of the triangle, in the list of all meshes' vertices; −1 for a miss.
    weight : ndarray of float32, shape (vertices, rays, 3)
        Barycentric.
    side : ndarray of uint8, shape (vertices, rays)
        1: its back.
    """
    import drjit as dr

    positions, normals = np.asarray(mesh.positions, float), vertex_normals(mesh)
    shape = len(positions), len(w)
    vertex = np.full((*shape, 3), -1, np.int32)
    weight, side = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.uint8)
    shapes = scene.shapes()
    for first in range(0, len(positions), BLOCK):
        part = slice(first, first + BLOCK)
        up = np.sign(normals[part] @ w.T)
        origin = positions[part, None] + offset * up[..., None] * normals[part, None]
        d = np.broadcast_to(w, origin.shape)
        ray = mi.Ray3f(
            to_device(mi.Point3f, origin.reshape(-1, 3).T),
            to_device(mi.Vector3f, d.reshape(-1, 3).T),
        )
        found = scene.ray_intersect_preliminary(ray)
        which = [np.array(found.is_valid() & (found.shape == mi.ShapePtr(s))) for s in shapes]
        # Of rays that meet nothing they are whatever memory held: only those of hits are numbers.
        prim, uv = np.array(found.prim_index), np.array(found.prim_uv).T
        dr.eval(found)
        for number, hit in enumerate(which):
            at = np.flatnonzero(hit)
            if not len(at):
                continue
            other = meshes[number]
            faces = other.faces[prim[at]]
            row, column = first + at // len(w), at % len(w)
            vertex[row, column] = starts[number] + faces
            u, v = uv[at].T.astype(float)
            weight[row, column] = np.stack([1 - u - v, u, v], -1)
            normal = vertex_normals(other)[faces].sum(1)
            side[row, column] = (normal * w[column]).sum(1) > 0
    return vertex, weight, side


def _gathered(
    y: np.ndarray, vertex: np.ndarray, weight: np.ndarray, side: np.ndarray, sent: np.ndarray
) -> np.ndarray:
    """``Σ_d y_i(d) · radiance_j of what ray d meets``, shape (vertices, order², order²)."""
    n = sent.shape[-1]
    result = np.zeros((len(vertex), n, n), np.float32)
    scale = np.float32(np.sqrt(4 * np.pi / len(y)))
    for first in range(0, len(vertex), BLOCK // 8):
        part = slice(first, first + BLOCK // 8)
        known = vertex[part] >= 0
        share = np.where(known, weight[part], 0)
        radiance = np.einsum(
            "vdk,vdkj->vdj", share, sent[np.maximum(vertex[part], 0), side[part][..., None]], optimize=True
        )
        result[part] = scale * np.matmul(y.T, radiance)
    return result


def clustered(matrices: np.ndarray, settings: TransferSettings) -> ClusteredTransfer:
    """Local PCA of corner matrices.

    Parameters
    ----------
    matrices : ndarray of float32, shape (triangles, 3, channels, n, n)
    settings : TransferSettings

    Returns
    -------
    ClusteredTransfer
    """
    rng = np.random.default_rng(settings.seed)
    shape = matrices.shape
    rows = matrices.reshape(shape[0] * shape[1], -1)
    # A plane has a single matrix: corners that are alike are clustered once.
    unique, inverse = np.unique(np.round(rows, 6), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    components = min(settings.components, unique.shape[1])
    subspace, coordinates = range_basis(unique, min(SUBSPACE, min(unique.shape)), rng)
    coordinates = coordinates.astype(float)
    labels, _ = local_pca(coordinates, min(settings.clusters, len(unique)), components, rng)
    present, labels = np.unique(labels, return_inverse=True)
    basis = np.zeros((len(present), 1 + components, rows.shape[1]), np.float32)
    weights = np.zeros((len(rows), 1 + components), np.float32)
    weights[:, 0] = 1
    corner = labels[inverse]
    error = 0.0
    for k in range(len(present)):
        own, members = labels == k, corner == k
        basis[k, 0] = unique[own].mean(0)
        axes = leading_axes(coordinates[own], components) @ subspace.astype(float)
        basis[k, 1 : 1 + len(axes)] = axes
        block = rows[members] - basis[k, 0]
        weights[members, 1:] = block @ basis[k, 1:].T
        error += float(((block - weights[members, 1:] @ basis[k, 1:]) ** 2).sum())
    energy = float(np.einsum("ij,ij->", rows, rows, dtype=float))
    return ClusteredTransfer(
        corner.reshape(shape[:2]),
        weights.reshape(*shape[:2], -1),
        basis.reshape(*basis.shape[:2], *shape[2:]),
        float(np.sqrt(error / max(energy, 1e-300))),
    )
