"""A sampled BTF with a known formula: the tests' quick, noise-free stand-in for a synthesized one."""

from __future__ import annotations

import numpy as np

from btfref.numerics.directions import directions
from btfref.registry import method
from btfref.representations import save
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


def scattered(n=81, seed=3):
    """Directions without rings: `n` unit vectors of the upper hemisphere, shape (n, 3)."""
    w = np.random.default_rng(seed).normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2])
    return w / np.linalg.norm(w, axis=1, keepdims=True)


#: Sets of (views, lights): rings, rings with shifted azimuths, sets without a pole or rings of their own, no rings.
KINDS = {
    "ubo81": ("ubo81", "ubo81"),
    "shifted": ("ubo151", "ubo81"),
    "triangles": ("10x5", "16x8"),
    "scattered": (scattered(seed=3), scattered(seed=4)),
}

#: Texels of the tables that all registered methods are fitted to.
SHAPE = (16, 12)


class Fits:
    """Every method fitted once to each kind of table, with its defaults; shared by all tests of a run.

    Parameters
    ----------
    directory : Path
        For the files.
    """

    def __init__(self, directory):
        self._directory, self._btfs, self._made, self._written = directory, {}, {}, set()

    def btf(self, kind="ubo81"):
        """The table; see KINDS."""
        if kind not in self._btfs:
            self._btfs[kind] = oracle_btf(SHAPE, *KINDS[kind])
        return self._btfs[kind]

    def __call__(self, key, kind="ubo81"):
        """The representation; not to be changed."""
        if (key, kind) not in self._made:
            self._made[key, kind] = method(key).fit(self.btf(kind))
        return self._made[key, kind]

    def path(self, key, kind="ubo81"):
        """The representation's file; not to be changed."""
        path = self._directory / f"{kind}.{key}.exr"
        if path not in self._written:
            save(self(key, kind), path)
            self._written.add(path)
        return path
