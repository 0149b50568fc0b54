"""Lookups that are hard to evaluate, in blocks that a seed and a number reproduce."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.numerics.sphere import interpolation

#: Lookups of a block.
BLOCK = 4096

#: Ways to draw a direction; "not a direction" must give exactly 0.
DIRECTIONS = (
    "anywhere",
    "grazing",
    "pole",
    "sample",
    "between samples",
    "edge",
    "seam",
    "ring",
    "unnormalised",
    "denormal",
    "not a direction",
)

#: Ways to draw texture coordinates.
COORDINATES = ("anywhere", "negative", "far", "centre", "border", "wrap", "denormal", "not finite")

#: How a lookup's light relates to its view.
RELATIONS = ("apart", "equal", "mirrored")

_TINY = float(np.finfo(np.float32).smallest_subnormal)


@dataclass(frozen=True)
class Lookups:
    """Lookups in float32, and how each was drawn.

    Attributes
    ----------
    uv, w_light, w_view : ndarray of float32, shape (n, 2), (n, 3), (n, 3)
    lod : ndarray of float32, shape (n,)
    light, view, coordinate, relation : ndarray of uint8, shape (n,)
        Indices into ``DIRECTIONS``, ``DIRECTIONS``, ``COORDINATES``, ``RELATIONS``.
    """

    uv: np.ndarray
    w_light: np.ndarray
    w_view: np.ndarray
    lod: np.ndarray
    light: np.ndarray
    view: np.ndarray
    coordinate: np.ndarray
    relation: np.ndarray

    def __len__(self):
        return len(self.uv)

    def __getitem__(self, index):
        return Lookups(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @property
    def points(self):
        """Arguments of ``evaluate`` without the level of detail."""
        return self.uv, self.w_light, self.w_view

    def where(self, i):
        """How lookup ``i`` was drawn, for people."""
        text = f"light: {DIRECTIONS[self.light[i]]}; view: {DIRECTIONS[self.view[i]]}"
        if self.relation[i]:
            text = f"directions: {RELATIONS[self.relation[i]]}, {DIRECTIONS[self.view[i]]}"
        return f"{text}; uv: {COORDINATES[self.coordinate[i]]}"


def block(representation, seed, number, n=BLOCK):
    """Lookups of block ``number`` for a representation: its own directions, rings, edges and texels.

    Parameters
    ----------
    representation : Representation
    seed, number, n : int
        The same give the same lookups; fewer are not the first ones of more.

    Returns
    -------
    Lookups
    """
    rng = np.random.default_rng([seed, number])
    arrays = representation.arrays()
    drawn, kinds = {}, {}
    for prefix in ("light", "view"):
        kinds[prefix] = rng.integers(0, len(DIRECTIONS), n).astype(np.uint8)
        drawn[prefix] = _directions(rng, kinds[prefix], arrays, prefix)
    # In a third of all lookups both directions depend on each other.
    relation = np.where(rng.random(n) < 1 / 3, rng.integers(1, len(RELATIONS), n), 0).astype(np.uint8)
    related = relation > 0
    sign = np.where(relation == RELATIONS.index("mirrored"), -1, 1)[:, None] * [1, 1, 0] + [0, 0, 1]
    sign = np.where(relation[:, None] == RELATIONS.index("equal"), 1, sign)
    with np.errstate(invalid="ignore"):
        drawn["light"] = np.where(related[:, None], drawn["view"] * sign.astype(np.float32), drawn["light"])
    coordinate = rng.integers(0, len(COORDINATES), n).astype(np.uint8)
    uv = _coordinates(rng, coordinate, representation.meta["texels"])
    lod = np.where(rng.random(n) < 0.5, 0, rng.uniform(-1, 6, n))
    odd = rng.random(n) < 0.1
    lod = np.where(odd, rng.choice([-1e30, 1e30, np.inf, -np.inf, np.nan, 3.0, _TINY], n), lod)
    return Lookups(
        uv, drawn["light"], drawn["view"], lod.astype(np.float32), *kinds.values(), coordinate, relation
    )


def _directions(rng, kind, arrays, prefix):
    """Directions of the kinds of ``DIRECTIONS``, rounded to float32."""
    n = len(kind)
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2])
    w = unit(w)
    samples = arrays[f"{prefix}_directions"].astype(float)
    some = rng.integers(0, len(samples), (2, n))

    def of(name):
        return kind == DIRECTIONS.index(name)

    # Down to 1e-8 of a radian above the horizon, and as near to the pole.
    k = of("grazing")
    w[k, 2] = 10 ** rng.uniform(-8, -1, k.sum())
    k = of("pole")
    w[k] = np.concatenate(
        [unit(w[k, :2]) * 10 ** rng.uniform(-9, -2, (k.sum(), 1)), np.ones((k.sum(), 1))], 1
    )
    w[k, :2] *= rng.integers(0, 2, (k.sum(), 1))
    k = of("sample")
    w[k] = samples[some[0, k]]
    k = of("between samples")
    w[k] = samples[some[0, k]] + samples[some[1, k]] + 1e-3 * samples[some[0, k]]
    k = of("edge")
    w[k] = _on_edges(rng, k.sum(), arrays, prefix)
    k = of("seam")
    w[k, 1] = rng.choice([0.0, -0.0, 1e-9, -1e-9, _TINY, -_TINY], k.sum())
    k = of("ring")
    theta = np.arccos(np.clip(samples[some[0, k], 2], -1, 1))
    phi = rng.uniform(0, 2 * np.pi, k.sum())
    w[k] = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    w = np.maximum(unit(w), [-1, -1, 1e-9]).astype(np.float32)
    k = of("unnormalised")
    w[k] = np.nextafter(w[k], rng.choice([-2, 2], (k.sum(), 3)).astype(np.float32))
    w[k, 2] = np.maximum(w[k, 2], 1e-9)
    k = of("denormal")
    component = rng.integers(0, 2, k.sum())
    w[np.flatnonzero(k), component] = rng.choice([_TINY, -_TINY, 1e-39, -1e-39], k.sum())
    low = k & (rng.random(n) < 0.3)
    w[low, 2] = 1e-39
    w[k] = unit(w[k].astype(float))
    k = of("not a direction")
    w[k] = _NOT_DIRECTIONS[rng.integers(0, len(_NOT_DIRECTIONS), k.sum())]
    return w


_NOT_DIRECTIONS = np.array(
    [
        (np.nan, 0, 1),
        (0, np.nan, 1),
        (0, 0, np.nan),
        (np.nan,) * 3,
        (np.inf, 0, 1),
        (0, -np.inf, 1),
        (0, 0, np.inf),
        (0, 0, -np.inf),
        (np.inf, np.nan, -np.inf),
        (0, 0, 0),
        (0, 0, -1),
        (0.6, 0, -0.8),
        (1, 0, 0),
        (1, 0, -0.0),
        (0, 0, 2.5),
        (0, 0, 1e30),
        (0, 0, 1e-20),
        (0, 0, 0.3),
        (1, 0, -1e-9),
    ],
    np.float32,
)


def _on_edges(rng, n, arrays, prefix):
    """Directions on borders between cells of the interpolation: edges of triangles, or azimuths of ring samples."""
    table = interpolation.whole(interpolation.from_arrays(arrays, prefix))
    if isinstance(table, interpolation.TriangleInterpolation):
        triangle = np.asarray(table.triangles, float)[rng.integers(0, len(table.triangles), n)]
        t = rng.random((n, 1))
        return unit((1 - t) * triangle[:, 0:3] + t * triangle[:, 3:6])
    ring = np.asarray(table.rings, float)[rng.integers(0, len(table.rings), n)]
    theta = rng.uniform(0, np.pi / 2 - 1e-6, n)
    phi = ring[:, 1] + rng.integers(0, 64, n) * 2 * np.pi / ring[:, 2]
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def _coordinates(rng, kind, shape):
    n, size = len(kind), np.array(shape[::-1], float)
    uv = rng.uniform(0, 1, (n, 2))
    texel = np.floor(uv * size)
    cases = {
        "negative": -rng.uniform(0, 3, (n, 2)),
        "far": rng.choice([-1, 1], (n, 2)) * 10 ** rng.uniform(3, 6, (n, 2)),
        "centre": (texel + 0.5) / size,
        "border": texel / size,
        "wrap": np.round(uv) + rng.choice([0.0, -1e-8, 1e-8, -0.0], (n, 2)),
        "denormal": rng.choice([_TINY, -_TINY, 1e-39, -1e-39], (n, 2)),
        "not finite": rng.choice([np.nan, np.inf, -np.inf, 3e38, -3e38, 0.3], (n, 2)),
    }
    for name, values in cases.items():
        k = kind == COORDINATES.index(name)
        uv[k] = values[k]
    return uv.astype(np.float32)


def unit(w):
    """Rows of length 1; zero rows stay."""
    length = np.linalg.norm(w, axis=-1, keepdims=True)
    return w / np.where(length > 0, length, 1)
