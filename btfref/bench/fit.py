"""Fitting: local PCA against k-means and one PCA per cluster from scikit-learn, on the same data."""

from __future__ import annotations

import numpy as np

from btfref.bench.timing import interleaved, machine, summary
from btfref.errors import InputError

BASELINE = "scikit-learn KMeans + PCA"
CLUSTERS, COMPONENTS = 16, 4


def run(*, quick=False, progress=None, btf=None, only=None):
    """Time and error of ``lpca`` and of its peer.

    Parameters
    ----------
    quick : bool
        One round instead of three.
    progress : callable, optional
    btf : SampledBTF, optional
        Default: a checker of 64² texels and 81² directions at 8 samples.
    only : iterable of str, optional
        Must hold "lpca", the one method with a peer here.

    Returns
    -------
    dict
        ``raw``: seconds, ``summary``, ``errors``: relative squared errors on the sampled BTF, ``parameters``,
        ``machine``.
    """
    from btfref.bench.data import checker
    from btfref.numerics.lowrank import texel_matrix
    from btfref.representations import lpca

    if only and "lpca" not in only:
        raise InputError("nothing to measure", field="--only", got=", ".join(only), expected="lpca")
    btf = btf or checker(spp=8, progress=progress)
    errors = {}

    def ours():
        fitted = lpca.fit(btf, clusters=CLUSTERS, components=COMPONENTS, storage="float")
        errors["lpca"] = fitted.meta["fit"]["error"]

    def peer():
        # Both start from the sampled BTF.
        errors[BASELINE] = sklearn_error(texel_matrix(btf.values))

    rounds = 1 if quick else 3
    raw = interleaved({"lpca": ours, BASELINE: peer}, rounds)
    parameters = {
        "clusters": CLUSTERS,
        "components": COMPONENTS,
        "shape": list(btf.values.shape),
        "rounds": rounds,
    }
    return {
        "suite": "fit",
        "parameters": parameters,
        "raw": raw,
        "summary": summary(raw, BASELINE),
        "errors": errors,
        "machine": machine(),
    }


def sklearn_error(matrix):
    """Relative squared error of k-means and one PCA per cluster with scikit-learn's defaults, shape (n, d)."""
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    labels = KMeans(CLUSTERS, random_state=0).fit_predict(matrix)
    error = 0.0
    for k in range(CLUSTERS):
        members = matrix[labels == k]
        pca = PCA(min(COMPONENTS, len(members)), random_state=0).fit(members)
        rest = members - pca.inverse_transform(pca.transform(members))
        error += float(np.einsum("ij,ij->", rest, rest, dtype=np.float64))
    return error / float(np.einsum("ij,ij->", matrix, matrix, dtype=np.float64))


def table(result):
    """Rows for people: method, median, ratio with its spread, relative squared error."""
    header = ("method", "median s", "ratio", "ratio range", "relative squared error")
    rows = [
        (
            name,
            f"{s['median_s']:.2f}",
            f"{s['ratio']:.3f}",
            f"{s['ratio_min']:.3f} to {s['ratio_max']:.3f}",
            f"{result['errors'][name]:.6f}",
        )
        for name, s in result["summary"].items()
    ]
    return header, rows
