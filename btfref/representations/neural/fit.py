"""Fit of the network and the latent texture: Adam in NumPy, in an order that nothing but the seed decides.

Each step sees some neighbouring texels, moved by a random part of a texel, under some pairs of directions: texels times
pairs, so that the first layer's products with directions are made once for all texels. The data are interpolated as the
latent texture is: what is between texels is fitted as well. A BTF of many texels is read by bands of rows, see
:mod:`btfref.representations.neural.samples`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.solvers.threads import reproducible
from btfref.representations.analytic.light_functions import edge_constants
from btfref.representations.lookup import (
    base_meta,
    direction_arrays,
    positive_integer,
    stored,
)
from btfref.representations.neural import network
from btfref.representations.neural.definition import Representation
from btfref.representations.neural.samples import ROW_BYTES, SIDE, TEXELS, Samples, a_window
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(
    blocks=200 << 20, scales=("hidden",), rows=ROW_BYTES, texels=TEXELS, texel=2400, sequential=True
)

#: "paper": all numbers in floats. "quick": a few steps, to try things out.
PRESETS: dict[str, Facts] = {"paper": {"storage": "float"}, "quick": {"hidden": 16, "passes": 2}}

#: Pairs of directions of a step; few texels see more pairs, so that a step is worth it.
PAIRS, MOST_PAIRS = 32, 128

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


@reproducible()
def fit(
    btf: BTFBlocks,
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
    btf : BTFBlocks
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
    samples = Samples.of(btf, filter_type == "bilinear")
    rng = np.random.default_rng(seed)
    latent, layers = start(rng, btf.texels, hidden)
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
    pairs, texels = len(samples.codes), samples.btf.texels
    if not samples.scale.any():
        return 0
    lookups = min(SIDE, texels[0]) * min(SIDE, texels[1])
    width = min(pairs, max(PAIRS, min(MOST_PAIRS, BATCH // lookups)))
    steps = max(1, round(passes * pairs * texels[0] * texels[1] / (lookups * width)))
    own = Adam(latent, TEXEL_STEP)
    shared = {name: Adam(layer, STEP) for name, layer in layers.items()}
    order, first = np.zeros(0, int), 0
    for band, last in samples.visits(steps, passes):
        if first == last:
            continue
        values = samples.read(band)
        for step in range(first, last):
            if len(order) < width:
                order = np.concatenate([order, rng.permutation(pairs)])
            chosen, order = order[:width], order[width:]
            window = a_window(rng, texels, samples.bilinear, band)
            here = latent[np.ix_(window.rows, window.columns)]
            moved = window.moved(here).reshape(-1, latent.shape[-1])
            y, tape = network.forward(moved, samples.codes[chosen], layers)
            targets = window.targets(values, chosen)
            slope = _slope(y, targets, samples.cosine[chosen], samples.scale)
            by_texel, by_layer = network.backward(tape, slope, layers)
            share = 0.5 * (1 + math.cos(math.pi * step / steps))
            shape = len(window.rows) - 1, len(window.columns) - 1, latent.shape[-1]
            gradient, rows, columns = window.gathered(by_texel.reshape(shape), texels)
            own.step(gradient, share, np.ix_(rows, columns))
            for name, adam in shared.items():
                adam.step(by_layer[name], share)
            if step % 100 == 99 or step == steps - 1:
                report(step + 1, steps, "steps")
        first = last
        del values  # before the next band is read
    return steps


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
    chosen = np.unique(np.linspace(0, len(samples.codes) - 1, JUDGED).round().astype(int))
    squares = energy = total = true = 0.0
    for band in samples.bands:
        values = samples.read(band)
        for row in range(band.first, band.last):
            y, _ = network.forward(maps["latent"][row].astype(np.float32), samples.codes[chosen], layers)
            found = network.values(y, samples.cosine[chosen], samples.scale)
            data = np.moveaxis(values[chosen, row - band.first], 0, 1).astype(np.float32)
            squares += float(((found - data) ** 2).sum(dtype=float))
            energy += float((data**2).sum(dtype=float))
            total, true = total + float(found.sum(dtype=float)), true + float(data.sum(dtype=float))
    return {
        "error": squares / energy if energy > 0 else 0.0,
        "mean_ratio": total / true if true > 0 else 1.0,
    }
