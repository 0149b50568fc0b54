"""A sampled BTF with a known formula: the tests' quick, noise-free stand-in for a synthesized one."""

from __future__ import annotations

import numpy as np

from btfref.numerics.directions import directions
from btfref.sampling import SampledBTF


def oracle_values(shape, views, lights, seed=0):
    """Bumpy two-material values in 1/sr, cosine included; (view, light, row, column, 3) float32."""
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


def oracle_btf(shape=(16, 12), views="ubo81", lights="ubo81", dtype="float16", seed=0):
    """The values of :func:`oracle_values` as a :class:`SampledBTF`."""
    views, lights = directions(views), directions(lights)
    values = oracle_values(shape, views, lights, seed).astype(dtype)
    return SampledBTF(
        values=values, views=views, lights=lights, variance=None, attributes={"mesostructure": "oracle"}
    )
