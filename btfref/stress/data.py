"""Sampled BTFs that are hard to fit, each from a formula and a seed: degenerate, huge, tiny, noisy, of odd sizes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from btfref.errors import InputError
from btfref.numerics.sphere.directions import DirectionSet, directions, spherical
from btfref.sampling import SampledBTF

if TYPE_CHECKING:
    #: Changes the values of a BTF: ``(values, rng) -> values``.
    Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]

#: Rows and columns where the data do not ask for others.
SHAPE = (16, 12)


def bumpy_values(
    shape: tuple[int, int], views: DirectionSet, lights: DirectionSet, seed: int = 0
) -> np.ndarray:
    """A checker of a rough and a glossy material on bumps, without noise.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    views, lights : DirectionSet
    seed : int
        Of a small disorder of the normals.

    Returns
    -------
    ndarray of float32, shape (n_views, n_lights, rows, columns, 3)
        1/sr, the cosine included.
    """
    rows, columns = shape
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    checker = 0.5 + 0.5 * np.tanh(6 * np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v))
    normal = np.stack(
        [0.6 * np.cos(2 * np.pi * u) * np.sin(2 * np.pi * v), 0.5 * np.sin(2 * np.pi * u), np.ones_like(u)],
        -1,
    )
    normal += 0.02 * np.random.default_rng(seed).normal(size=normal.shape)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    colour = checker[..., None] * [0.8, 0.3, 0.4] + (1 - checker[..., None]) * [0.1, 0.15, 0.6]
    half = views.vectors[:, None] + lights.vectors[None]
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    cos_light = np.maximum(np.einsum("rck,lk->lrc", normal, lights.vectors), 0)
    cos_half = np.maximum(np.einsum("rck,vlk->vlrc", normal, half), 0)
    shade = cos_light[None, ..., None] * colour / np.pi
    gloss = 0.6 * checker * cos_half ** (5 + 60 * checker) * cos_light[None]
    visible = 1 - 0.5 * np.maximum(0, -np.einsum("rck,vk->vrc", normal, views.vectors))
    return ((shade + gloss[..., None]) * visible[:, None, ..., None]).astype(np.float32)


def bumpy(
    seed: int = 0,
    shape: tuple[int, int] = SHAPE,
    views: str | ArrayLike = "ubo81",
    lights: str | ArrayLike = "ubo81",
    dtype: DTypeLike = "float16",
    change: Change | None = None,
) -> SampledBTF:
    """The values of :func:`bumpy_values` as a BTF, after ``change(values, rng)``.

    Parameters
    ----------
    seed : int
    shape : (int, int)
        Rows and columns.
    views, lights : str or array_like
        As of :func:`btfref.numerics.sphere.directions.directions`.
    dtype : numpy.dtype
    change : callable, optional

    Returns
    -------
    SampledBTF
    """
    sets = directions(views), directions(lights)
    values = bumpy_values(shape, *sets, seed)
    if change is not None:
        values = change(values, np.random.default_rng([seed, 1]))
    return SampledBTF(values.astype(dtype), *sets, attributes={"mesostructure": "formula"})


def _like(
    function: Callable[[tuple[int, ...], np.random.Generator, DirectionSet], np.ndarray],
) -> Callable[[int], SampledBTF]:
    """Data of the bumpy BTF's shape from ``function(shape, rng, lights)``, float32."""

    def make(seed: int) -> SampledBTF:
        views = lights = directions("ubo81")
        shape = (len(views), len(lights), *SHAPE, 3)
        values = function(shape, np.random.default_rng(seed), lights).astype(np.float32)
        return SampledBTF(values, views, lights, attributes={"mesostructure": "formula"})

    return make


def _changed(change: Change, dtype: DTypeLike = "float16") -> Callable[[int], SampledBTF]:
    return lambda seed: bumpy(seed, dtype=dtype, change=change)


def _salt(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One sample in a hundred is a thousand times the largest: fireflies."""
    hit = rng.random(values.shape[:-1]) < 0.01
    return np.where(hit[..., None], 1e3 * values.max(), values)


def _noise(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Zero-mean noise of a measurement: a third of the values is negative."""
    return values + 0.5 * values.std() * rng.standard_normal(values.shape)


def _duplicates(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Three different texels, each many times."""
    flat = values.reshape(*values.shape[:2], -1, 3)
    chosen = rng.integers(0, 3, flat.shape[2]) * (flat.shape[2] // 3)
    return flat[:, :, chosen].reshape(values.shape)


def _relief(seed: int) -> SampledBTF:
    """Data that a height field explains, whatever the seed."""
    chosen = directions("ubo81")
    return SampledBTF(_relief_values().copy(), chosen, chosen, attributes={"mesostructure": "formula"})


@cache  # six seconds, for every method
def _relief_values() -> np.ndarray:
    """A g-BRDF of smooth bumps 0.1 deep, in two materials, at all its samples."""
    from btfref.numerics.microfacets import isotropic_ndf
    from btfref.representations.gbrdf.build import from_maps

    rows, columns = SHAPE
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    wave = np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v)
    checker = (0.5 + 0.5 * np.tanh(6 * wave))[..., None]
    surface = from_maps(
        (1 + wave) / 2,
        height_min=-0.1,
        diffuse=checker * [0.64, 0.24, 0.32] + (1 - checker) * [0.08, 0.12, 0.48],
        material=(checker[..., 0] < 0.5).astype(int),
        ndf=np.stack([isotropic_ndf(0.2), isotropic_ndf(0.5)]),
        specular=[0.3, 0.1],
    )
    chosen = directions("ubo81")
    uv, lights = np.stack([u, v], -1), chosen.vectors[:, None, None]
    return np.stack([surface.evaluate(uv, lights, view) for view in chosen.vectors]).astype(np.float32)


def scattered(seed: int, n: int = 40) -> np.ndarray:
    """``n`` random unit vectors of the upper hemisphere: no rings, no symmetry, shape (n, 3)."""
    rng = np.random.default_rng([seed, 2])
    return spherical(np.arccos(rng.uniform(0.02, 1, n)), rng.uniform(0, 2 * np.pi, n))


#: Data by name: what it is, and how it is made from a seed.
DATA: dict[str, tuple[str, Callable[[int], SampledBTF]]] = {
    "bumpy": ("smooth bumps of two materials, no noise", bumpy),
    "scattered": (
        "the same at random directions, 7 x 5 texels",
        lambda seed: bumpy(seed, (7, 5), scattered(seed), scattered(seed + 1)),
    ),
    "line": ("the same on 1 x 13 texels", lambda seed: bumpy(seed, (1, 13))),
    "one texel": ("the same on one texel", lambda seed: bumpy(seed, (1, 1))),
    "one direction": (
        "one view and one light, both the pole",
        lambda seed: bumpy(seed, views=[[0, 0, 1]], lights=[[0, 0, 1]]),
    ),
    "constant": ("0.25 for every pair", _like(lambda shape, rng, lights: np.full(shape, 0.25))),
    "black": ("0 for every pair", _like(lambda shape, rng, lights: np.zeros(shape))),
    "rank one": (
        "one table of directions times one texture",
        _like(
            lambda shape, rng, lights: (
                lights.vectors[None, :, 2, None, None, None]
                * rng.uniform(0.1, 1, (1, 1, *shape[2:]))
                * np.ones(shape)
            )
        ),
    ),
    "duplicates": ("three texels, each many times", _changed(_duplicates)),
    "wide range": (
        "10 to the power of -8 … 8, at random",
        _like(lambda shape, rng, lights: 10 ** rng.uniform(-8, 8, shape)),
    ),
    "huge": ("bumpy times 1e8", _changed(lambda values, rng: values * 1e8, dtype="float32")),
    "tiny": ("bumpy times 1e-8", _changed(lambda values, rng: values * 1e-8, dtype="float32")),
    "salt": ("bumpy with fireflies", _changed(_salt)),
    "relief": ("a height field with shadows and highlights", _relief),
    "negative": ("bumpy with zero-mean noise", _changed(_noise)),
}


def make(name: str, seed: int = 0) -> SampledBTF:
    """The data ``name``.

    Returns
    -------
    SampledBTF

    Raises
    ------
    InputError
        Unknown name.
    """
    if name not in DATA:
        raise InputError("unknown data", field="--data", got=repr(name), expected=", ".join(DATA))
    return DATA[name][1](seed)
