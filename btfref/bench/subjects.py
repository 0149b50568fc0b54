"""What benchmarks build: the registry's methods, and what people would take instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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

    evaluate: object
    payload: int
    representation: object = None


def build(entry, btf, *, seed=0, payload=None, progress=None):
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
        return PEERS[entry.peer](btf, seed=seed, **entry.build)
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


def payload_of(rep):
    """Bytes of a representation's maps."""
    from btfref.representations.file.container import payload_bytes

    return payload_bytes({name: (a.shape, a.dtype.name) for name, a in rep.maps.items()}, rep.meta)


def _rank_of_bytes(row, btf, payload, seed):
    """The largest number of components whose maps are no larger than ``payload``: bytes grow linearly."""
    one, two = (payload_of(row.fit(btf, seed=seed, components=k)) for k in (1, 2))
    return {"components": max(1, 1 + (payload - one) // (two - one))}


def local_pca(btf, *, seed=0, clusters=16, components=4):
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

    def evaluate(uv, w_light, w_view):
        texel = _nearest_texel(uv, shape[2:4])
        view, light = _nearest(btf.views.vectors, w_view), _nearest(btf.lights.vectors, w_light)
        return values[view, light, texel]

    return Built(evaluate, payload)


def nearest_neighbours(btf, *, seed=0, neighbours=4):
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

    def evaluate(uv, w_light, w_view):
        distance, pair = tree.query(np.concatenate([w_view, w_light], 1), k=neighbours)
        weight = 1 / np.maximum(distance, 1e-9)
        weight /= weight.sum(1, keepdims=True)
        texel = _nearest_texel(uv, shape[2:4])
        return np.einsum("nk,nkc->nc", weight, values[pair, texel[:, None]].astype(float))

    return Built(evaluate, btf.values.nbytes)


def _nearest(directions, w):
    return np.argmax(np.asarray(w) @ directions.T, 1)


def _nearest_texel(uv, shape):
    rows, columns = shape
    column = np.floor(np.mod(uv[:, 0], 1) * columns).astype(int) % columns
    return np.floor(np.mod(uv[:, 1], 1) * rows).astype(int) % rows * columns + column


local_pca.title = "scikit-learn KMeans + PCA"
nearest_neighbours.title = "raw, k nearest pairs in NumPy"

#: What is no method of ours: key -> function.
PEERS = {"sklearn": local_pca, "nearest": nearest_neighbours}
