"""Fit of the network and the latent texture: Adam in NumPy, in an order that nothing but the seed decides.

Each step sees some neighbouring texels, moved by a random part of a texel, under some pairs of directions: texels times
pairs, so that the first layer's products with directions are made once for all texels. The data are interpolated as the
latent texture is: what is between texels is fitted as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.threads import reproducible
from btfref.representations.analytic.light_functions import edge_constants
from btfref.representations.file.schema import LARGEST
from btfref.representations.lookup import (
    base_meta,
    direction_arrays,
    positive_integer,
    refuse_not_finite,
    stored,
)
from btfref.representations.neural import network
from btfref.representations.neural.definition import Representation
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.types import Facts, Progress

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(2.4, 200 << 20)

#: "paper": all numbers in floats. "quick": a few steps, to try things out.
PRESETS: dict[str, Facts] = {"paper": {"storage": "float"}, "quick": {"hidden": 16, "passes": 2}}

#: Texels a side of a step, at most, and pairs of directions; few texels see more pairs, so that a step is worth it.
SIDE, PAIRS, MOST_PAIRS = 8, 32, 128

#: Lookups of a step, at least.
BATCH = 2048

#: Steps of Adam at the start, for the matrices and for the texels; they fall to 0 as a cosine.
STEP, TEXEL_STEP = 0.01, 0.01

#: Adam's means of gradients and of their squares (Kingma and Ba 2015).
MEAN, SQUARE = 0.9, 0.99

#: Errors are those of log(1 + B / (OFFSET · mean of B)).
OFFSET = 1.0

#: Pairs of directions at which the fit states its error.
JUDGED = 256


@dataclass
class Adam:
    """Adam of one array, of which a step may touch a part: each item counts its own steps."""

    value: np.ndarray
    rate: float
    mean: np.ndarray = field(init=False)
    square: np.ndarray = field(init=False)
    count: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.mean, self.square = np.zeros_like(self.value), np.zeros_like(self.value)
        self.count = np.zeros((*self.value.shape[:-1], 1))

    def step(
        self, gradient: np.ndarray, share: float, at: tuple[np.ndarray, ...] | slice = slice(None)
    ) -> None:
        """Go against a gradient, that of the items ``at``, by a ``share`` of the rate."""
        self.count[at] += 1
        count = self.count[at]
        mean = self.mean[at] * np.float32(MEAN) + gradient * np.float32(1 - MEAN)
        square = self.square[at] * np.float32(SQUARE) + gradient**2 * np.float32(1 - SQUARE)
        self.mean[at], self.square[at] = mean, square
        size = self.rate * share * np.sqrt(1 - SQUARE**count) / (1 - MEAN**count)
        self.value[at] -= size.astype(np.float32) * mean / (np.sqrt(square) + np.float32(1e-12))


@dataclass(frozen=True)
class Samples:
    """What steps read: values by pair of directions, row and column, and what is known of the pairs."""

    values: np.ndarray
    codes: np.ndarray
    cosine: np.ndarray
    scale: np.ndarray
    bilinear: bool

    @property
    def texels(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.values.shape[1], self.values.shape[2]


@dataclass(frozen=True)
class Window:
    """Neighbouring texels, wrapped, and how far they are moved.

    Attributes
    ----------
    rows, columns : ndarray of int
        One more than there are lookups a side.
    way : (float, float)
        Down and to the right, parts of a texel.
    """

    rows: np.ndarray
    columns: np.ndarray
    way: tuple[float, float]

    def corners(self) -> list[tuple[slice, slice, np.float32]]:
        """The four texels around each lookup: where they are among the window's, and their weight."""
        lower, upper = slice(None, -1), slice(1, None)
        y, x = self.way
        return [
            (row, column, np.float32(a * b))
            for row, a in ((lower, 1 - y), (upper, y))
            for column, b in ((lower, 1 - x), (upper, x))
            if a * b > 0
        ]

    def moved(self, items: np.ndarray) -> np.ndarray:
        """Interpolate the window's items, shape (rows, columns, …) -> (rows − 1, columns − 1, …)."""
        parts = [items[row, column] * weight for row, column, weight in self.corners()]
        return sum(parts[1:], parts[0])

    def gathered(
        self, slopes: np.ndarray, texels: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The transpose of :meth:`moved`: the items' slopes, and their rows and columns, each of them once."""
        rows, columns = self.rows, self.columns
        result = np.zeros((len(rows), len(columns), slopes.shape[-1]), np.float32)
        for row, column, weight in self.corners():
            result[row, column] += weight * slopes
        # A window as large as the texture meets its own first row and column again.
        if len(rows) > texels[0]:
            result[0] += result[-1]
            result, rows = result[:-1], rows[:-1]
        if len(columns) > texels[1]:
            result[:, 0] += result[:, -1]
            result, columns = result[:, :-1], columns[:-1]
        return result, rows, columns


def _window(rng: np.random.Generator, texels: tuple[int, int], bilinear: bool) -> Window:
    """A window anywhere in the texture."""
    rows, columns = ((int(rng.integers(n)) + np.arange(min(SIDE, n) + 1)) % n for n in texels)
    down, right = rng.random(2)
    return Window(rows, columns, (float(down), float(right)) if bilinear else (0.0, 0.0))


@reproducible()
def fit(
    btf: SampledBTF,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    hidden: int = 32,
    passes: float = 8.0,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """A latent texture and a network for ``btf``, by stochastic descent from one random start.

    Parameters
    ----------
    btf : SampledBTF
        Negative values count as 0.
    seed : int
        Of the start and of the order of the samples: same seed, same result.
    progress : callable, optional
        ``progress(done, total, label)``.
    hidden : int
        Units of each of the two hidden layers, at least 4 and a multiple of 4; a texel has ``4 · hidden + 3`` numbers.
    passes : float
        How many times each sample is seen on average, above 0; time is in proportion.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds the relative squared error ("error") and the mean of B over that of the data
        ("mean_ratio") at some of the samples, and the number of steps.

    Raises
    ------
    InputError
        For parameters out of range, values that are not finite, or maps that do not fit ``storage``.
    """
    hidden = positive_integer("hidden", hidden)
    if hidden % 4:
        raise InputError(
            "a parameter is out of range", field="hidden", got=hidden, expected="a multiple of 4"
        )
    if isinstance(passes, bool) or not isinstance(passes, int | float) or not 0 < passes < math.inf:
        raise InputError(
            "a parameter is out of range", field="passes", got=repr(passes), expected="a number above 0"
        )
    samples = _samples(btf, filter_type == "bilinear")
    rng = np.random.default_rng(seed)
    latent, layers = start(rng, samples.texels, hidden)
    steps = _descend(samples, latent, layers, rng, float(passes), progress or (lambda *_: None))
    maps = {"latent": stored("latent", latent, storage)}
    maps |= {name: stored(name, layer, storage) for name, layer in layers.items()}
    # A colour of any magnitude: always in float32.
    maps["colour_scale"] = samples.scale[None]
    parameters = {"hidden": hidden, "passes": float(passes), "storage": storage, "seed": seed}
    meta = base_meta("neural", btf, parameters, filter_type=filter_type)
    meta["constants"] = edge_constants(btf)
    meta["fit"] = {"steps": steps} | _judged(samples, maps)
    return Representation(maps | direction_arrays(btf.views, btf.lights), meta)


def _samples(btf: SampledBTF, bilinear: bool) -> Samples:
    """What steps read of a BTF."""
    views, lights = btf.views.vectors, btf.lights.vectors
    pairs = len(views), len(lights)
    total = np.zeros(3)
    for values in btf.values:
        refuse_not_finite(values, btf)
        total += np.maximum(values, 0).sum((0, 1, 2), dtype=float)
    mean, cosine = total / (btf.values.size / 3), float(lights[:, 2].mean())
    return Samples(
        btf.values.reshape(pairs[0] * pairs[1], *btf.values.shape[2:]),
        network.code(np.tile(lights, (pairs[0], 1)), np.repeat(views, pairs[1], 0)).astype(np.float32),
        np.tile(lights[:, 2], pairs[0]).astype(np.float32),
        np.minimum(mean / max(cosine, 1e-3), LARGEST).astype(np.float32),
        bilinear,
    )


def start(
    rng: np.random.Generator, texels: tuple[int, int], hidden: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A random start: matrices that keep the variance (He et al. 2015), gains about 1, biases about 0.

    Parameters
    ----------
    rng : numpy.random.Generator
    texels : (int, int)
    hidden : int

    Returns
    -------
    latent : ndarray of float32, shape (rows, columns, channels)
    layers : dict of str to ndarray of float32
    """
    sizes = (network.CODE, hidden, hidden, 3)
    layers = {}
    for name, n, m in zip(network.LAYERS, sizes, sizes[1:], strict=False):
        layers[name] = (rng.normal(size=(n, m)) * math.sqrt(2 / n)).astype(np.float32)
    layers["layer_3"] *= np.float32(0.3)
    latent = 0.05 * rng.normal(size=(*texels, network.channels(hidden)))
    gain_1, bias_1, gain_2, bias_2, _ = network.split(latent)
    gain_1 += 1
    gain_2 += 1
    # All texels begin with the same biases, so that units bend at different places and neighbours interpolate well.
    bias_1 += 0.3 * rng.normal(size=hidden)
    bias_2 += 0.1 * rng.normal(size=hidden)
    return latent.astype(np.float32), layers


def _descend(
    samples: Samples,
    latent: np.ndarray,
    layers: dict[str, np.ndarray],
    rng: np.random.Generator,
    passes: float,
    report: Progress,
) -> int:
    """Change the texels and the matrices in place; the number of steps."""
    pairs, texels = len(samples.values), samples.texels
    if not samples.scale.any():
        return 0
    lookups = min(SIDE, texels[0]) * min(SIDE, texels[1])
    width = min(pairs, max(PAIRS, min(MOST_PAIRS, BATCH // lookups)))
    steps = max(1, round(passes * pairs * texels[0] * texels[1] / (lookups * width)))
    own = Adam(latent, TEXEL_STEP)
    shared = {name: Adam(layer, STEP) for name, layer in layers.items()}
    order = np.zeros(0, int)
    for step in range(steps):
        if len(order) < width:
            order = np.concatenate([order, rng.permutation(pairs)])
        chosen, order = order[:width], order[width:]
        window = _window(rng, texels, samples.bilinear)
        here = latent[np.ix_(window.rows, window.columns)]
        moved = window.moved(here).reshape(-1, latent.shape[-1])
        y, tape = network.forward(moved, samples.codes[chosen], layers)
        slope = _slope(y, _targets(samples, chosen, window), samples.cosine[chosen], samples.scale)
        by_texel, by_layer = network.backward(tape, slope, layers)
        share = 0.5 * (1 + math.cos(math.pi * step / steps))
        shape = len(window.rows) - 1, len(window.columns) - 1, latent.shape[-1]
        gradient, rows, columns = window.gathered(by_texel.reshape(shape), texels)
        own.step(gradient, share, np.ix_(rows, columns))
        for name, adam in shared.items():
            adam.step(by_layer[name], share)
        if step % 100 == 99 or step == steps - 1:
            report(step + 1, steps, "steps")
    return steps


def _targets(samples: Samples, chosen: np.ndarray, window: Window) -> np.ndarray:
    """B of a window's lookups under pairs of directions, shape (texels, pairs, 3)."""
    values = samples.values[chosen[:, None, None], window.rows[:, None], window.columns]
    moved = window.moved(np.moveaxis(values, 0, 2).astype(np.float32))
    return np.maximum(moved, 0).reshape(-1, len(chosen), 3)


def _slope(y: np.ndarray, targets: np.ndarray, cosine: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Derivative of the mean loss by the exponents, shape (texels, pairs, 3)."""
    unit = np.float32(1 / (OFFSET * float(scale.mean())))
    found = network.values(y, cosine[None], scale) * unit
    difference = np.log1p(found) - np.log1p(targets * unit)
    # tanh: the absolute error, rounded where it is small.
    slope = np.tanh(difference * np.float32(1 / 0.02)) * (found / (1 + found))
    slope *= np.float32(math.log(2) / y.size)
    # Held exponents are led back, never further away.
    out = ((y < network.LOWEST) & (slope > 0)) | ((y > network.HIGHEST) & (slope < 0))
    slope *= ~out
    return slope


def _judged(samples: Samples, maps: dict[str, np.ndarray]) -> Facts:
    """Error and mean of the stored maps at all texels and some pairs of directions."""
    layers = {name: maps[name].astype(np.float32) for name in network.LAYERS}
    chosen = np.unique(np.linspace(0, len(samples.values) - 1, JUDGED).round().astype(int))
    squares = energy = total = true = 0.0
    for row, latent in enumerate(maps["latent"].astype(np.float32)):
        y, _ = network.forward(latent, samples.codes[chosen], layers)
        found = network.values(y, samples.cosine[chosen], samples.scale)
        data = np.moveaxis(samples.values[chosen, row], 0, 1).astype(np.float32)
        squares += float(((found - data) ** 2).sum(dtype=float))
        energy += float((data**2).sum(dtype=float))
        total, true = total + float(found.sum(dtype=float)), true + float(data.sum(dtype=float))
    return {
        "error": squares / energy if energy > 0 else 0.0,
        "mean_ratio": total / true if true > 0 else 1.0,
    }
