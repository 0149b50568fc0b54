"""From factors to a stored representation: normalisation, codebooks, types of the maps, scales, and what that costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.factoring import TINY
from btfref.numerics.solvers.lowrank import range_basis
from btfref.numerics.solvers.threads import product, reproducible
from btfref.representations.factored.definition import (
    FACTORS,
    Representation,
    decoded,
    texel_parts,
)
from btfref.representations.factored.fit import Steps
from btfref.representations.factored.moments import moments_of
from btfref.representations.lookup import base_meta, direction_arrays, stored

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.representations.factored.fit import Factors, Step
    from btfref.representations.factored.moments import Moments
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress


#: Storage of the maps: floats, halves, or 8-bit codes of [0, 1].
STORAGES = ("float", "half", "byte")

#: 8-bit codes by name: the power of code / 255 that a value is.
CODES = {"linear": 1, "fourth": 4}

#: Maps of equal RMS are clustered, whatever they contribute: weighing them by their scales, or normalising peaks as the
#: paper does, costs checker, rings and tissue up to a quarter in colour difference. They are clustered in the span of
#: this many principal directions; of 3 · 32² dimensions, hardly more carry anything.
CLUSTERING_RANK = 64

#: Beyond this many maps, mini-batches replace whole passes.
MINI_BATCH_ABOVE = 1 << 16

#: Multiplicative steps of the scales of several terms; with one term the first step is exact.
SCALE_STEPS = 50


@dataclass(frozen=True)
class Storing:
    """How factors are stored.

    Attributes
    ----------
    clusters : int or None
        Largest codebook of each factor, at least 1; None: no clustering.
    storage : {"half", "float", "byte"}
        Type of the maps.
    scale_storage : {"half", "float", "byte"} or None
        Of the scale map. None: that of the maps.
    code : {"fourth", "linear"}
        What an 8-bit code c stands for: (c / 255)⁴, or c / 255 as in the paper. The fourth power keeps peaks to 0.8 %
        and a ten-thousandth of them to 8 %; linear codes make 0 of whatever is below 1/510 of a peak.
    rescale : bool
        Fit the scales to the data again, by weighted least squares, with the stored maps in place.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Raises
    ------
    InputError
        For a codebook size, a storage or a code that there is not.
    """

    clusters: int | None = 256
    storage: str = "half"
    scale_storage: str | None = None
    code: str = "fourth"
    rescale: bool = True
    filter_type: str = "bilinear"

    def __post_init__(self) -> None:
        clusters = self.clusters
        if clusters is not None and (
            isinstance(clusters, bool) or not isinstance(clusters, int) or clusters < 1
        ):
            raise InputError(
                "a parameter is out of range",
                field="clusters",
                got=repr(clusters),
                expected="an integer ≥ 1, or none",
            )
        for name, value, known in (
            ("storage", self.storage, STORAGES),
            ("scale_storage", self.scale_type, STORAGES),
            ("code", self.code, CODES),
        ):
            if value not in known:
                raise InputError(f"unknown {name}", field=name, got=repr(value), expected=" or ".join(known))

    @property
    def scale_type(self) -> str:
        """Type of the scale map."""
        return self.scale_storage or self.storage

    @property
    def map_power(self) -> int:
        """What the stored numbers of the maps are raised to."""
        return CODES[self.code] if self.storage == "byte" else 1

    @property
    def scale_power(self) -> int:
        """What the stored numbers of the scale map are raised to."""
        return CODES[self.code] if self.scale_type == "byte" else 1


def codebook(maps: np.ndarray, clusters: int | None, seed: int) -> tuple[np.ndarray, np.ndarray]:
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
        with reproducible():  # scikit-learn adds up centres thread by thread
            labels = kind(clusters, n_init=1, max_iter=50, random_state=seed).fit_predict(points)
    labels = np.unique(labels.reshape(-1), return_inverse=True)[1]
    share = np.zeros((int(labels.max()) + 1, len(maps)), np.float32)
    share[labels, np.arange(len(maps))] = 1
    share /= share.sum(1, keepdims=True)
    return labels, product(share, maps)


def stored_maps(name: str, maps: np.ndarray, storage: str, power: int) -> np.ndarray:
    """Maps in [0, 1] in the type of ``storage``, as numbers that are raised to ``power``."""
    maps = np.clip(maps, 0, 1) ** (1 / power) if power != 1 else maps
    if storage == "byte":
        return np.rint(np.clip(maps, 0, 1) * 255).astype(np.uint8)
    return stored(name, maps, storage)


def fitted(
    btf: BTFBlocks,
    factorize: Callable[[Step], Factors],
    storing: Storing,
    *,
    seed: int,
    progress: Progress | None,
    more_steps: int,
) -> Representation:
    """A whole fit: factors, codebooks, storage.

    Parameters
    ----------
    btf : BTFBlocks
    factorize : callable
        ``step -> Factors``; calls ``step(label)`` for each part of the texels and for what else it does.
    storing : Storing
    seed : int
    progress : callable or None
        ``progress(done, total, label)``.
    more_steps : int
        Besides the parts of the texels: calls of ``factorize``, factors to cluster, and one for the scales.

    Returns
    -------
    Representation
    """
    step = Steps(progress, len(texel_parts(int(np.prod(btf.texels)))) + more_steps)
    codebooks = cluster(factorize(step), storing.clusters, seed=seed, step=step)
    return store(btf, codebooks, storing, seed=seed, step=step)


@dataclass(frozen=True)
class Codebooks:
    """Prototypes of factors, normalised, in floats.

    Attributes
    ----------
    factors : btfref.representations.factored.fit.Factors
    prototypes : dict of str to ndarray of float32, shape (prototype, n, n, 3)
        In [0, 1], each channel with a peak of 1.
    labels : dict of str to ndarray of int, shape (texel, term)
    scale, half_scale : ndarray, shapes (texel, term, 3)
        Of the terms of P · R and of Q · D: together with the prototypes they make the clustered factors.
    """

    factors: Factors
    prototypes: dict[str, np.ndarray]
    labels: dict[str, np.ndarray]
    scale: np.ndarray
    half_scale: np.ndarray


def cluster(
    factors: Factors, clusters: int | None, *, seed: int = 0, step: Step = lambda label: None
) -> Codebooks:
    """Codebooks of factors.

    Parameters
    ----------
    factors : btfref.representations.factored.fit.Factors
    clusters : int or None
        Largest codebook of each factor, at least 1; None: no clustering.
    seed : int
    step : callable
        ``step(label)``, called for each factor.

    Returns
    -------
    Codebooks
    """
    maps = factors.maps
    # Maps are clustered at equal RMS, not at equal peaks: a peak is one texel, and prototypes get their own below.
    size = {name: np.sqrt(np.square(m, dtype=float).mean((2, 3))) for name, m in maps.items()}
    half_scale = size["q"] * size.get("d", 1)
    scale = size["p"] * size["r"]
    prototypes, labels = {}, {}
    for name in [f for f in FACTORS if f in maps]:
        step(f"clustering {name}")
        m = maps[name] / np.maximum(size[name], TINY).astype(np.float32)[:, :, None, None]
        found, book = codebook(m.reshape(-1, m[0, 0].size), clusters, seed)
        book = book.reshape(-1, *m.shape[2:])
        peak = book.max((1, 2))
        prototypes[name] = book / np.maximum(peak, TINY)[:, None, None]
        labels[name] = found.reshape(m.shape[:2])
        if name in "qd":
            half_scale = half_scale * peak[labels[name]]
        else:
            scale = scale * peak[labels[name]]
    return Codebooks(factors, prototypes, labels, scale, half_scale)


def store(
    btf: BTFBlocks, codebooks: Codebooks, storing: Storing, *, seed: int = 0, step: Step = lambda label: None
) -> Representation:
    """A stored representation.

    Parameters
    ----------
    btf : BTFBlocks
        What the codebooks stand for.
    codebooks : Codebooks
    storing : Storing
    seed : int
        Of the fit, for the file.
    step : callable
        ``step(label)``, called once.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds the facts of the factors, the relative squared error of what is stored ("error") and that
        before the scales were fitted again ("error_before_rescaling").
    """
    factors, power = codebooks.factors, storing.map_power
    scale, half_scale = codebooks.scale, codebooks.half_scale
    rows, columns = btf.texels
    arrays = {
        f"factor_{name}": stored_maps(name, maps, storing.storage, power)
        for name, maps in codebooks.prototypes.items()
    }
    top = half_scale.max(1, keepdims=True)
    scale, half_scale = scale * top, half_scale / np.where(top > 0, top, 1)
    index = np.concatenate(list(codebooks.labels.values()), 1).astype(np.uint32)
    arrays["index"] = index.reshape(rows, columns, -1)
    if half_scale.shape[1] > 1:
        half_scale_map = stored_maps("half_scale", half_scale, storing.storage, power)
        arrays["half_scale"] = half_scale_map.reshape(rows, columns, -1, 3)
    parameters = factors.parameters | {
        name: getattr(storing, name) for name in ("clusters", "storage", "scale_storage", "code", "rescale")
    }
    meta = base_meta(factors.method, btf, parameters | {"seed": seed}, filter_type=storing.filter_type)
    meta["constants"] = {
        "n_terms": scale.shape[1],
        "n_half_terms": half_scale.shape[1],
        "light_cos_last": float(np.float32(btf.lights.vectors[:, 2].min())),
        "map_power": power,
        "scale_power": storing.scale_power,
    }
    meta["index_bytes"] = {"index": 1 if index.max() < 256 else 2}
    step("scales")
    moments, weighted = moments_of(btf, arrays, meta["constants"], scale, half_scale, factors.exponent)
    error = _error(moments, scale)
    if storing.rescale:
        scale = _fitted_scale(weighted, scale)
    limit = scale.max(0)
    limit = np.where(limit > 0, limit, 1).astype(np.float32)
    scale_map = stored_maps("scale_map", scale / limit, storing.scale_type, storing.scale_power)
    arrays["scale_map"] = scale_map.reshape(rows, columns, -1, 3)
    arrays["scale_peak"] = limit
    kept = decoded(scale_map, storing.scale_power).reshape(scale.shape) * limit
    meta["fit"] = factors.facts | {"error": _error(moments, kept), "error_before_rescaling": error}
    return Representation(arrays | direction_arrays(btf.views, btf.lights), meta)


def _fitted_scale(moments: Moments, scale: np.ndarray) -> np.ndarray:
    """Non-negative scales of the terms that fit the data best, shape (texel, term, 3)."""
    _, product, gram = moments
    fitted = np.where(np.moveaxis(scale, 1, 2) > 0, np.moveaxis(scale, 1, 2), 0).astype(float)
    for _ in range(SCALE_STEPS if fitted.shape[-1] > 1 else 1):
        change = np.einsum("xcjk,xck->xcj", gram, fitted)
        fitted = fitted * np.where(change > 0, product / np.where(change > 0, change, 1), 0)
    return np.moveaxis(fitted, 1, 2)


def _error(moments: Moments, scale: np.ndarray) -> float:
    """Relative squared error of scaled terms."""
    energy, product, gram = moments
    s = np.moveaxis(np.asarray(scale, float), 1, 2)
    left = energy - 2 * (s * product).sum(-1) + np.einsum("xcj,xcjk,xck->xc", s, gram, s)
    return max(0.0, float(left.sum())) / float(energy.sum()) if energy.sum() > 0 else 0.0
