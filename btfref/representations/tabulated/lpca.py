"""Local principal component analysis of a BTF: eigen-BRDFs per cluster of texels.

Sources: G. Müller, J. Meseth, R. Klein, "Compression and Real-Time Rendering of Measured BTFs Using Local PCA",
VMV 2003; the same authors, "Fast Environmental Lighting for Local-PCA Encoded BTFs", CGI 2004, eq. 4:
``B_x ≈ mean_k + Σ_i ⟨B_x − mean_k, E_{i,k}⟩ E_{i,k}`` with k the cluster of texel x and its whole table over
(view, light, channel) as one vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref import conventions
from btfref.numerics.solvers.clustering import leading_axes, local_pca
from btfref.numerics.solvers.streaming import leading, orthonormal, principal
from btfref.numerics.solvers.threads import in_parallel, reproducible
from btfref.precision import real
from btfref.representations.columns import Steps, TexelColumns
from btfref.representations.file.resident import refuse_absent
from btfref.representations.file.schema import INDICES, MapSchema, Number, Schema
from btfref.representations.guide import feature_views, group_means, texel_groups
from btfref.representations.lookup import (
    PAIRS,
    StoredMaps,
    base_meta,
    direction_arrays,
    evaluate_tabulated,
    packed_arrays,
    positive_integer,
    stored,
    unit_peaks,
)
from btfref.representations.protocol import Entries, FitMemory

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from numpy.typing import ArrayLike

    from btfref.representations.lookup import Stencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: "paper": the setting of the 2004 paper's timings, 16 clusters with a mean and 4 components, in floats.
PRESETS = {"paper": {"clusters": 16, "components": 4, "storage": "float"}}

#: Dimension of the global subspace in which texels are clustered. The share of energy outside of it is recorded;
#: it bounds what clustering there can lose. The clusters' bases themselves come from the full vectors.
SUBSPACE_RANK = 64

#: Additional axes that take part in the step of subspace iteration, so that the kept ones converge.
OVERSAMPLING = 4

#: How often the values are read for that subspace; the clusters' bases take two passes more.
PASSES = 2

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(view=14, columns=SUBSPACE_RANK + 24, tables=("clusters", "components"))


class Representation(StoredMaps):
    """Maps of a local PCA.

    ``basis`` [cluster, 1 + component, view, light, 3] with the cluster's mean first, ``weights``
    [row, column, component], ``cluster`` [row, column, 1] uint32, and the direction tables.
    """

    DIRECTION_AXES: ClassVar = {"view": {"basis": 2}, "light": {"basis": 3}}
    DRAWS_VIEWS: ClassVar = True
    ENTRIES: ClassVar = Entries("cluster", {"basis": 0}, "weights")
    ROWS_BY: ClassVar = {"basis": (0, 2)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        maps = {
            "weights": MapSchema("rows columns components", absent=True),
            "basis": MapSchema("clusters components+1 views lights 3"),
            "cluster": MapSchema("rows columns 1", INDICES, below=("basis",)),
        }
        return Schema(maps, {"n_components": Number("components")})

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`; ``lod`` is ignored.

        May be slightly negative where the truncated expansion undershoots.
        """
        basis = self.maps["basis"]
        cluster = self.maps["cluster"].reshape(-1)
        weights = self.maps["weights"].reshape(len(cluster), -1)
        coefficient = real(np.concatenate([np.ones((len(weights), 1)), weights], 1))

        partial = self.meta.get("partial", False)

        def kernel(s: Stencils) -> np.ndarray:
            own = coefficient[s.texel]
            if partial:
                own = refuse_absent(own, s.texel_weight, "entries")
            texel_coefficient = s.texel_weight[:, :, None] * own
            index = (
                cluster[s.texel][:, :, None, None],
                slice(None),
                s.view[:, None, :, None],
                s.light[:, None, None, :],
            )
            table = real(basis[index])  # n, t, v, l, component, channel: advanced axes come first
            return np.einsum("ntk,nvl,ntvlkc->nc", texel_coefficient, s.pair_weight, table, optimize=True)

        return evaluate_tabulated(
            self, kernel, uv, w_light, w_view, draw=draw, gathered=4 * PAIRS * 3 * basis.shape[1]
        )

    def port_arrays(self) -> dict[str, np.ndarray]:
        """``basis`` [cluster, view, light, (1 + component) · 3]: one direction pair of one cluster is contiguous."""
        basis = np.moveaxis(self.maps["basis"], 1, 3)
        return packed_arrays(self.maps, basis=basis.reshape(*basis.shape[:3], -1))

    #: GLSL files that light the clusters' tables by spherical harmonics, and by them after transfer through a mesh.
    harmonic_shader = "environment/lpca_harmonics.glsl"
    transfer_shader = "environment/lpca_transfer.glsl"

    def shared_tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The tables over views and lights that texels share, and how texels combine them.

        Returns
        -------
        tables : ndarray of float, shape (cluster, 1 + component, view, light, 3)
            The cluster's mean first.
        cluster : ndarray of int64, shape (texels,)
        coefficient : ndarray of float64, shape (texels, 1 + component)
            ``B_x = Σ_m coefficient[x, m] tables[cluster[x], m]``; the first one is 1.
        """
        cluster = self.maps["cluster"].reshape(-1).astype(np.int64)
        # Of texels that are not there no table is known: what ports read of them is not a number.
        weights = np.nan_to_num(self.maps["weights"].reshape(len(cluster), -1).astype(float))
        return self.maps["basis"], cluster, np.concatenate([np.ones((len(weights), 1)), weights], 1)

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and their means."""
        basis = conventions.luminance(self.maps["basis"].astype(np.float32))
        cluster = self.maps["cluster"].reshape(-1)
        # Of what is not there the mean alone guides sampling.
        weights = np.nan_to_num(self.maps["weights"].reshape(len(cluster), -1).astype(np.float32))
        n_clusters, n_colours = basis.shape[:2]
        # Coefficients over all clusters' colours, zero outside of the texel's own.
        coefficient = np.zeros((len(cluster), n_clusters, n_colours), np.float32)
        coefficient[np.arange(len(cluster)), cluster] = np.concatenate(
            [np.ones((len(cluster), 1)), weights], 1
        )
        some = basis[:, :, feature_views(basis.shape[2])].reshape(n_clusters * n_colours, -1)
        labels = texel_groups(coefficient.reshape(len(cluster), -1) @ some)
        mean = np.tensordot(group_means(labels, coefficient), basis, 2)
        return labels.reshape(self.maps["cluster"].shape[:2]), mean


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    clusters: int = 16,
    components: int = 4,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Local PCA of ``btf``.

    Texels are clustered by reconstruction error in the span of a global PCA, then each cluster's PCA is taken on
    its members' full vectors.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Same seed, same result.
    progress : callable, optional
        ``progress(done, total, label)``.
    clusters, components : int
        At least 1. More clusters than texels, or more components than a cluster's members span, leave zeros.
    storage : {"half", "float"}
        Type of the stored maps; ``evaluate`` and the ports use the stored values.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds the relative squared error ("error"), the relative energy outside the clustering
        subspace ("outside_subspace"), the iterations and the cluster sizes.

    Raises
    ------
    InputError
        For parameters out of range, or values that do not fit ``storage``.
    """
    clusters, components = positive_integer("clusters", clusters), positive_integer("components", components)
    rng = np.random.default_rng(seed)
    rows, columns = btf.texels
    steps = Steps(progress, (PASSES + 2) * len(btf.views))
    steps.begin("global PCA")
    found = leading(TexelColumns(btf, steps), max(SUBSPACE_RANK, 2 * components), rng, passes=PASSES)
    coordinates, squares = found.coordinates.astype(float), found.squares
    energy = float(squares.sum())
    steps.begin("clustering")
    labels, iterations = local_pca(coordinates, clusters, components, rng)
    steps.begin("cluster bases")
    bases = ClusterBases(coordinates, labels, clusters, components)
    means, axes, weights, error = bases.of(btf, squares, steps)
    axes, peak = unit_peaks(axes)
    weights = weights * peak[labels]
    table = np.concatenate([means[:, None], axes], 1)
    table = table.reshape(clusters, 1 + components, len(btf.views), len(btf.lights), 3)
    maps = {
        "basis": stored("basis", table, storage),
        "weights": stored("weights", weights.reshape(rows, columns, components), storage),
        "cluster": labels.reshape(rows, columns, 1).astype(np.uint32),
    }
    parameters = {"clusters": clusters, "components": components, "storage": storage, "seed": seed}
    meta = base_meta("lpca", btf, parameters, filter_type=filter_type)
    meta["constants"] = {"n_components": components}
    meta["index_bytes"] = {"cluster": 1 if clusters <= 256 else 2}
    meta["fit"] = {
        "error": error / energy if energy > 0 else 0.0,
        "outside_subspace": max(0.0, 1 - float((coordinates**2).sum()) / energy) if energy > 0 else 0.0,
        "iterations": iterations,
        "cluster_sizes": np.bincount(labels, minlength=clusters).tolist(),
    }
    return Representation(maps | direction_arrays(btf.views, btf.lights), meta)


class ClusterBases:
    """Mean, axes and weights of each cluster from full vectors, in two passes over the data.

    The clusters' axes within the subspace are the start of one step of subspace iteration on the full vectors: one pass
    multiplies the members by their weights along them, the other one by what that spans.

    Parameters
    ----------
    coordinates : ndarray of float64, shape (n, r)
        Of the texels in the subspace.
    labels : ndarray of int, shape (n,)
    clusters, components : int
    """

    def __init__(self, coordinates: np.ndarray, labels: np.ndarray, clusters: int, components: int) -> None:
        self.clusters, self.components = clusters, components
        #: Texels cluster after cluster, and each one's part of them.
        self.order = np.argsort(labels, kind="stable")
        ends = np.cumsum(np.bincount(labels, minlength=clusters)).tolist()
        self.parts = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        self.used = [k for k, part in enumerate(self.parts) if part.stop > part.start]
        self.starts: dict[int, np.ndarray] = {}
        for k in self.used:
            own = coordinates[self.order[self.parts[k]]]
            start = leading_axes(own, components + OVERSAMPLING)
            weights = (own - own.mean(0)) @ start.T
            self.starts[k] = orthonormal(weights)[:, : len(own)].astype(np.float32)

    def of(
        self, btf: BTFBlocks, squares: np.ndarray, tick: Callable[[], object]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Means (cluster, d), axes (cluster, component, d), weights (n, component), and the squared error left.

        Parameters
        ----------
        btf : BTFBlocks
        squares : ndarray, shape (n,)
            Squared lengths of the texels' vectors.
        tick : callable
            Called after each view of a pass.
        """
        matrix = TexelColumns(btf, tick, self.order)
        n, d = matrix.shape
        means = np.zeros((self.clusters, d), np.float32)
        samples = {k: np.zeros((d, start.shape[1]), np.float32) for k, start in self.starts.items()}

        task = _Members(self.parts, self.starts)
        for columns, (own_means, own) in matrix.over(_sampled, task):
            for k in self.used:
                means[k, columns], samples[k][columns] = own_means[k], own[k]
        spans = {k: orthonormal(found) for k, found in samples.items()}
        projected = {k: np.zeros((self.parts[k].stop - self.parts[k].start, span.shape[1]))
                     for k, span in spans.items()}  # fmt: skip
        for _, own in matrix.over(_projected, (_Members(self.parts, spans), means)):
            for k in self.used:
                projected[k] += own[k]
        axes = np.zeros((self.clusters, self.components, d), np.float32)
        weights = np.zeros((n, self.components), np.float32)
        error = 0.0
        for k in self.used:
            basis, weight = principal(spans[k], projected[k])
            rank = min(self.components, len(basis))
            members = self.order[self.parts[k]]
            axes[k, :rank], weights[members, :rank] = basis[:rank], weight[:, :rank]
            error += squares[members].sum() - len(members) * float(means[k].astype(float) @ means[k])
            error -= float((weights[members].astype(float) ** 2).sum())
        return means, axes, weights, max(error, 0.0)


@dataclass(frozen=True)
class _Members:
    """Each cluster's part of the ordered texels, and by cluster that has some what their vectors are multiplied by."""

    parts: list[slice]
    factors: dict[int, np.ndarray]


def _sampled(
    task: _Members, columns: slice, block: np.ndarray
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """By cluster the members' means over a block's columns, (columns,), and the rest times the factors."""
    means: dict[int, np.ndarray] = {}
    samples: dict[int, np.ndarray] = {}

    def sample(k: int) -> None:
        members = block[:, task.parts[k]]
        means[k] = members.mean(1)
        members -= means[k][:, None]
        samples[k] = members @ task.factors[k]

    in_parallel(sample, task.factors)
    return means, samples


def _projected(task: tuple[_Members, np.ndarray], columns: slice, block: np.ndarray) -> dict[int, np.ndarray]:
    """By cluster the members' vectors less the mean times the factors, as far as a block's columns go, (n, w)."""
    members_of, means = task
    result: dict[int, np.ndarray] = {}

    def project(k: int) -> None:
        members = block[:, members_of.parts[k]]
        members -= means[k, columns, None]
        result[k] = members.T @ members_of.factors[k][columns]

    in_parallel(project, members_of.factors)
    return result
