"""From fitted factors to a stored representation: scales, codebooks, storage, and what each step costs."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.numerics.factoring import TINY, FactorOperators, sample_weights, sparse_operator
from btfref.numerics.halfway import half_difference
from btfref.numerics.lowrank import range_basis
from btfref.numerics.parabolic import bilinear_stencil
from btfref.representations.factored import (
    FACTORS,
    Representation,
    batch_last,
    decoded,
    index_slots,
    texel_parts,
)
from btfref.representations.lookup import base_meta, direction_arrays, stored

#: Storage of the maps: floats, halves, or 8-bit codes of [0, 1].
STORAGES = ("float", "half", "byte")

#: Maps of equal RMS are clustered, whatever they contribute: weighing them by their scales, or normalising peaks as the
#: paper does, costs checker, rings and tissue up to a quarter in colour difference. They are clustered in the span of
#: this many principal directions; of 3 · 32² dimensions, hardly more carry anything.
CLUSTERING_RANK = 64

#: Beyond this many maps, mini-batches replace whole passes.
MINI_BATCH_ABOVE = 1 << 16

#: Multiplicative steps of the scales of several terms; with one term the first step is exact.
SCALE_STEPS = 50


def check_parameters(*, clusters, storage, scale_storage):
    """Raise InputError for a codebook size or a storage that there is not."""
    if clusters is not None and (isinstance(clusters, bool) or not isinstance(clusters, int) or clusters < 1):
        raise InputError(
            "a parameter is out of range",
            field="clusters",
            got=repr(clusters),
            expected="an integer ≥ 1, or none",
        )
    for name, value in (("storage", storage), ("scale_storage", scale_storage or storage)):
        if value not in STORAGES:
            raise InputError("unknown storage", field=name, got=repr(value), expected=" or ".join(STORAGES))


def unit_tables(btf, texels):
    """Tables of some texels with a mean of 1, and their means.

    Parameters
    ----------
    btf : SampledBTF
    texels : ndarray of int, shape (k,)
        Flat indices.

    Returns
    -------
    tables : ndarray of float32, shape (view, light, k * 3)
        Negative values (noise of a measurement) count as 0; a black texel stays 0.
    mean : ndarray of float32, shape (k * 3,)

    Raises
    ------
    InputError
        For a value that is not finite.
    """
    views, lights = btf.values.shape[:2]
    tables = (
        btf.values.reshape(views, lights, -1, 3)[:, :, texels].astype(np.float32).reshape(views, lights, -1)
    )
    if not np.isfinite(tables).all():
        raise InputError("a value is not finite", file=btf.path, field="values")
    tables = np.maximum(tables, 0)
    mean = tables.mean((0, 1))
    return tables / np.where(mean > 0, mean, 1), mean


def map_operators(views, lights, n, with_difference):
    """How n × n parabolic maps are read at all pairs of directions.

    Parameters
    ----------
    views, lights : ndarray, shape (…, 3)
    n : int
    with_difference : bool

    Returns
    -------
    FactorOperators
    """
    h, d = half_difference(lights[None], views[:, None])
    directions = {"p": lights, "q": h.reshape(-1, 3), "r": views, "d": d.reshape(-1, 3)}
    if not with_difference:
        del directions["d"]
    return FactorOperators(
        **{name: sparse_operator(*bilinear_stencil(w, n), n * n) for name, w in directions.items()}
    )


def codebook(maps, clusters, seed):
    """Prototypes of maps by k-means.

    Parameters
    ----------
    maps : ndarray of float32, shape (m, d)
        Non-negative.
    clusters : int or None
        At most so many prototypes; None keeps every map.
    seed : int

    Returns
    -------
    labels : ndarray of int, shape (m,)
    prototypes : ndarray of float32, shape (k, d)
        Means of their members.
    """
    if clusters is None or len(maps) <= clusters:
        return np.arange(len(maps)), maps
    rng = np.random.default_rng(seed)
    _, points = range_basis(maps, CLUSTERING_RANK, rng)
    # Maps of equal texels differ by rounding; k-means wants no more clusters than distinct points.
    distinct, labels = np.unique(np.round(points, 4), axis=0, return_inverse=True)
    if len(distinct) > clusters:
        from sklearn.cluster import KMeans, MiniBatchKMeans

        kind = MiniBatchKMeans if len(points) > MINI_BATCH_ABOVE else KMeans
        labels = kind(clusters, n_init=1, max_iter=50, random_state=seed).fit_predict(points)
    labels = np.unique(labels.reshape(-1), return_inverse=True)[1]
    share = np.zeros((int(labels.max()) + 1, len(maps)), np.float32)
    share[labels, np.arange(len(maps))] = 1
    share /= share.sum(1, keepdims=True)
    return labels, share @ maps


def stored_maps(name, maps, storage):
    """Maps in [0, 1] in the type of ``storage``."""
    if storage == "byte":
        return np.rint(np.clip(maps, 0, 1) * 255).astype(np.uint8)
    return stored(name, maps, storage)


def assemble(method, btf, maps, parameters, *, exponent, filter_type, report):
    """Normalise, cluster and store factors.

    Parameters
    ----------
    method : str
    btf : SampledBTF
    maps : dict of str to ndarray of float32, shape (texel, term, n, n, 3)
        "p", "q", "r" and perhaps "d"; overwritten.
    parameters : dict
        Of the fit, for the file. Here count ``clusters`` (prototypes of each factor, or None), ``storage`` and
        ``scale_storage`` ("float", "half" or "byte"; None: that of the maps, but half for "byte"), ``rescale`` (fit
        the scales to the data again, by weighted least squares, with the stored maps in place) and ``seed``.
    exponent : float
        Of the weights; see :func:`btfref.numerics.factoring.sample_weights`.
    filter_type : {"bilinear", "nearest"}
    report : callable
        ``report(label)``.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds the relative squared error ("error") and that before the scales were fitted again.
    """
    storage, scale_storage = parameters["storage"], parameters["scale_storage"]
    # Maps are clustered at equal RMS, not at equal peaks: a peak is one texel, and prototypes get their own below.
    size = {name: np.sqrt(np.square(m, dtype=float).mean((2, 3))) for name, m in maps.items()}
    half_scale = size["q"] * size.get("d", 1)
    scale = size["p"] * size["r"]
    n, rows, columns = maps["p"].shape[2], *btf.values.shape[2:4]
    arrays, index = {}, []
    for name in [f for f in FACTORS if f in maps]:
        report(f"clustering {name}")
        m = maps.pop(name)
        m /= np.maximum(size[name], TINY)[:, :, None, None]
        labels, prototypes = codebook(m.reshape(-1, n * n * 3), parameters["clusters"], parameters["seed"])
        prototypes = prototypes.reshape(-1, n, n, 3)
        peak = prototypes.max((1, 2))
        prototypes /= np.maximum(peak, TINY)[:, None, None]
        arrays[f"factor_{name}"] = stored_maps(name, prototypes, storage)
        labels = labels.reshape(m.shape[:2])
        if name in "qd":
            half_scale = half_scale * peak[labels]
        else:
            scale = scale * peak[labels]
        index.append(labels)
    top = half_scale.max(1, keepdims=True)
    scale, half_scale = scale * top, half_scale / np.where(top > 0, top, 1)
    index = np.concatenate(index, 1).astype(np.uint32)
    arrays["index"] = index.reshape(rows, columns, -1)
    if half_scale.shape[1] > 1:
        arrays["half_scale"] = stored_maps("half_scale", half_scale, storage).reshape(rows, columns, -1, 3)
    meta = base_meta(method, btf, parameters, filter_type=filter_type)
    meta["constants"] = {
        "n_terms": scale.shape[1],
        "n_half_terms": half_scale.shape[1],
        "light_cos_last": float(np.float32(btf.lights.vectors[:, 2].min())),
    }
    meta["index_bytes"] = {"index": 1 if index.max() < 256 else 2}
    report("scales")
    moments, weighted = _moments(btf, arrays, meta["constants"], half_scale, exponent)
    error = _error(moments, scale)
    if parameters["rescale"]:
        scale = _fitted_scale(weighted, scale)
    limit = scale.max(0)
    limit = np.where(limit > 0, limit, 1).astype(np.float32)
    kind = scale_storage or ("half" if storage == "byte" else storage)
    arrays["scale_map"] = stored_maps("scale_map", scale / limit, kind).reshape(rows, columns, -1, 3)
    arrays["scale_peak"] = limit
    kept = decoded(arrays["scale_map"]).reshape(scale.shape) * limit
    meta["fit"] = {"error": _error(moments, kept), "error_before_rescaling": error}
    return Representation(arrays | direction_arrays(btf.views, btf.lights), meta)


def _moments(btf, arrays, constants, half_scale, exponent):
    """Inner products of data and unscaled terms, per texel and channel: plain ones and weighted ones.

    Returns
    -------
    moments, weighted : tuple of ndarray
        Of the data with itself (texel, 3), with the terms (texel, 3, term), and of the terms (texel, 3, term, term).
    """
    operators = map_operators(
        btf.views.vectors, btf.lights.vectors, arrays["factor_p"].shape[1], "factor_d" in arrays
    )
    slots = index_slots(constants)
    index = arrays["index"].reshape(-1, arrays["index"].shape[-1])
    if "half_scale" in arrays:
        half_scale = decoded(arrays["half_scale"]).reshape(half_scale.shape)
    parts = [], []
    for texels in texel_parts(len(index)):
        data, mean = unit_tables(btf, texels)
        factors = {}
        for name in FACTORS:
            if f"factor_{name}" in arrays:
                m = decoded(arrays[f"factor_{name}"][index[texels, slots[name]]], np.float32)
                if name == "q":
                    m = m * half_scale[texels][:, :, None, None].astype(np.float32)
                factors[name] = batch_last(m)
        half = operators.half(factors)
        p, r = operators.read("p", factors["p"]), operators.read("r", factors["r"])
        terms = np.stack([half * a[:, None] * b for a, b in zip(r, p, strict=True)])
        for part, weight in zip(parts, (1, sample_weights(data, exponent)), strict=True):
            heavy = weight * terms
            scale = mean.astype(float)
            part.append(
                (
                    np.einsum("vlm,vlm->m", weight * data, data) * scale**2,
                    np.einsum("vlm,kvlm->mk", data, heavy) * scale[:, None],
                    np.einsum("jvlm,kvlm->mjk", terms, heavy).astype(float),
                )
            )
    return tuple(
        tuple(np.concatenate(m).reshape(len(index), 3, *m[0].shape[1:]) for m in zip(*part, strict=True))
        for part in parts
    )


def _fitted_scale(moments, scale):
    """Non-negative scales of the terms that fit the data best, shape (texel, term, 3)."""
    _, product, gram = moments
    fitted = np.where(np.moveaxis(scale, 1, 2) > 0, np.moveaxis(scale, 1, 2), 0).astype(float)
    for _ in range(SCALE_STEPS if fitted.shape[-1] > 1 else 1):
        change = np.einsum("xcjk,xck->xcj", gram, fitted)
        fitted = fitted * np.where(change > 0, product / np.where(change > 0, change, 1), 0)
    return np.moveaxis(fitted, 1, 2)


def _error(moments, scale):
    """Relative squared error of scaled terms."""
    energy, product, gram = moments
    s = np.moveaxis(np.asarray(scale, float), 1, 2)
    left = energy - 2 * (s * product).sum(-1) + np.einsum("xcj,xcjk,xck->xc", s, gram, s)
    return max(0.0, float(left.sum())) / float(energy.sum()) if energy.sum() > 0 else 0.0
