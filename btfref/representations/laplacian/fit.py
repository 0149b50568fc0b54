"""Fit of a Laplacian pyramid with principal components per level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.phong import fit_phong, phong
from btfref.numerics.pyramid import expand_image, gaussian_pyramid, level_shapes
from btfref.numerics.solvers.lowrank import range_basis, texel_matrix
from btfref.numerics.solvers.threads import product, reproducible
from btfref.numerics.ycbcr import CHANNELS, FROM_RGB, RGB_METRIC, RGB_WEIGHT
from btfref.representations.analytic.light_functions import edge_constants
from btfref.representations.laplacian.levels import Representation, level_constants
from btfref.representations.lookup import base_meta, direction_arrays, refuse_not_finite, stored, unit_peaks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.types import Facts, Progress


#: Numbers of components of Y, Cb and Cr at each level (section 3.3 of the paper).
COMPONENTS = (8, 2, 2)

#: Most components of one channel of a level where their number is chosen.
LARGEST = 64

#: ``mean="auto"`` takes the Phong model where its RMS misfit, as RGB, is at most this share of the mean's RMS: then it
#: is within the error that the components leave at their usual numbers. Otherwise the mean is stored.
PHONG_LIMIT = 0.02

#: Weights and basis of one channel of a level as they are stored.
StoredChannel = tuple[np.ndarray, np.ndarray]

_CHOICES = {
    "mean": ("auto", "phong", "stored"),
    "prediction": ("closed", "open"),
    "directions": ("interpolated", "nearest"),
}


@reproducible()
def fit(
    btf: SampledBTF,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    levels: int | None = None,
    components: int | str | Sequence[int] = COMPONENTS,
    target_error: float | None = None,
    mean: str = "auto",
    reduction: str = "binomial",
    prediction: str = "closed",
    directions: str = "interpolated",
    storage: str = "half",
    filter_type: str | None = None,
) -> Representation:
    """Laplacian pyramid of ``btf`` with principal components per level.

    Parameters
    ----------
    btf : SampledBTF
    seed : int
        Of the randomized subspace iteration; same seed, same result.
    progress : callable, optional
        ``progress(done, total, label)``.
    levels : int, optional
        λ_max + 1, at least 1; default: down to one texel.
    components : three int, or one for all
        Of Y, Cb and Cr at each level, at least 0; no more than a level's texels are kept.
    target_error : float, optional
        In place of ``components``: as few as keep the relative RMS error of each level's images, as RGB, at most this,
        (0, 1).
    mean : {"auto", "phong", "stored"}
        Of the coarsest level. "auto": Phong and constants where they fit to ``PHONG_LIMIT``.
    reduction : {"binomial", "box"}
        Kernel between levels.
    prediction : {"closed", "open"}
        Levels hold the difference to the compressed coarser ones, which corrects their error, or to the exact ones.
    directions : {"interpolated", "nearest"}
        Between measured directions.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}, optional
        Lookup between texels, and expansion of the levels; default "nearest" for the box, else "bilinear".

    Returns
    -------
    Representation
        ``meta["fit"]`` holds the relative squared error at λ = 0 ("error"), relative RMS errors of each level's images
        ("levels"), the mean squared error by channel ("mse", in 1/sr²), and the Phong model's misfit.

    Raises
    ------
    InputError
        For parameters out of range, or a target that no allowed number of components reaches.
    """
    for name, value in (("mean", mean), ("prediction", prediction), ("directions", directions)):
        if value not in _CHOICES[name]:
            raise InputError(
                "unknown value", field=name, got=repr(value), expected=" or ".join(_CHOICES[name])
            )
    counts = None if target_error is not None else _counts(components)
    if target_error is not None:
        if not 0 < float(target_error) < 1:
            raise InputError("out of range", field="target_error", got=target_error, expected="in (0, 1)")
        if prediction == "open":
            # Errors of coarser levels add up at the finer ones, where nothing corrects them.
            raise InputError("a target needs closed prediction", field="prediction", got=prediction)
    filter_type = filter_type or ("nearest" if reduction == "box" else "bilinear")
    texels = btf.values.shape[2:4]
    shapes = level_shapes(texels, None if levels is None else int(levels))
    report = progress or (lambda *_: None)
    report(0, len(shapes) + 1, "pyramid")
    images = _pyramids(btf, len(shapes), reduction)
    top = len(shapes) - 1
    maps, average, facts = _mean_maps(btf, [image[top] for image in images], mean, storage)
    rng = np.random.default_rng(seed)
    state = _Levels(images, average, prediction == "closed", filter_type, storage, len(btf.views), rng)
    described: list[Facts] = []
    for k in range(top, -1, -1):
        report(top - k + 1, len(shapes) + 1, f"level {k}")
        own = state.compress(k, counts, target_error)
        described.insert(0, {"rows": shapes[k][0], "columns": shapes[k][1], "components": own})
    maps = state.maps | maps
    parameters = {
        "levels": len(shapes),
        "components": list(counts) if counts else None,
        "target_error": target_error,
        "mean": mean,
        "reduction": reduction,
        "prediction": prediction,
        "directions": directions,
        "storage": storage,
        "seed": seed,
    }
    meta = base_meta("laplacian", btf, parameters, filter_type=filter_type)
    meta["levels"] = described
    meta["constants"] = level_constants(described) | {
        "nearest_directions": directions == "nearest",
        **edge_constants(btf),
    }
    meta["fit"] = {**state.errors(), **facts}
    if counts == COMPONENTS:
        meta["published_layout"] = packed_layout(len(shapes), texels, len(btf.views), len(btf.lights))
    return Representation(maps | direction_arrays(btf.views, btf.lights), meta)


def packed_layout(n_levels: int, texels: Sequence[int], n_views: int, n_lights: int) -> Facts:
    """Bytes of the paper's layout (section 3.3) and of the 24-bit images that it compares them with.

    Eigen map: three RGBA floats a direction pair and level, ``48 p q (λ_max + 1)``. Weight map: all levels side by
    side in one RGBA float texture of twice the size, ``64 r²``.

    Returns
    -------
    dict
    """
    eigen = 48 * n_views * n_lights * n_levels
    weights = 64 * texels[0] * texels[1]
    raw = 3 * n_views * n_lights * texels[0] * texels[1]
    return {
        "eigen_bytes": eigen,
        "weight_bytes": weights,
        "payload_bytes": eigen + weights,
        "raw_bytes": raw,
        "ratio": raw / (eigen + weights),
    }


def _counts(components: object) -> tuple[int, int, int]:
    """Numbers of components of Y, Cb and Cr from three integers, one for all, or text such as "8,2,2"."""
    values: Sequence[object] = components if isinstance(components, (list, tuple)) else (components,)
    if isinstance(components, str):
        values = [int(text) if text.strip().isdecimal() else text for text in components.split(",")]
    elif isinstance(components, (int, np.integer)):
        values = (components,) * 3
    numbers = [int(n) for n in values if isinstance(n, (int, np.integer)) and not isinstance(n, bool)]
    if not len(values) == len(numbers) == 3 or min(numbers) < 0 or not any(numbers):
        raise InputError(
            "numbers of components of Y, Cb and Cr",
            field="components",
            got=repr(components),
            expected="three integers ≥ 0, not all 0",
        )
    y, cb, cr = numbers
    return y, cb, cr


def _pyramids(btf: SampledBTF, n_levels: int, reduction: str) -> list[list[np.ndarray]]:
    """Gaussian pyramids [channel][level] of shape (rows, columns, pairs), float32."""
    rows, columns = btf.values.shape[2:4]
    matrix = texel_matrix(btf.values)
    refuse_not_finite(matrix, btf)
    matrix = matrix.reshape(rows, columns, -1, 3)
    return [gaussian_pyramid(matrix @ row.astype(np.float32), n_levels, reduction) for row in FROM_RGB]


def _mean_maps(
    btf: SampledBTF, tops: list[np.ndarray], choice: str, storage: str
) -> tuple[dict[str, np.ndarray], list[np.ndarray], Facts]:
    """Mean of the coarsest level: maps, its values [channel] at all pairs as stored, and facts on the Phong model."""
    table = np.stack([top.mean((0, 1), dtype=float) for top in tops], -1)
    shape = len(btf.views), len(btf.lights), 3
    rms = np.sqrt((table**2 @ RGB_WEIGHT).mean())
    facts = {}
    if choice != "stored":
        parameters, misfit = fit_phong(table[:, 0].reshape(shape[:2]), btf.views.vectors, btf.lights.vectors)
        constants = table[:, 1:].mean(0)
        spread = ((table[:, 1:] - constants) ** 2).mean(0)
        total = np.sqrt(misfit**2 * RGB_WEIGHT[0] + spread @ RGB_WEIGHT[1:])
        facts["phong_misfit"] = float(total / rms) if rms > 0 else 0.0
        if choice == "phong" or facts["phong_misfit"] <= PHONG_LIMIT:
            row = np.concatenate([parameters, constants]).astype(np.float32)
            w_view, w_light = np.broadcast_arrays(btf.views.vectors[:, None], btf.lights.vectors[None])
            luminance = phong(row[:4], w_light, w_view).ravel().astype(np.float32)
            values = [luminance, np.full_like(luminance, row[4]), np.full_like(luminance, row[5])]
            return {"phong": row[None]}, values, {**facts, "mean": "phong"}
    kept = stored("mean", table.reshape(shape), storage)
    return {"mean": kept}, list(kept.astype(np.float32).reshape(-1, 3).T), {**facts, "mean": "stored"}


class _Levels:
    """Levels compressed from the coarsest to the finest; ``maps`` and errors grow as they are.

    Parameters
    ----------
    images : list of list of ndarray
        Gaussian pyramids [channel][level], shape (rows, columns, pairs).
    average : list of ndarray, shape (pairs,)
        Mean of the coarsest level, [channel].
    closed : bool
    filter_type, storage : str
    n_views : int
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        images: list[list[np.ndarray]],
        average: list[np.ndarray],
        closed: bool,
        filter_type: str,
        storage: str,
        n_views: int,
        rng: np.random.Generator,
    ) -> None:
        self.images, self.average, self.closed = images, average, closed
        self.filter_type, self.storage, self.n_views, self.rng = filter_type, storage, n_views, rng
        self.maps: dict[str, np.ndarray] = {}
        self.level_errors: dict[int, float] = {}
        self.gram = np.zeros((3, 3))
        #: [channel]: coarser levels as they are stored, and as they were.
        self.kept: list[list[StoredChannel]] = [[] for _ in CHANNELS]
        self.exact: list[list[np.ndarray]] = [[] for _ in CHANNELS]

    def _predicted(self, channel: int, shape: tuple[int, ...], *, exact: bool) -> np.ndarray:
        """A level from the coarser ones, shape (texels, pairs)."""
        total = np.zeros((int(np.prod(shape)), 1), np.float32) + self.average[channel]
        if exact:
            for level in self.exact[channel]:
                total += expand_image(level, shape, self.filter_type).reshape(total.shape)
        else:
            for weights, basis in self.kept[channel]:
                total += product(
                    expand_image(weights, shape, self.filter_type).reshape(len(total), -1), basis
                )
        return total

    def compress(self, k: int, counts: tuple[int, int, int] | None, target: float | None) -> list[int]:
        """Compress level k to the given numbers of components, or to as few as reach the target; returns them."""
        shape = self.images[0][k].shape[:2]
        flat = [image[k].reshape(shape[0] * shape[1], -1) for image in self.images]
        energy = float((RGB_METRIC * _gram(flat)).sum())
        # The mean takes a dimension: of n texels, n − 1 differences to it are independent.
        limit = shape[0] * shape[1] - (k == len(self.images[0]) - 1)
        rests = [f - self._predicted(c, shape, exact=not self.closed) for c, f in enumerate(flat)]
        wanted = counts or (LARGEST,) * 3
        ranges = [self._range(r, min(limit, n)) for r, n in zip(rests, wanted, strict=True)]
        own = [len(basis) for basis, _ in ranges]
        aimed = allowed = np.inf if target is None else target**2 * energy
        while True:
            if target is not None:
                own = _fewest(rests, [coordinate for _, coordinate in ranges], aimed, k)
            parts = [self._stored(k, *part, n) for part, n in zip(ranges, own, strict=True)]
            left = [r - _product(part) for r, part in zip(rests, parts, strict=True)]
            error = float((RGB_METRIC * _gram(left)).sum())
            if target is None or error <= allowed or aimed == 0:
                break
            # Channels' errors are correlated and stored maps are rounded: aim lower.
            aimed = 0.9 * aimed if aimed > 1e-6 * allowed else 0.0
        self._keep(k, shape, rests, parts)
        if not self.closed:
            left = [f - self._predicted(c, shape, exact=False) for c, f in enumerate(flat)]
            error = float((RGB_METRIC * _gram(left)).sum())
        self.gram = _gram(left) / left[0].size
        self.level_errors[k] = np.sqrt(error / energy) if energy > 0 else 0.0
        return [int(n) for n in own]

    def _range(self, rest: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
        if rank == 0:
            return np.zeros((0, rest.shape[1]), np.float32), np.zeros((len(rest), 0), np.float32)
        return range_basis(rest, rank, self.rng, iterations=2)

    def _stored(self, k: int, basis: np.ndarray, coordinate: np.ndarray, n: int) -> StoredChannel:
        """Weights and basis of the first components as they are stored."""
        shapes, peak = unit_peaks(basis[:n])
        weights = stored(f"weights_{k}", coordinate[:, :n] * peak, self.storage)
        return weights, stored(f"basis_{k}", shapes, self.storage)

    def _keep(
        self, k: int, shape: tuple[int, ...], rests: list[np.ndarray], parts: list[StoredChannel]
    ) -> None:
        for channel, (weights, basis) in enumerate(parts):
            if len(basis):
                wide = weights.astype(np.float32).reshape(*shape, -1), basis.astype(np.float32)
                self.kept[channel].append(wide)
            if not self.closed:
                self.exact[channel].append(rests[channel].reshape(*shape, -1))
        basis = np.concatenate([basis for _, basis in parts])
        if len(basis):
            table = np.ascontiguousarray(basis.T).reshape(self.n_views, -1, len(basis))
            self.maps[f"basis_{k}"] = table
            self.maps[f"weights_{k}"] = np.concatenate([w for w, _ in parts], 1).reshape(*shape, -1)

    def errors(self) -> Facts:
        """JSON-able errors of the finest level and of all."""
        return {
            "error": float(self.level_errors[0] ** 2),
            "levels": [float(self.level_errors[k]) for k in sorted(self.level_errors)],
            "mse": dict(zip(CHANNELS, np.diag(self.gram).tolist(), strict=True)),
        }


def _product(part: StoredChannel) -> np.ndarray:
    weights, basis = (a.astype(np.float32) for a in part)
    return product(weights, basis)


def _gram(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Inner products of the channels' arrays, shape (3, 3), in float64 by rows."""
    return np.array([[np.einsum("ij,ij->i", a, b).sum(dtype=float) for b in arrays] for a in arrays])


def _fewest(rests: list[np.ndarray], coordinates: list[np.ndarray], allowed: float, level: int) -> list[int]:
    """Numbers of components by channel that leave at most ``allowed`` of weighted squared error, greedily."""
    gains = [
        np.einsum("nk,nk->k", c, c, dtype=float) * w for c, w in zip(coordinates, RGB_WEIGHT, strict=True)
    ]
    left = float(np.diag(_gram(rests)) @ RGB_WEIGHT)
    own = [0, 0, 0]
    while left > allowed:
        following = [g[n] if n < len(g) else -1.0 for g, n in zip(gains, own, strict=True)]
        best = int(np.argmax(following))
        if following[best] < 0:
            raise InputError(
                f"the target needs more than {LARGEST} components of a channel at level {level}",
                field="target_error",
                expected="a larger error",
            )
        left -= following[best]
        own[best] += 1
    return own
