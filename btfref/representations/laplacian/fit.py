"""Fit of a Laplacian pyramid with principal components per level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.phong import fit_phong, phong
from btfref.numerics.pyramid import level_shapes
from btfref.numerics.solvers.streaming import OVERSAMPLING, GramPass
from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.ycbcr import CHANNELS, RGB_METRIC, RGB_WEIGHT
from btfref.representations.analytic.light_functions import edge_constants
from btfref.representations.columns import Steps
from btfref.representations.laplacian.images import PyramidImages, expanded
from btfref.representations.laplacian.levels import Representation, level_constants
from btfref.representations.laplacian.rests import Exact, Model, gram, rest_gram, rest_products
from btfref.representations.lookup import base_meta, direction_arrays, stored, unit_peaks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from btfref.representations.laplacian.images import Images
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


#: Numbers of components of Y, Cb and Cr at each level (section 3.3 of the paper).
COMPONENTS = (8, 2, 2)

#: How often a level's differences are gone through for their components; once more for the error that these leave.
PASSES = 2

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
    btf: BTFBlocks,
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
    btf : BTFBlocks
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
    shapes = level_shapes(btf.texels, None if levels is None else int(levels))
    steps = Steps(progress, 0)
    images = PyramidImages(btf, len(shapes), reduction, steps)
    # A pass for the pyramids, and those for each level that is not kept.
    steps.total = len(btf.views) * (1 + (PASSES + 1) * images.first_kept) + len(shapes)
    steps.begin("pyramid")
    energy, table = _first_pass(images)
    maps, average, facts = _mean_maps(btf, table, mean, storage)
    rng = np.random.default_rng(seed)
    state = _Levels(
        images, energy, average, prediction == "closed", filter_type, storage, len(btf.views), rng
    )
    described: list[Facts] = []
    for k in range(len(shapes) - 1, -1, -1):
        steps.begin(f"level {k}")
        own = state.compress(k, counts, target_error)
        described.insert(0, {"rows": shapes[k][0], "columns": shapes[k][1], "components": own})
        steps()
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
        meta["published_layout"] = packed_layout(len(shapes), btf.texels, len(btf.views), len(btf.lights))
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


def _first_pass(images: PyramidImages) -> tuple[list[np.ndarray], np.ndarray]:
    """Inner products of the channels at each level (3, 3), and the mean of the coarsest, (pairs, 3) float64."""
    energy = [np.zeros((3, 3)) for _ in images.shapes]
    means = []
    for grams, mean in images.fill(_grams_and_mean, None):
        for total, own in zip(energy, grams, strict=True):
            total += own
        means.append(mean)
    return energy, np.concatenate(means)


def _grams_and_mean(_: None, part: slice, levels: Images) -> tuple[list[np.ndarray], np.ndarray]:
    """What :func:`_first_pass` wants of a block."""
    return [gram(list(np.moveaxis(image, 1, 0))) for image in levels], levels[-1].mean(2, dtype=float)


def _mean_maps(
    btf: BTFBlocks, table: np.ndarray, choice: str, storage: str
) -> tuple[dict[str, np.ndarray], list[np.ndarray], Facts]:
    """Mean of the coarsest level: maps, its values [channel] at all pairs as stored, and facts on the Phong model."""
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
    images : PyramidImages
    energy : list of ndarray (3, 3)
        Inner products of the channels at each level.
    average : list of ndarray, shape (pairs,)
        Mean of the coarsest level, [channel].
    closed : bool
    filter_type, storage : str
    n_views : int
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        images: PyramidImages,
        energy: list[np.ndarray],
        average: list[np.ndarray],
        closed: bool,
        filter_type: str,
        storage: str,
        n_views: int,
        rng: np.random.Generator,
    ) -> None:
        self.images, self.closed = images, closed
        self.energy = [float((RGB_METRIC * own).sum()) for own in energy]
        self.filter_type, self.storage, self.n_views, self.rng = filter_type, storage, n_views, rng
        self.maps: dict[str, np.ndarray] = {}
        self.level_errors: dict[int, float] = {}
        self.gram = np.zeros((3, 3))
        self.average = np.stack(average, 1)
        #: [channel]: coarser levels as they are stored: weights (component, texels) of which level, basis.
        self.kept: list[list[tuple[int, np.ndarray, np.ndarray]]] = [[] for _ in CHANNELS]

    def _model(self, k: int) -> Model:
        """What the levels that are stored say of level k."""
        shapes = self.images.shapes
        tables: list[tuple[np.ndarray, np.ndarray]] = []
        for channel, kept in enumerate(self.kept):
            weights = [np.ones((1, self.images.texels(k)), np.float32)]
            weights += [expanded(w, shapes[j], shapes[k], self.filter_type) for j, w, _ in kept]
            basis = [self.average[:, channel : channel + 1], *(b.T for _, _, b in kept)]
            tables.append((np.concatenate(basis, 1), np.concatenate(weights)))
        return Model(tables)

    def compress(self, k: int, counts: tuple[int, int, int] | None, target: float | None) -> list[int]:
        """Compress level k to the given numbers of components, or to as few as reach the target; returns them."""
        energy, texels = self.energy[k], self.images.texels(k)
        # The mean takes a dimension: of n texels, n − 1 differences to it are independent.
        limit = texels - (k == len(self.images.shapes) - 1)
        ranks = [min(limit, n) for n in counts or (LARGEST,) * 3]
        ranges, amounts = self._ranges(k, ranks)
        own = [len(basis) for basis, _ in ranges]
        aimed = allowed = np.inf if target is None else target**2 * energy
        coarser = [list(kept) for kept in self.kept]
        while True:
            if target is not None:
                own = _fewest(amounts, [coordinate for _, coordinate in ranges], aimed, k)
            parts = [self._stored(k, *part, n) for part, n in zip(ranges, own, strict=True)]
            self.kept = [list(kept) for kept in coarser]
            self._keep(k, parts)
            left = self._left(k)
            error = float((RGB_METRIC * left).sum())
            if target is None or error <= allowed or aimed == 0:
                break
            # Channels' errors are correlated and stored maps are rounded: aim lower.
            aimed = 0.9 * aimed if aimed > 1e-6 * allowed else 0.0
        self.gram = left / (texels * self.images.n_pairs)
        self.level_errors[k] = np.sqrt(error / energy) if energy > 0 else 0.0
        return [int(n) for n in own]

    def _ranges(self, k: int, ranks: list[int]) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
        """Leading directions of the differences of level k, [channel], and the differences' squares by channel."""
        n, d = self.images.texels(k), self.images.n_pairs
        bases = [
            self.rng.standard_normal((n, min(r + OVERSAMPLING, n, d) if r else 0), np.float32) for r in ranks
        ]
        squares = np.zeros(3)
        model: Model | Exact = self._model(k)
        if not self.closed:
            model = Exact(self.average, self.images.shapes[k:], self.filter_type)
        for turn in range(PASSES):
            steps = [GramPass(basis, d) for basis in bases]
            task = model, [step.basis for step in steps], turn == 0
            blocks = self.images.over(k, rest_products, task, coarser=not self.closed)
            for part, (products, own) in blocks:
                for step, found in zip(steps, products, strict=True):
                    if found is not None:
                        step.add(part, *found)
                if own is not None:
                    squares += own
            if turn < PASSES - 1:
                bases = [step.next_basis() if step.basis.shape[1] else step.basis for step in steps]
        none = np.zeros((0, d), np.float32), np.zeros((n, 0), np.float32)
        return [step.leading(r) if r else none for step, r in zip(steps, ranks, strict=True)], squares

    def _left(self, k: int) -> np.ndarray:
        """Inner products of what the stored levels leave of level k, by channel."""
        left = np.zeros((3, 3))
        for _, own in self.images.over(k, rest_gram, self._model(k)):
            left += own
        return left

    def _stored(self, k: int, basis: np.ndarray, coordinate: np.ndarray, n: int) -> StoredChannel:
        """Weights and basis of the first components as they are stored."""
        shapes, peak = unit_peaks(basis[:n])
        weights = stored(f"weights_{k}", coordinate[:, :n] * peak, self.storage)
        return weights, stored(f"basis_{k}", shapes, self.storage)

    def _keep(self, k: int, parts: list[StoredChannel]) -> None:
        for channel, (weights, basis) in enumerate(parts):
            if len(basis):
                wide = np.ascontiguousarray(weights.T, np.float32), basis.astype(np.float32)
                self.kept[channel].append((k, *wide))
        basis = np.concatenate([basis for _, basis in parts])
        if len(basis):
            table = np.ascontiguousarray(basis.T).reshape(self.n_views, -1, len(basis))
            self.maps[f"basis_{k}"] = table
            weights = np.concatenate([w for w, _ in parts], 1)
            self.maps[f"weights_{k}"] = weights.reshape(*self.images.shapes[k], -1)

    def errors(self) -> Facts:
        """JSON-able errors of the finest level and of all."""
        return {
            "error": float(self.level_errors[0] ** 2),
            "levels": [float(self.level_errors[k]) for k in sorted(self.level_errors)],
            "mse": dict(zip(CHANNELS, np.diag(self.gram).tolist(), strict=True)),
        }


def _fewest(squares: np.ndarray, coordinates: list[np.ndarray], allowed: float, level: int) -> list[int]:
    """Numbers of components by channel that leave at most ``allowed`` of weighted squared error, greedily."""
    gains = [
        np.einsum("nk,nk->k", c, c, dtype=float) * w for c, w in zip(coordinates, RGB_WEIGHT, strict=True)
    ]
    left = float(squares @ RGB_WEIGHT)
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
