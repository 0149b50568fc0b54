"""What benchmarks build: the registry's methods, and what people would take instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.bench.plan import Entry
    from btfref.registry import Method
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.types import Progress


@dataclass(frozen=True)
class Built:
    """Something that can be asked for values.

    Attributes
    ----------
    evaluate : callable
        ``(uv, w_light, w_view) -> B``, shapes (N, 2), (N, 3), (N, 3) -> (N, 3).
    payload : int
        Bytes that a lookup needs.
    representation : Representation or None
        Of a method: what the ports load.
    """

    evaluate: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    payload: int
    representation: Representation | None = None


def build(
    entry: Entry,
    btf: SampledBTF,
    *,
    seed: int = 0,
    payload: int | None = None,
    progress: Progress | None = None,
) -> Built:
    """Build an entry of a plan from a sampled BTF.

    Parameters
    ----------
    entry : btfref.bench.plan.Entry
    btf : SampledBTF
    seed : int
    payload : int, optional
        Bytes to match, for an entry with ``bytes_of``.
    progress : callable, optional

    Returns
    -------
    Built
    """
    if entry.peer:
        return PEERS[entry.peer].build(btf, seed=seed, **entry.build)
    from btfref.registry import method

    row = method(entry.method)
    parameters = dict(entry.build)
    preset = parameters.pop("preset", None)
    if preset is not None:
        parameters = {**row.presets[preset], **parameters}
    if payload is not None:
        parameters |= _rank_of_bytes(row, btf, payload, seed)
    rep = row.fit(btf, seed=seed, progress=progress, **parameters)
    return Built(rep.evaluate, payload_of(rep), rep)


def payload_of(rep: Representation) -> int:
    """Bytes of a representation's maps."""
    from btfref.representations.file.container import payload_bytes

    return payload_bytes({name: (a.shape, a.dtype.name) for name, a in rep.arrays().items()}, rep.meta)


def _rank_of_bytes(row: Method, btf: SampledBTF, payload: int, seed: int) -> dict[str, int]:
    """The largest number of components whose maps are no larger than ``payload``: bytes grow linearly."""
    one, two = (payload_of(row.fit(btf, seed=seed, components=k)) for k in (1, 2))
    return {"components": max(1, 1 + (payload - one) // (two - one))}


def local_pca(btf: SampledBTF, *, seed: int = 0, clusters: int = 16, components: int = 4) -> Built:
    """k-means and one PCA per cluster from scikit-learn, with its defaults; evaluated at the nearest samples."""
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    from btfref.numerics.solvers.lowrank import texel_matrix

    matrix = texel_matrix(btf.values)
    labels = KMeans(clusters, random_state=seed).fit_predict(matrix)
    model, payload = np.zeros_like(matrix), 0
    for k in range(clusters):
        members = matrix[labels == k]
        pca = PCA(min(components, len(members)), random_state=seed).fit(members)
        weights = pca.transform(members)
        model[labels == k] = pca.inverse_transform(weights)
        payload += 2 * (pca.components_.size + pca.mean_.size + weights.size)
    shape = btf.values.shape
    # Texels are rows of the matrix: back to [view, light, texel, channel].
    values = np.moveaxis(model.reshape(-1, shape[0], shape[1], 3), 0, 2)

    def evaluate(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
        texel = _nearest_texel(uv, shape[2:4])
        view, light = _nearest(btf.views.vectors, w_view), _nearest(btf.lights.vectors, w_light)
        return values[view, light, texel]

    return Built(evaluate, payload)


def nearest_neighbours(btf: SampledBTF, *, seed: int = 0, neighbours: int = 4) -> Built:
    """The raw table, looked up by a k-d tree over pairs of directions and weighted by inverse distance.

    This is what a plugin in plain NumPy and SciPy does: one tree over all pairs (w_view, w_light) in six dimensions.
    """
    from scipy.spatial import cKDTree

    shape = btf.values.shape
    pairs = np.concatenate(
        [np.repeat(btf.views.vectors, shape[1], 0), np.tile(btf.lights.vectors, (shape[0], 1))], 1
    )
    tree = cKDTree(pairs)
    values = btf.values.reshape(shape[0] * shape[1], -1, 3)

    def evaluate(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
        distance, pair = tree.query(np.concatenate([w_view, w_light], 1), k=neighbours)
        weight = 1 / np.maximum(distance, 1e-9)
        weight /= weight.sum(1, keepdims=True)
        texel = _nearest_texel(uv, shape[2:4])
        return np.einsum("nk,nkc->nc", weight, values[pair, texel[:, None]].astype(float))

    return Built(evaluate, btf.values.nbytes)


def _nearest(directions: np.ndarray, w: np.ndarray) -> np.ndarray:
    return np.argmax(np.asarray(w) @ directions.T, 1)


def _nearest_texel(uv: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    rows, columns = shape
    column = np.floor(np.mod(uv[:, 0], 1) * columns).astype(int) % columns
    return np.floor(np.mod(uv[:, 1], 1) * rows).astype(int) % rows * columns + column


@dataclass(frozen=True)
class Peer:
    """What people would take instead of a method.

    Attributes
    ----------
    title : str
        In tables.
    build : callable
        ``(btf, *, seed, **parameters) -> Built``.
    """

    title: str
    build: Callable[..., Built]


#: What is no method of ours, by key.
PEERS = {
    "sklearn": Peer("scikit-learn KMeans + PCA", local_pca),
    "nearest": Peer("raw, k nearest pairs in NumPy", nearest_neighbours),
}
